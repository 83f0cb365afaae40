"""Rays through a field, sampled where small density fields expect something."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from xplanes.rendering.base import RayRenderer, Rendering
from xplanes.rendering.box import ray_box, shade
from xplanes.rendering.compositing import composite
from xplanes.rendering.marching import Samples
from xplanes.rendering.resampling import ray_weights, resample, uniform_edges


@dataclass(frozen=True)
class Level:
    """Samples of one round.

    Attributes:
        edges: Ends of the samples, from 0 at near to 1 at far. [R, S + 1]
        weights: Share of the light that each sample sends. [R, S]
    """

    edges: Tensor
    weights: Tensor


@dataclass(frozen=True)
class ProposalRendering(Rendering):
    """What rays see, and what the density fields expected.

    Attributes:
        levels: One for each density field, gradients reach these; then the field's own, without.
    """

    levels: tuple[Level, ...]


class ProposalRenderer(RayRenderer):
    """Samples equal bins in the first density field, then in each next one where the last saw most.

    Args:
        proposals: Density fields: from points [N, 3] and times [N] to density [N].
        counts: Samples of a ray in each of them.
        samples: Samples of a ray in the field.
        near: Distance at which samples begin, in the field's frame; None where rays enter the cube.
        far: Distance at which they end; None where rays leave the cube.
        padding: As for `resample`.

    Source: K-Planes, released code; Mip-NeRF 360, Section 3.
    """

    rays_at_once = 2048

    def __init__(
        self,
        proposals: nn.ModuleList,
        counts: Sequence[int],
        samples: int,
        *,
        near: float | None = None,
        far: float | None = None,
        padding: float = 0.01,
    ) -> None:
        self.proposals, self.counts, self.samples = proposals, tuple(counts), samples
        self.near, self.far, self.padding = near, far, padding
        # With the density fields it goes into checkpoints, and to their device.
        proposals.register_buffer("exponent", torch.ones(()))

    @property
    def exponent(self) -> Tensor:
        """Exponent of the weights before samples are drawn; training sets it. []"""
        return self.proposals.get_buffer("exponent")

    @property
    def device(self) -> torch.device:
        return next(self.proposals.parameters()).device

    def render(
        self,
        field: Any,
        origins: Tensor,
        directions: Tensor,
        times: Tensor,
        background: Tensor,
        jitter: torch.Generator | None = None,
        *,
        learn: bool = False,
    ) -> ProposalRendering:
        """Render rays.

        Args:
            field: From points, times and, if it is ``view_dependent``, directions to colour and
                density.
            origins: Ray origins in the field's frame. [R, 3]
            directions: Unit directions. [R, 3]
            times: Time of each ray, from 0 to 1. [R]
            background: Colour behind the scene. [3] or [R, 3]
            jitter: Moves all samples; None leaves them where they are.
            learn: Whether gradients reach the density fields.

        Returns:
            One value per ray; gradients reach the field.
        """
        near, far = self._range(origins, directions)
        place = _Rays(origins, directions, near, far)
        levels = []
        with torch.set_grad_enabled(learn and torch.is_grad_enabled()):
            for proposal, count in zip(self.proposals, self.counts, strict=True):
                edges = self._edges(levels, count, place, jitter)
                distances, lengths, points = place.samples(edges)
                density = proposal(points, times.repeat_interleave(count))
                weights = ray_weights(density.view_as(distances) * lengths)
                levels.append(Level(edges, weights))
        edges = self._edges(levels, self.samples, place, jitter)
        distances, lengths, points = place.samples(edges)
        samples = dense_samples(points, distances)
        colour, density = shade(field, points, times, directions, samples.ray)
        total, weights = composite(
            density * lengths.flatten(), colour, samples.distances, samples.ray, samples.starts
        )
        levels.append(Level(edges, weights.view_as(distances)))
        opacity = total[:, 3]
        return ProposalRendering(
            colour=total[:, :3] + (1 - opacity)[:, None] * background,
            opacity=opacity,
            depth=(total[:, 4] / opacity.clamp_min(1e-6)).detach(),
            density=density.detach(),
            samples=samples,
            levels=tuple(levels),
        )

    def _range(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        if self.near is None or self.far is None:
            return ray_box(origins, directions)
        ones = torch.ones_like(origins[:, 0])
        return self.near * ones, self.far * ones

    def _edges(
        self,
        levels: Sequence[Level],
        count: int,
        rays: "_Rays",
        jitter: torch.Generator | None,
    ) -> Tensor:
        uniform, device = None, rays.near.device
        if jitter is not None:
            uniform = torch.rand(len(rays.near), count + 1, generator=jitter, device=device)
        if not levels:
            return uniform_edges(len(rays.near), count, uniform, device)
        last = levels[-1]
        weights = last.weights.detach() ** self.exponent
        return resample(last.edges, weights, count, uniform, self.padding)


@dataclass(frozen=True)
class _Rays:
    origins: Tensor
    directions: Tensor
    near: Tensor
    far: Tensor

    def samples(self, edges: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distances and lengths [R, S] and points [R S, 3] of the bins between ``edges``."""
        ends = self.near[:, None] + edges * (self.far - self.near)[:, None]
        distances = (ends[:, 1:] + ends[:, :-1]) / 2
        points = self.origins[:, None] + distances[..., None] * self.directions[:, None]
        return distances, ends[:, 1:] - ends[:, :-1], points.flatten(0, 1)


def dense_samples(points: Tensor, distances: Tensor) -> Samples:
    """Equally many samples on each ray, none of them dropped. [R S, 3], [R, S]"""
    rays, count = distances.shape
    index = torch.arange(rays, device=distances.device)
    return Samples(
        ray=index.repeat_interleave(count),
        starts=index * count,
        points=points,
        distances=distances.flatten(),
        cells=index.new_empty(0),
        candidates=rays * count,
        empty=0,
        occluded=0,
    )
