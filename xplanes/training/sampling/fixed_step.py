"""Equal steps through a field's box, in training."""

from typing import Any

from xplanes.rendering.fixed_step import FixedStepRenderer, FixedStepRendering
from xplanes.scenes.batches import Batch
from xplanes.training.sampling.base import Moment, Sampling


class FixedStepSampling(Sampling):
    """Nothing to keep up: samples lie where the box and the cells' size put them, without jitter.

    Args:
        renderer: Places them.
    """

    def __init__(self, renderer: FixedStepRenderer) -> None:
        self._renderer = renderer

    @property
    def renderer(self) -> FixedStepRenderer:
        return self._renderer

    @property
    def outline(self) -> str:
        return f"samples {self._renderer.step:g} cells apart throughout the field's box"

    def render(self, field: Any, rays: Batch, moment: Moment) -> FixedStepRendering:
        return self._renderer.render(
            field, rays["origins"], rays["directions"], rays["times"], rays["background"]
        )
