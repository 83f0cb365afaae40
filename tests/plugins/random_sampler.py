"""A sampler of one's own: points uniformly at random along each ray in the cube."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from xplanes.baselines.proposal import dense_samples
from xplanes.fields.base import RadianceField
from xplanes.rendering.base import RayRenderer, Rendering
from xplanes.rendering.box import ray_box, shade
from xplanes.rendering.compositing import composite
from xplanes.rendering.sampler import Sampler, SamplerSettings, Site
from xplanes.scenes.batches import Batch
from xplanes.settings import Count
from xplanes.streams import TrainingState


class RandomRenderer(RayRenderer):
    """Sorted random distances between where a ray enters the cube and where it leaves it."""

    def __init__(self, field: RadianceField, samples: int) -> None:
        self.field, self.samples = field, samples

    @property
    def device(self) -> torch.device:
        return next(self.field.parameters()).device

    def render(
        self,
        field: Any,
        origins: Tensor,
        directions: Tensor,
        times: Tensor,
        background: Tensor,
        jitter: torch.Generator | None = None,
    ) -> Rendering:
        near, far = ray_box(origins, directions)
        shape = (len(origins), self.samples + 1)
        ends = torch.linspace(0, 1, shape[1], device=origins.device).expand(shape)
        if jitter is not None:
            ends = torch.rand(shape, generator=jitter, device=origins.device).sort(dim=1).values
        ends = near[:, None] + ends * (far - near)[:, None]
        distances, lengths = (ends[:, 1:] + ends[:, :-1]) / 2, ends.diff(dim=1)
        points = origins[:, None] + distances[..., None] * directions[:, None]
        samples = dense_samples(points.flatten(0, 1), distances)
        colour, density = shade(field, samples.points, times, directions, samples.ray)
        total, _ = composite(
            density * lengths.flatten(), colour, samples.distances, samples.ray, samples.starts
        )
        return Rendering(
            colour=total[:, :3] + (1 - total[:, 3])[:, None] * background,
            opacity=total[:, 3],
            depth=total[:, 4].detach(),
            density=density.detach(),
            samples=samples,
        )


@dataclass(frozen=True, kw_only=True)
class RandomSamplerSettings(SamplerSettings):
    """Uniformly random samples."""

    samples: Count

    def build(self, field: RadianceField, site: Site) -> "RandomSampler":
        return RandomSampler(RandomRenderer(field, self.samples))


class RandomSampler(Sampler):
    """Nothing is kept up to date: chance places the samples."""

    def __init__(self, renderer: RandomRenderer) -> None:
        self._renderer = renderer

    @property
    def renderer(self) -> RandomRenderer:
        return self._renderer

    def render(self, field: Any, rays: Batch, state: TrainingState) -> Rendering:
        parts = (rays[name] for name in ("origins", "directions", "times", "background"))
        return self._renderer.render(field, *parts, state.generator(rays["times"].device))
