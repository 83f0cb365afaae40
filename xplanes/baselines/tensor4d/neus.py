"""Renders signed distances as NeuS does: opacity where a ray enters the surface from outside."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from xplanes.baselines.proposal import dense_samples
from xplanes.baselines.resampling import resample
from xplanes.baselines.stateless import StatelessSampler
from xplanes.errors import ConfigError
from xplanes.fields.base import RadianceField
from xplanes.rendering.base import RayRenderer, Rendering
from xplanes.rendering.sampler import SamplerSettings, Site
from xplanes.settings import Count, Positive

TINY = 1e-5
"""Added to denominators and weights that may be 0."""


@dataclass(frozen=True)
class SurfaceRendering(Rendering):
    """A rendering with the M of its N samples that are in the field's cube.

    Attributes:
        places: Positions of these samples in canonical space. [M, 3]
        slopes: Gradients of the distance with respect to the samples, through the flow. [M, 3]
        weights: Compositing weight of each of them, without gradient. [M]

    ``density`` is the depth of these samples below the surface, the negative distance. [M]
    """

    places: Tensor
    slopes: Tensor
    weights: Tensor


def section_opacity(
    distance: Tensor, change: Tensor, lengths: Tensor, sharpness: Tensor | float
) -> Tensor:
    """Opacity of sections of rays, from the signed distance at their midpoints.

    Args:
        distance: Signed distance at the midpoint. [...]
        change: Derivative of the distance along the ray, at most 0. [...]
        lengths: Length of the section. [...]
        sharpness: Steepness of the logistic function from distance to opacity.

    Returns:
        From 0 to 1. [...]

    Source: NeuS, Eq. 13.
    """
    half = change * lengths / 2
    before = ((distance - half) * sharpness).sigmoid()
    after = ((distance + half) * sharpness).sigmoid()
    return ((before - after + TINY) / (before + TINY)).clamp(0, 1)


def weights_of(opacity: Tensor) -> Tensor:
    """Compositing weights of samples from their opacities. [R, S] -> [R, S]"""
    through = torch.cat([torch.ones_like(opacity[:, :1]), 1 - opacity + 1e-7], dim=1)
    return opacity * through.cumprod(dim=1)[:, :-1]


class NeusRenderer(RayRenderer):
    """Uniform samples over the diameter of the unit sphere, then importance samples at the surface.

    Args:
        field: Has ``canonical``, ``distance``, ``distance_and_slope``, ``colour``, ``sharpness``.
        samples: Number of uniform samples.
        more: Number of importance samples.
        coarse_sharpness: Sharpness for the weights of the importance sampling.

    Source: NeuS and Tensor4D, released code.
    """

    rays_at_once = 512

    def __init__(self, field: Any, *, samples: int, more: int, coarse_sharpness: float) -> None:
        self.field, self.samples, self.more = field, samples, more
        self.coarse_sharpness = coarse_sharpness

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
        jitter: Tensor | None = None,
    ) -> SurfaceRendering:
        ends = self.place(field, origins, directions, times, jitter)
        lengths = ends.diff(dim=1)
        lengths = torch.cat([lengths, torch.full_like(lengths[:, :1], 2 / self.samples)], dim=1)
        distances = ends + lengths / 2
        shape = distances.shape
        samples = dense_samples(_points(origins, directions, distances), distances)
        # The field is empty outside the cube and is not evaluated there.
        inside = (samples.points.abs() <= 1).all(dim=1).nonzero()[:, 0]
        points, ray = samples.points[inside], samples.ray[inside]
        facing = directions[ray]
        distance, slopes, features, places = field.distance_and_slope(points, times[ray])
        change = -(-(facing * slopes).sum(dim=1)).relu()
        opacity = section_opacity(distance, change, lengths.flatten()[inside], field.sharpness)
        opacity = torch.zeros_like(samples.distances).index_put((inside,), opacity)
        weights = weights_of(opacity.view(shape))
        colours = field.colour(points, slopes, features, facing)
        colours = torch.zeros_like(samples.points).index_put((inside,), colours).view(*shape, 3)
        total = weights.sum(dim=1)
        return SurfaceRendering(
            colour=(weights[..., None] * colours).sum(dim=1) + (1 - total)[:, None] * background,
            opacity=total,
            depth=((weights * distances).sum(dim=1) / total.clamp_min(1e-6)).detach(),
            density=(-distance).detach(),
            samples=samples,
            places=places,
            slopes=slopes,
            weights=weights.detach().flatten()[inside],
        )

    @torch.no_grad()
    def place(
        self,
        field: Any,
        origins: Tensor,
        directions: Tensor,
        times: Tensor,
        jitter: Tensor | None,
    ) -> Tensor:
        """Ascending distances at which sections begin. [R, samples + more]

        Args:
            field: As for `render`.
            origins: [R, 3]
            directions: Unit directions. [R, 3]
            times: [R]
            jitter: Random numbers from 0 to 1 that move uniform samples by up to half a step. [R]
        """
        closest = -(origins * directions).sum(dim=1, keepdim=True)
        steps = torch.linspace(-1, 1, self.samples, device=origins.device)
        ends = (closest + steps).clamp_min(0)
        if jitter is not None:
            ends = (ends + (jitter[:, None] - 0.5) * 2 / self.samples).clamp_min(0)
        points = _points(origins, directions, ends)
        places = field.canonical(points, times.repeat_interleave(self.samples))
        distance = field.distance(places)[0].view_as(ends)
        lengths = ends.diff(dim=1)
        change = distance.diff(dim=1) / (lengths + TINY)
        # The steeper of two neighbours, so that surfaces at grazing angles are not missed.
        before = torch.cat([torch.zeros_like(change[:, :1]), change[:, :-1]], dim=1)
        near = points.view(*ends.shape, 3).norm(dim=2) < 1
        change = torch.minimum(before, change).clamp(-1e3, 0) * (near[:, 1:] | near[:, :-1])
        middle = (distance[:, 1:] + distance[:, :-1]) / 2
        opacity = section_opacity(middle, change, lengths, self.coarse_sharpness)
        more = resample(ends, weights_of(opacity), self.more - 1, None, TINY)
        return torch.cat([ends, more], dim=1).sort(dim=1).values


def _points(origins: Tensor, directions: Tensor, distances: Tensor) -> Tensor:
    """Points at distances [R, S] along rays. [R S, 3]"""
    return (origins[:, None] + distances[..., None] * directions[:, None]).flatten(0, 1)


@dataclass(frozen=True, kw_only=True)
class NeusSettings(SamplerSettings):
    """Coarse samples, then importance samples near the surface that they find."""

    samples: Count  # Uniform coarse samples per ray.
    more_samples: Count  # Importance samples near the surface.
    coarse_sharpness: Positive  # Sharpness of the importance sampling.

    def require(self, field: RadianceField | type[RadianceField]) -> None:
        if not hasattr(field, "distance_and_slope"):
            raise ConfigError(
                f"model.sampler.name={self.name}: needs a field with a surface, like Tensor4D; set "
                "model/sampler=occupancy or proposal"
            )

    def build(self, field: RadianceField, site: Site) -> StatelessSampler:
        self.require(field)
        renderer = NeusRenderer(
            field,
            samples=self.samples,
            more=self.more_samples,
            coarse_sharpness=self.coarse_sharpness,
        )
        outline = f"{self.samples} samples a ray, {self.more_samples} near the surface"
        return StatelessSampler(renderer, outline)
