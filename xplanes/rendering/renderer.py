"""Rays through a field to colours."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from xplanes.rendering.box import Field
from xplanes.rendering.compositing import composite
from xplanes.rendering.marching import Samples, march
from xplanes.rendering.occupancy import OccupancyGrid

DIAGONAL = 2 * math.sqrt(3)
"""Longest way through the field's cube."""


@dataclass(frozen=True)
class Rendering:
    """What rays see.

    Attributes:
        colour: In front of the background. [R, 3]
        opacity: Share of the light that the scene stops. [R]
        depth: Mean distance of what is seen, 0 where nothing is. [R]
        density: Density of each sample, without gradient. [N]
        samples: The samples that reached the field.
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    density: Tensor
    samples: Samples


@dataclass(frozen=True)
class Renderer:
    """Renders rays through a field, skipping what cannot be seen.

    Attributes:
        grid: Which cells hold something, and when.
        samples: Steps along the diagonal of the field's cube.
        skip_empty: Skip samples in empty cells.
        occlusion: Skip samples behind surfaces that leave less light than this; 0 skips none.
    """

    grid: OccupancyGrid
    samples: int
    skip_empty: bool = True
    occlusion: float = 0.001

    @property
    def step(self) -> float:
        """Distance between samples in the field's frame."""
        return DIAGONAL / self.samples

    def render(
        self,
        field: Field,
        origins: Tensor,
        directions: Tensor,
        times: Tensor,
        background: Tensor,
        jitter: Tensor | None = None,
        stride: int = 1,
    ) -> Rendering:
        """Render rays.

        Args:
            field: From points and times to colour and density.
            origins: Ray origins in the field's frame. [R, 3]
            directions: Unit directions. [R, 3]
            times: Time of each ray, from 0 to 1. [R]
            background: Colour behind the scene. [3] or [R, 3]
            jitter: Place of each ray's samples within their steps; the middle when None. [R]
            stride: Steps that one sample stands for.

        Returns:
            One value per ray; gradients reach the field.
        """
        step = self.step * stride
        samples = march(
            origins,
            directions,
            times,
            torch.full_like(times, 0.5) if jitter is None else jitter,
            self.grid,
            step=step,
            skip_empty=self.skip_empty,
            occlusion=self.occlusion,
        )
        colour, density = field(samples.points, times[samples.ray])
        total, _ = composite(density * step, colour, samples.distances, samples.ray, samples.starts)
        opacity = total[:, 3]
        return Rendering(
            colour=total[:, :3] + (1 - opacity)[:, None] * background,
            opacity=opacity,
            depth=(total[:, 4] / opacity.clamp_min(1e-6)).detach(),
            density=density.detach(),
            samples=samples,
        )

    @torch.no_grad()
    def image(
        self,
        field: Field,
        origins: Tensor,
        directions: Tensor,
        time: float,
        background: Tensor,
        *,
        stride: int = 1,
        chunk: int = 8192,
    ) -> dict[str, Tensor]:
        """Render any number of rays of one moment, a chunk at a time.

        Returns:
            ``colour`` [R, 3], ``opacity`` [R] and ``depth`` [R], on the rays' device.
        """
        parts = []
        for start in range(0, max(len(origins), 1), chunk):
            rays = origins[start : start + chunk], directions[start : start + chunk]
            times = torch.full_like(rays[0][:, 0], time)
            part = self.render(field, *rays, times, background, stride=stride)
            parts.append((part.colour, part.opacity, part.depth))
        colour, opacity, depth = (torch.cat(part) for part in zip(*parts, strict=True))
        return {"colour": colour, "opacity": opacity, "depth": depth}
