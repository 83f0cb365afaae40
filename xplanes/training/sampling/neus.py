"""Samples near a surface, in training."""

from typing import Any

from xplanes.rendering.neus import NeusRenderer, SurfaceRendering
from xplanes.scenes.batches import Batch
from xplanes.training.sampling.base import Moment, Sampling


class NeusSampling(Sampling):
    """Nothing to keep up: the field's own distance places the samples.

    Args:
        renderer: Places them.
    """

    def __init__(self, renderer: NeusRenderer) -> None:
        self._renderer = renderer

    @property
    def renderer(self) -> NeusRenderer:
        return self._renderer

    @property
    def outline(self) -> str:
        return f"{self._renderer.samples} samples a ray, {self._renderer.more} near the surface"

    def render(self, field: Any, rays: Batch, moment: Moment) -> SurfaceRendering:
        return self._renderer.render(
            field,
            rays["origins"],
            rays["directions"],
            rays["times"],
            rays["background"],
            rays["jitter"],
        )
