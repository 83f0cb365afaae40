"""What training rays have seen: a fine grid of cells over space."""

import torch
from torch import Tensor, nn

from xplanes.backend import compiled, cpu_loops
from xplanes.rendering.compositing import depth_before
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views

LIT = 0.03
"""Share of the light from which a cell that it reaches counts as seen."""

FINEST = 256
"""Most cells along each side: one byte each is 17 MB."""

NOW, BEFORE = 2, 1
"""Since the last sweep, and between it and the one before."""


class Visibility(nn.Module):
    """Which cells of the cube [-1, 1]^3 training rays have seen, at any time.

    A cell is seen when more than `LIT` of a ray's light reaches a sample in it, past all that lay
    in front. What lies behind surfaces or below the ground in all training images is never seen:
    nothing tells the field what is there, and images of other views shall not show it. Before the
    first `forget` every cell counts as seen.

    Args:
        resolution: Cells along each side.
    """

    last: Tensor

    def __init__(self, resolution: int) -> None:
        super().__init__()
        self.resolution = resolution
        cells = torch.full((resolution**3,), BEFORE, dtype=torch.uint8)
        self.register_buffer("last", cells)
        self.register_load_state_dict_pre_hook(_resize)

    def cells(self, points: Tensor) -> Tensor:
        """Cell that holds each point of the cube. [N, 3] -> int64 [N]"""
        place = ((points + 1) * (0.5 * self.resolution)).long().clamp_(0, self.resolution - 1)
        return (place[:, 2] * self.resolution + place[:, 1]) * self.resolution + place[:, 0]

    @torch.no_grad()
    def observe(
        self,
        points: Tensor,
        weights: Tensor,
        ray: Tensor,
        starts: Tensor,
        live: Tensor | None = None,
    ) -> None:
        """Take in the samples of training rays.

        Args:
            points: Their places. [N, 3]
            weights: Share of its ray's light that each of them stops. [N]
            ray: Ray of each, ascending. [N]
            starts: Index of each ray's first sample. [R]
            live: Which of them count; all when None. [N]
        """
        if cpu_loops(points):
            arrays = [t.contiguous().numpy() for t in (points, weights, starts)]
            loops = compiled("xplanes.rendering.cpu")
            loops.mark_seen(*arrays, LIT, NOW, self.resolution, self.last.numpy())
            return
        lit = 1 - depth_before(weights, ray, starts) > LIT
        cells = self.cells(points)
        if live is not None:
            # No mark changes nothing anywhere; at one place the others would queue to write it.
            spread = torch.arange(len(live), device=live.device) % len(self.last)
            lit, cells = lit & live, torch.where(live, cells, spread)
        self.last.scatter_reduce_(0, cells, (lit * NOW).to(torch.uint8), "amax")

    @torch.no_grad()
    def forget(self) -> None:
        """Forget the rays before the last time that this was asked."""
        self.last.clamp_(min=1).sub_(1)

    def sees(self, points: Tensor) -> Tensor:
        """Whether points of the cube lie in cells that are seen. [N, 3] -> bool [N]"""
        return self.last[self.cells(points)] > 0


def _resize(module: Visibility, state: dict[str, Tensor], prefix: str, *rest: object) -> None:
    """Take on a stored state's resolution: without the views, which it lacks, it is not known."""
    stored = state.get(f"{prefix}last")
    if stored is not None and len(stored) != len(module.last):
        module.resolution = round(len(stored) ** (1 / 3))
        module.last = module.last.new_full((len(stored),), BEFORE)


def finest_cells(views: Views, frame: Frame, least: int) -> int:
    """Cells along each side of the cube that are as wide as the pixels of most views.

    Smaller cells might lie between the rays of all pixels.

    Args:
        views: Training views.
        frame: The field's frame.
        least: The smallest number to return.

    Returns:
        At most `FINEST`, or ``least`` where that is more.
    """
    away = (views.camera_to_world[:, :3, 3].double() - frame.centre.double()).norm(dim=-1)
    pixel = frame.scale * away / views.intrinsics.focal.mean(dim=-1)
    return max(least, int(2 / max(float(pixel.median()), 2 / FINEST)))
