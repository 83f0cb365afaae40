"""The occupancy grid in training."""

from typing import Any

from torch import nn

from xplanes.config import SamplerConfig
from xplanes.rendering.base import Rendering
from xplanes.rendering.renderer import Renderer
from xplanes.scenes.batches import Batch, step_generator
from xplanes.training.sampling.base import Moment, Sampling

GRID_STREAM = 1_000_003
"""Random stream of the occupancy grid, equal on all ranks so that their grids stay equal."""


class OccupancySampling(Sampling):
    """Equal steps through occupied cells; the grid is kept up to date here.

    Args:
        renderer: Its grid is changed in place.
        config: Upkeep of the grid.
    """

    def __init__(self, renderer: Renderer, config: SamplerConfig) -> None:
        self._renderer, self.config = renderer, config
        self.grid = renderer.grid

    @property
    def renderer(self) -> Renderer:
        return self._renderer

    @property
    def parts(self) -> dict[str, nn.Module]:
        return {"grid": self.grid}

    @property
    def outline(self) -> str:
        return f"{100 * self.grid.occupied_fraction:.0f}% of the cube may be occupied"

    def first_rays(self, most: int) -> int:
        return min(most, 256)

    def stride(self, step: int) -> int:
        """Steps that one sample stands for: the first training steps look at half the samples."""
        return 2 if step < self.config.coarse_steps else 1

    def render(self, field: Any, rays: Batch, moment: Moment) -> Rendering:
        return self._renderer.render(
            field,
            rays["origins"],
            rays["directions"],
            rays["times"],
            rays["background"],
            rays["jitter"],
            stride=self.stride(moment.step),
        )

    def observe(self, rendering: Rendering) -> None:
        self.grid.observe(rendering.samples.cells, rendering.density)

    def keep_up(self, field: Any, moment: Moment) -> None:
        step = moment.step
        generator = step_generator(moment.seed, step, GRID_STREAM)
        if step in self.config.sweep_at or (step and step % self.config.sweep_every == 0):
            self.grid.sweep(field, generator)
        elif step % self.config.update_every == 0:
            self.grid.update(field, self.config.update_cells, generator)

    def scalars(self) -> dict[str, float]:
        return {"sampler/occupied": self.grid.occupied_fraction}
