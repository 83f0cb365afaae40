"""Rays through a field to colours, by equal steps through occupied cells."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from xplanes.rendering.base import RayRenderer, Rendering
from xplanes.rendering.box import Field, shade
from xplanes.rendering.compositing import composite
from xplanes.rendering.marching import march
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.thinning import Cut

DIAGONAL = 2 * math.sqrt(3)
"""Longest way through the field's cube."""


@dataclass(frozen=True)
class Renderer(RayRenderer):
    """Renders rays through a field, skipping what cannot be seen.

    Attributes:
        grid: Which cells hold something, and when.
        samples: Steps along the diagonal of the field's cube.
        skip_empty: Skip samples in empty cells.
        occlusion: Skip samples behind surfaces that leave less light than this; 0 skips none.
        thinning: Where gradients are wanted, samples whose own is below this times the mean may be
            left out, see `Cut.pass_on`; 0 leaves none out.
    """

    grid: OccupancyGrid
    samples: int
    skip_empty: bool = True
    occlusion: float = 0.001
    thinning: float = 0.0

    @property
    def device(self) -> torch.device:
        return self.grid.density.device

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
    ) -> Rendering:
        """Render rays.

        Args:
            field: From points and times to colour and density.
            origins: Ray origins in the field's frame. [R, 3]
            directions: Unit directions. [R, 3]
            times: Time of each ray, from 0 to 1. [R]
            background: Colour behind the scene. [3] or [R, 3]
            jitter: Place of each ray's samples within their steps; the middle when None. [R]

        Returns:
            One value per ray; gradients reach the field, with `thinning` once ``cut`` passes them
            on.
        """
        samples = march(
            origins,
            directions,
            times,
            torch.full_like(times, 0.5) if jitter is None else jitter,
            self.grid,
            step=self.step,
            skip_empty=self.skip_empty,
            occlusion=self.occlusion,
        )

        def ask(chosen: Tensor | slice) -> tuple[Tensor, Tensor]:
            points, ray = samples.points[chosen], samples.ray[chosen]
            return shade(field, points, times, directions, ray)

        thin = self.thinning > 0 and torch.is_grad_enabled()
        cut = Cut.of(ask, self.thinning) if thin else None
        colour, density = (cut.colour, cut.density) if cut else ask(slice(None))
        total, _ = composite(
            density * self.step, colour, samples.distances, samples.ray, samples.starts
        )
        opacity = total[:, 3]
        return Rendering(
            colour=total[:, :3] + (1 - opacity)[:, None] * background,
            opacity=opacity,
            depth=(total[:, 4] / opacity.clamp_min(1e-6)).detach(),
            density=density.detach(),
            samples=samples,
            cut=cut,
        )
