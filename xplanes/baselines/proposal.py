"""Proposal sampling: small density fields, trained jointly, place the samples."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from xplanes.baselines.bounds import check_range
from xplanes.baselines.kplanes.field import DensityField
from xplanes.baselines.products import PlaneProducts, PlaneTerms
from xplanes.baselines.resampling import covering_weights, ray_weights, resample, uniform_edges
from xplanes.errors import ConfigError
from xplanes.fields.base import RadianceField
from xplanes.rendering.base import RayRenderer, Rendering
from xplanes.rendering.behind import behind
from xplanes.rendering.box import ray_box, shade
from xplanes.rendering.compositing import composite
from xplanes.rendering.marching import Samples
from xplanes.rendering.sampler import Group, Sampler, SamplerSettings, Site
from xplanes.scenes.batches import Batch
from xplanes.settings import Count, Positive, Weight
from xplanes.streams import Stream, TrainingState, initial_values

ALWAYS = 10
"""Number of first steps, in all of which the density fields are updated."""

NEAREST, FARTHEST = 0.05, 1000.0
"""Near and far bounds for contracted space, in units of the field's frame."""

SMALLEST = 1e-7
"""Added to the denominator of the histogram loss."""


@dataclass(frozen=True)
class Level:
    """Samples of one density field or of the field.

    Attributes:
        edges: Edges of the samples' bins, from 0 at near to 1 at far. [R, S + 1]
        weights: Compositing weights of the samples. [R, S]
    """

    edges: Tensor
    weights: Tensor


@dataclass(frozen=True)
class ProposalRendering(Rendering):
    """A rendering with the samples of all density fields.

    Attributes:
        levels: One per density field, with gradients; then the field's own, without.
    """

    levels: tuple[Level, ...]


class ProposalRenderer(RayRenderer):
    """Samples the first density field uniformly, then each next field by the previous weights.

    Args:
        proposals: Density fields: from points [N, 3] and times [N] to density [N].
        counts: Samples per ray in each density field.
        samples: Samples per ray in the field.
        near: Near bound in the field's frame; None for the distance at which rays enter the cube.
        far: Far bound; None for the distance at which rays leave the cube.
        padding: See `resample`.
        contracted: Whether to sample all of space: uniformly in distance up to 1, uniformly in
            inverse distance beyond.

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
        contracted: bool = False,
    ) -> None:
        self.proposals, self.counts, self.samples = proposals, tuple(counts), samples
        self.contracted = contracted
        self.near, self.far, self.padding = near, far, padding
        # As a buffer of the density fields it is saved in checkpoints and moved to their device.
        proposals.register_buffer("exponent", torch.ones(()))

    @property
    def exponent(self) -> Tensor:
        """Exponent of the weights for resampling; training anneals it. []"""
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
            field: Field from points, times and, if ``view_dependent``, directions to colour and
                density.
            origins: Ray origins in the field's frame. [R, 3]
            directions: Unit directions. [R, 3]
            times: Time of each ray, from 0 to 1. [R]
            background: Background colour. [3] or [R, 3]
            jitter: Generator of random numbers for stratified sampling; None for no jitter.
            learn: Whether gradients reach the density fields.

        Returns:
            The rendering; gradients reach the field.
        """
        if self.near is None or self.far is None:
            bounds = ray_box(origins, directions)
        else:
            bounds = (torch.full_like(origins[:, 0], bound) for bound in (self.near, self.far))
        near, far = (bound[:, None] for bound in bounds)
        levels: list[Level] = []

        def placed(count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            """Edges of the next level, its distances and lengths [R, S], and points [R S, 3]."""
            edges = self._edges(levels, near, count, jitter)
            if self.contracted:
                ends = unspaced(torch.lerp(spaced(near), spaced(far), edges))
            else:
                ends = near + edges * (far - near)
            distances = (ends[:, 1:] + ends[:, :-1]) / 2
            points = origins[:, None] + distances[..., None] * directions[:, None]
            return edges, distances, ends[:, 1:] - ends[:, :-1], points.flatten(0, 1)

        with torch.set_grad_enabled(learn and torch.is_grad_enabled()):
            for proposal, count in zip(self.proposals, self.counts, strict=True):
                edges, distances, lengths, points = placed(count)
                density = proposal(points, times.repeat_interleave(count))
                weights = ray_weights(density.view_as(distances) * lengths)
                levels.append(Level(edges, weights))
        edges, distances, lengths, points = placed(self.samples)
        samples = dense_samples(points, distances)
        colour, density = shade(field, points, times, directions, samples.ray)
        total, weights = composite(
            density * lengths.flatten(), colour, samples.distances, samples.ray, samples.starts
        )
        levels.append(Level(edges, weights.view_as(distances)))
        opacity = total[:, 3]
        background = behind(field, origins, directions, opacity, background)
        return ProposalRendering(
            colour=total[:, :3] + (1 - opacity)[:, None] * background,
            opacity=opacity,
            depth=(total[:, 4] / opacity.clamp_min(1e-6)).detach(),
            density=density.detach(),
            samples=samples,
            levels=tuple(levels),
        )

    def _edges(
        self, levels: Sequence[Level], near: Tensor, count: int, jitter: torch.Generator | None
    ) -> Tensor:
        uniform, device = None, near.device
        if jitter is not None:
            uniform = torch.rand(len(near), count + 1, generator=jitter, device=device)
        if not levels:
            return uniform_edges(len(near), count, uniform, device)
        last = levels[-1]
        weights = last.weights.detach() ** self.exponent
        return resample(last.edges, weights, count, uniform, self.padding)


def spaced(distances: Tensor) -> Tensor:
    """Map distances to [0, 1): linear up to a distance of 1, linear in its inverse beyond. [...]

    Source: K-Planes, released code.
    """
    return torch.where(distances < 1, distances / 2, 1 - 1 / (2 * distances.clamp_min(1)))


def unspaced(places: Tensor) -> Tensor:
    """The inverse of `spaced`, for numbers below 1. [...]"""
    return torch.where(places < 0.5, 2 * places, 1 / (2 - 2 * places.clamp_min(0.5)))


def dense_samples(points: Tensor, distances: Tensor) -> Samples:
    """`Samples` with equally many per ray, none of them dropped. [R S, 3], [R, S]"""
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


@dataclass(frozen=True, kw_only=True)
class ProposalSettings(SamplerSettings):
    """Samples placed by small density fields, which are trained jointly."""

    devices: ClassVar[int | None] = 1

    near: Weight | None  # Near bound in world units; null: the cube. Unused if space is contracted.
    far: Positive | None  # Far bound in world units; null: the cube. Unused if space is contracted.
    samples: Count  # Samples per ray in the field.
    proposal_samples: list[Count]  # Samples per ray in each density field.
    resolutions: list[Count]  # Texels along each space axis of each density field.
    time_resolution: Count  # Rows along time of the density fields.
    channels: Count  # Channels of the density fields' planes.
    width: Count  # Neurons of the density fields' hidden layer.
    linear: bool  # Density fields without activation, as in K-Planes (explicit).
    space_low: float  # Lower bound of the uniform initialisation of space planes.
    space_high: float  # Upper bound. Time planes are initialised to 1.
    padding: Positive  # Padding of the histogram of weights.
    anneal_steps: Count  # Steps over which the exponent of the weights anneals to 1.
    anneal_slope: Positive  # Initial slope of the annealing.
    update_every: Count  # Final number of steps between updates of the density fields.
    update_warmup: Count  # Steps over which this interval grows to its final value.
    histogram: Weight  # Weight of the proposal loss.
    variation: Literal["coded", "corrected"]  # Form of the total variation.
    total_variation: Weight  # Weight of total variation.
    time_smoothness: Weight  # Weight of time smoothness.
    time_identity: Weight  # Weight of the distance of time planes from 1.
    learning_rate: Positive  # Learning rate of the density fields.

    def check(self) -> None:
        for name in ("proposal_samples", "resolutions"):
            if not getattr(self, name):
                raise ConfigError(f"{name}=[]: must be one or more numbers above 0")
        if len(self.proposal_samples) != len(self.resolutions):
            raise ConfigError(
                f"proposal_samples={self.proposal_samples} with resolutions={self.resolutions}: "
                "both need one number per density field"
            )
        if (self.near is None) != (self.far is None):
            raise ConfigError(
                f"near={self.near} with far={self.far}: set both in world units, or both to null "
                "for the field's cube"
            )
        if self.near is not None and self.far is not None and self.near >= self.far:
            raise ConfigError(f"near={self.near}: must be below far={self.far}")
        if self.space_low > self.space_high:
            raise ConfigError(
                f"space_low={self.space_low}: must not be above space_high={self.space_high}"
            )

    def holds(self, near: float, far: float) -> bool:
        return self.near is None or self.far is None or (self.near <= near and far <= self.far)

    def bounded(self, near: float, far: float) -> "ProposalSettings":
        return replace(self, near=None, far=None)

    def build(self, field: RadianceField, site: Site) -> "ProposalSampler":
        bounds: dict[str, float] = {}
        contracted = getattr(field, "contracted", False)
        if contracted:
            bounds = {"near": NEAREST, "far": FARTHEST}
        elif self.near is not None and self.far is not None:
            check_range(site, self.near, self.far)
            scale = site.frame.scale
            bounds = {"near": self.near * scale, "far": self.far * scale}
        rows = self.time_resolution if site.moves else None
        initial = {"low": self.space_low, "high": self.space_high}
        proposals = nn.ModuleList()
        with initial_values(site.seed, Stream.SAMPLER):
            for resolution in self.resolutions:
                proposals.append(
                    DensityField(
                        PlaneProducts(self.channels, resolution, [1], rows, **initial),
                        self.width,
                        linear=self.linear,
                        unit=site.unit,
                        precision=site.precision,
                        contracted=contracted,
                    )
                )
        renderer = ProposalRenderer(
            proposals,
            self.proposal_samples,
            self.samples,
            padding=self.padding,
            contracted=contracted,
            **bounds,
        )
        return ProposalSampler(renderer, self)


class ProposalSampler(Sampler):
    """Samples drawn from density fields that are trained jointly.

    Args:
        renderer: Renderer with the density fields.
        settings: Schedule, weights and learning rate.

    Source: K-Planes, released code.
    """

    def __init__(self, renderer: ProposalRenderer, settings: ProposalSettings) -> None:
        self._renderer, self.settings = renderer, settings
        renderer.exponent.fill_(self.anneal(0))
        self.schedule = UpdateSchedule(settings.update_every, settings.update_warmup)
        self.terms = PlaneTerms.of(settings)

    @property
    def renderer(self) -> ProposalRenderer:
        return self._renderer

    @property
    def modules(self) -> dict[str, nn.Module]:
        return {"proposals": self._renderer.proposals}

    @property
    def outline(self) -> str:
        counts = " + ".join(str(count) for count in self._renderer.counts)
        return f"{counts} samples a ray in density fields, {self._renderer.samples} in the field"

    def groups(self) -> list[Group]:
        parameters = list(self._renderer.proposals.parameters())
        return [{"params": parameters, "lr": self.settings.learning_rate, "name": "proposals"}]

    def anneal(self, step: int) -> float:
        """Exponent of the weights for resampling: from 0 to 1, fast at first."""
        share = min(step / self.settings.anneal_steps, 1.0)
        slope = self.settings.anneal_slope
        return slope * share / ((slope - 1) * share + 1)

    def render(self, field: Any, rays: Batch, state: TrainingState) -> ProposalRendering:
        # Validation renders after this step use the same exponent.
        self._renderer.exponent.fill_(self.anneal(state.step))
        return self._renderer.render(
            field,
            rays["origins"],
            rays["directions"],
            rays["times"],
            rays["background"],
            state.generator(rays["times"].device),
            learn=self.schedule.learns(state.step),
        )

    def losses(self, rendering: ProposalRendering) -> dict[str, Tensor]:
        if not rendering.levels[0].weights.requires_grad:
            return {}
        return {"histogram": self.settings.histogram * histogram_loss(rendering.levels)}

    def regularise(self, field: Any, state: TrainingState) -> None:
        for proposal in self._renderer.proposals:
            assert isinstance(proposal, DensityField)
            self.terms.add_gradients(proposal.products)

    def regularisers(self, field: Any, state: TrainingState) -> dict[str, float]:
        totals: dict[str, float] = {}
        for proposal in self._renderer.proposals:
            assert isinstance(proposal, DensityField)
            for name, value in self.terms.weighted(proposal.products).items():
                key = f"proposal_{name}"
                totals[key] = totals.get(key, 0.0) + value
        return totals


class UpdateSchedule:
    """Decides at which steps density fields are updated, from the step alone.

    After `ALWAYS` steps, more than n steps pass between updates; n grows from 1 to ``every``.

    Args:
        every: Final value of n.
        warmup: Steps over which n grows.
    """

    def __init__(self, every: int, warmup: int) -> None:
        self.every, self.warmup = every, warmup
        self._step, self._last = -1, 0

    def learns(self, step: int) -> bool:
        """Whether the density fields are updated at a step."""
        if step < self._step:
            self._step, self._last = -1, 0
        while self._step < step:
            self._step += 1
            gap = max(1.0, self.every * min(1.0, self._step / self.warmup))
            if self._step < ALWAYS or self._step - self._last > gap:
                self._last = self._step
        return self._last == step


def histogram_loss(levels: Sequence[Level]) -> Tensor:
    """The proposal loss: excess of the field's weights over the bound from each density field.

    For each density field it is the mean over rays and samples of ``max(0, w - c)^2 / (w + 1e-7)``,
    with w a weight of the field and c the total weight of the coarse samples that overlap it.

    Args:
        levels: Levels of the density fields, with gradients; then the field's, without.

    Returns:
        The sum over density fields. []

    Source: Mip-NeRF 360, Eq. 13; K-Planes.
    """
    *coarse, fine = levels
    weights = fine.weights.detach()
    terms = [
        (weights - covering_weights(fine.edges, level.edges, level.weights)).clamp_min(0).square()
        / (weights + SMALLEST)
        for level in coarse
    ]
    return torch.stack([term.mean() for term in terms]).sum()
