"""The occupancy grid in training."""

import math
from dataclasses import replace
from typing import Any

from torch import distributed, nn

from xplanes.config import SamplerConfig
from xplanes.rendering.base import Rendering
from xplanes.rendering.renderer import Renderer
from xplanes.scenes.batches import Batch, step_generator
from xplanes.training.sampling.base import Moment, Sampling

GRID_STREAM = 1_000_003
"""Random stream of the occupancy grid, the same on all ranks."""

THINNING_STREAM = 1_000_241
"""Random stream of the samples whose gradients are passed on."""


class OccupancySampling(Sampling):
    """Equal steps through occupied cells; the grid is kept up to date here.

    Args:
        renderer: Its grid is changed in place.
        config: Upkeep of the grid.
    """

    def __init__(self, renderer: Renderer, config: SamplerConfig) -> None:
        self.config, self.grid = config, renderer.grid
        self._training = replace(renderer, thinning=config.thinning)
        self._coarse = replace(self._training, samples=math.ceil(renderer.samples / 2))
        self._pictures = replace(renderer, samples=config.render_samples)

    @property
    def renderer(self) -> Renderer:
        return self._pictures

    @property
    def parts(self) -> dict[str, nn.Module]:
        return {"grid": self.grid}

    @property
    def outline(self) -> str:
        return f"{100 * self.grid.occupied_fraction:.0f}% of the cube may be occupied"

    def first_rays(self, most: int) -> int:
        return min(most, 256)

    def renderer_at(self, step: int) -> Renderer:
        # At first the grid hides little, and pictures of all samples would take longer than steps.
        return self._coarse if step < self.config.coarse_steps else self._pictures

    def render(self, field: Any, rays: Batch, moment: Moment) -> Rendering:
        coarse = moment.step < self.config.coarse_steps
        return (self._coarse if coarse else self._training).render(
            field,
            rays["origins"],
            rays["directions"],
            rays["times"],
            rays["background"],
            rays["jitter"],
        )

    def pass_on(self, rendering: Rendering, moment: Moment) -> int:
        if rendering.cut is None:
            return len(rendering.samples)
        return rendering.cut.pass_on(moment.generator(rendering.density.device, THINNING_STREAM))

    def observe(self, rendering: Rendering) -> None:
        self.grid.observe(rendering.samples.cells, rendering.density)

    def keep_up(self, field: Any, moment: Moment) -> None:
        step, config = moment.step, self.config
        sweeping = step in config.sweep_at or (step > 0 and step % config.sweep_every == 0)
        if not sweeping and step % config.update_every:
            return
        self._agree()
        generator = step_generator(moment.seed, step, GRID_STREAM)
        if sweeping:
            self.grid.sweep(field, generator)
        else:
            self.grid.update(field, config.update_cells, generator)

    def _agree(self) -> None:
        """Go on with the first process's grid: each has seen the samples of its own rays."""
        if distributed.is_available() and distributed.is_initialized():
            for part in (self.grid.density, self.grid.occupied):
                distributed.broadcast(part, src=0)

    def scalars(self) -> dict[str, float]:
        return {"sampler/occupied": self.grid.occupied_fraction}
