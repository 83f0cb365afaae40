"""A sampler that renders rays and learns nothing itself."""

from typing import Any

from xplanes.rendering.base import RayRenderer, Rendering
from xplanes.rendering.sampler import Sampler
from xplanes.scenes.batches import Batch
from xplanes.streams import TrainingState


class StatelessSampler(Sampler):
    """Renders batches with a renderer that has no state to update.

    Args:
        renderer: The renderer.
        outline: Short description for reports.
    """

    def __init__(self, renderer: RayRenderer, outline: str) -> None:
        self._renderer, self._outline = renderer, outline

    @property
    def renderer(self) -> RayRenderer:
        return self._renderer

    @property
    def outline(self) -> str:
        return self._outline

    def render(self, field: Any, rays: Batch, state: TrainingState) -> Rendering:
        names = ("origins", "directions", "times", "background", "jitter")
        return self._renderer.render(field, *(rays[name] for name in names))
