"""X-Planes: feature planes initialised from an LRM, and the LRM's decoder (the paper's Section 3).

Features of a point (x, y, z) at time t are interpolated in space planes and space-time planes
(Eq. 14, 15). The decoder maps them to colour and density, which are composited along rays and
compared with the images. The loss also contains smoothness regularisers and L_r, which keeps
products of the space-time planes near the sparse part of the LRM's triplanes (Eq. 17).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import torch
from torch import Tensor

from xplanes.decomposition.sparse_loss import SparseProduct
from xplanes.fields.decoder import DECODER_OPTIONS, Activation, Decoder, DensityActivation
from xplanes.fields.regularisers import (
    add_distance_gradient,
    add_time_smoothness_gradient,
    add_total_variation_gradient,
    time_smoothness,
    total_variation,
)
from xplanes.fields.xplanes import FINE_PLANES, XPlanes, random_planes
from xplanes.models.background import BackgroundSettings
from xplanes.models.base import (
    InitialValues,
    Model,
    ModelSettings,
    background_opacity,
    opacity_error,
    opacity_shortfall,
    ray_mean,
    warm_cosine,
)
from xplanes.models.smoothing import smoothed
from xplanes.rendering.base import Rendering
from xplanes.rendering.sampler import Group, Site, time_rows
from xplanes.scenes.batches import Batch
from xplanes.settings import FROM_0, Count, Positive, Settings, Share, Steps, Weight
from xplanes.streams import Stream, TrainingState, initial_values, step_generator

MOST_SMOOTH = 10.0
"""Largest factor on total variation for few camera positions."""

MOST_STATIC = 0.3
"""Largest share of the budget in which light that passes the cube costs and time planes wait."""

FINE_WARMUP = 100
"""Warm-up steps of the fine planes' learning rate."""

TEXELS_PER_PIXEL, TEXEL_STEP, MOST_TEXELS = 0.66, 32, 256
"""Fine planes with texels=auto: texels per image pixel, rounding step, and maximum of texels."""

USUAL_TEXELS, MORE_TEXELS, LEAST_PIXELS = 64, 96, 480
"""Space planes with resolution=auto: texels by default; texels for moving scenes with surroundings
and many camera positions; and image pixels across the cube that the latter require."""

FINER = 2.0
"""With texels=auto, fine planes need at least this many times the texels of space planes."""


@dataclass(frozen=True, kw_only=True)
class DecoderSettings(Settings):
    """The MLP from features to colour and density."""

    width: Count  # Neurons of each hidden layer.
    hidden: Steps  # Number of hidden layers.
    activation: Activation  # Activation between layers.
    density: DensityActivation  # Activation of the density.
    density_scale: Positive  # Factor on the density.
    density_bias: float  # Initial bias of the density logit; lower values give an emptier field.
    # Initial bias of the colour logits. Above 0, colours begin near a white background. Unused if
    # a background is learnt.
    colour_bias: float
    colour_margin: Weight  # Margin by which colours may exceed [0, 1].
    freeze: bool  # Do not train the decoder.


@dataclass(frozen=True, kw_only=True)
class FineSettings(Settings):
    """Fine space planes, initially zero, that are added to the first channels of space planes."""

    # Texels along each space axis. auto: two per three image pixels across the field's cube; no
    # fine planes for moving scenes with surroundings.
    texels: Count | Literal["auto"]
    channels: Count  # Channels of each plane, at most `model.channels`.
    start: Steps  # Step from which they are trained.
    total_variation: Weight  # Weight of their total variation.
    # Replaces `model.loss.total_variation` where there are fine planes, but not in moving scenes
    # with surroundings.
    coarse_variation: Weight
    lr: Positive  # Learning rate.


@dataclass(frozen=True, kw_only=True)
class XPlanesLoss(Settings):
    """Weights of the loss terms besides the mean squared error of colours."""

    opacity: Weight  # Weight of the squared error of opacity against the images' alpha.
    floaters: Weight  # Weight of the mean opacity of rays at pixels with alpha 0.
    # Total variation. mean: along space, averaged over planes; coded: as in K-Planes' released
    # code, also along time, summed over planes.
    variation: Literal["mean", "coded"]
    total_variation: Weight  # Weight of the space planes' total variation.
    # Replaces `model.loss.total_variation` in moving scenes if a background is learnt.
    total_variation_with_background: Weight
    # With fewer camera positions than this, the total variation of coarse space planes is weighted
    # more, in inverse proportion and up to tenfold, and the background's by the square root of that
    # factor. Not for fields initialised from an LRM. null: never.
    variation_views: Count | None
    # Factor on the three weights of time planes below if a background is learnt.
    time_factor_with_background: Share
    time_variation: Weight  # Weight of the time planes' total variation.
    time_smoothness: Weight  # Weight of time smoothness (squared second differences).
    time_magnitude: Weight  # Weight of the time planes' mean square.
    # Weight of the cube's mean transmittance, if a background is learnt; it falls to 0 over
    # `model.loss.passing_steps`. The background learns faster than the field, and would otherwise
    # reproduce the cube's content. Time planes are not trained until then: they would build fog
    # that differs from view to view, blocks the light and persists.
    passing: Weight
    # Steps over which `model.loss.passing` falls to 0; at most 30% of the training budget.
    passing_steps: Steps
    # The same for rigs, where at least two views show each timestep on average. For rigs, light
    # absorbed near a face of the cube counts as passing, as in `model.sampler.border`.
    rig_passing_steps: Steps
    # Rigs with a learnt background and a randomly initialised field: texels on either side over
    # which gradients of space planes and background are smoothed at first, so that coarse structure
    # finds its depth before details do; it falls to 0 as `model.loss.passing` does. Fewer texels if
    # the images have little coarse structure, none if the cameras are far away. 0: never.
    rig_smoothing: Annotated[int, FROM_0]
    time_identity: Weight  # Weight of the time planes' mean distance from 1, as in K-Planes.
    sparse_weight: Weight  # Weight of L_r (X-Planes, Eq. 17).
    sparse_reduction: Literal["mean", "sum"]  # Reduction of L_r over entries; the paper: sum.
    sparse_frames: Count | None  # Random timesteps per evaluation of L_r; null: all.
    initial_weight: Weight  # Weight of the distance to the initial planes; divided by views^2.
    # L_r and the distance to the initial planes fade out over this many steps divided by the number
    # of training views; null: never.
    initial_steps: Count | None
    every: Count  # Steps between evaluations of the regularisers; weights are scaled to match.

    def with_learnt_background(self) -> "XPlanesLoss":
        """The weights for scenes in which a background is learnt."""
        weights = {
            name: self.time_factor_with_background * getattr(self, name)
            for name in ("time_variation", "time_smoothness", "time_magnitude")
        }
        return replace(self, **weights)


@dataclass(frozen=True, kw_only=True)
class XPlanesSettings(ModelSettings):
    """X-Planes with six or nine planes (three for static scenes)."""

    takes: ClassVar = "planes"
    devices: ClassVar[int | None] = None
    field_class: ClassVar[type[XPlanes]] = XPlanes

    plane_set: Literal["six", "nine", "three"]  # Planes; three: a static field.
    # Texels along each space axis. auto: 64; 96 in randomly initialised fields of moving scenes
    # with surroundings, seen from at least 50 camera positions, where at least 480 image pixels
    # cover a side of the cube.
    resolution: Count | Literal["auto"]
    # Rows along time. half: half the distinct times, as in K-Planes, or all if four or more views
    # show each; null: the same, but at least the LRM's timesteps.
    time_resolution: Count | Literal["half"] | None
    # Texels of the time planes along space; null: as many as the space planes.
    time_texels: Count | None
    channels: Count  # Channels of each plane.
    fine: FineSettings | None  # Fine space planes; null: none.
    space_scale: Weight  # Standard deviation of randomly initialised space planes.
    time_scale: Weight  # Standard deviation of randomly initialised time planes.
    decoder: DecoderSettings
    # Learnt background, for opaque images with a real background; null: a plain colour.
    background: BackgroundSettings | None = None
    loss: XPlanesLoss
    plane_lr: Positive  # Learning rate of the space planes.
    time_lr: Positive  # Learning rate of the time planes.
    decoder_lr: Positive  # Learning rate of the decoder.
    warmup_steps: Steps  # Warm-up steps of the learning rates.
    final_lr: Share  # Final learning rate relative to the initial one.

    @property
    def is_static(self) -> bool:
        return self.plane_set == "three"

    def stronger(self) -> "XPlanesSettings":
        loss = replace(self.loss, opacity=10 * max(self.loss.opacity, 0.1))
        decoder = replace(self.decoder, colour_bias=max(self.decoder.colour_bias, 2.0))
        return replace(self, loss=loss, decoder=decoder)

    def coarse_texels(self, site: Site | None = None) -> int:
        """Texels of the space planes along each axis; without a site for planes from an LRM."""
        if self.resolution != "auto":
            return self.resolution
        if site is None or site.initialised or not (site.surrounded and site.moves):
            return USUAL_TEXELS
        many = site.is_seen_from_many and site.pixels >= LEAST_PIXELS
        return MORE_TEXELS if many else USUAL_TEXELS

    def texels(self, site: Site) -> int:
        return max(self.coarse_texels(site), self.fine_texels(site))

    def fine_texels(self, site: Site) -> int:
        """Texels of the fine planes along each space axis; 0 for none."""
        if self.fine is None or self.fine.texels != "auto":
            return 0 if self.fine is None else int(self.fine.texels)
        texels = min(TEXEL_STEP * round(TEXELS_PER_PIXEL * site.pixels / TEXEL_STEP), MOST_TEXELS)
        soft = site.surrounded and site.moves
        return 0 if soft or texels < FINER * self.coarse_texels(site) else texels

    def rows_of_time(self, times: Tensor, frames: int = 0) -> int:
        """Rows of the time planes.

        Args:
            times: Times of the training views. [V]
            frames: Timesteps of the LRM's triplanes, if there are any.
        """
        if isinstance(self.time_resolution, int):
            return self.time_resolution
        return max(time_rows(times), frames if self.time_resolution is None else 0)

    def random_planes(
        self, plane_set: str, rows: int, texels: int, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Random planes with ``texels`` along space and ``rows`` along time.

        See `fields.xplanes.random_planes`.
        """
        return random_planes(
            plane_set,
            channels=self.channels,
            resolution=texels,
            time_resolution=rows,
            time_texels=self.time_texels,
            space_scale=self.space_scale,
            time_scale=self.time_scale,
            generator=generator,
        )

    def build(self, site: Site, initial: InitialValues | None = None) -> "XPlanesModel":
        return XPlanesModel(self, self.build_field(site, initial), site, initial)

    def build_field(self, site: Site, initial: InitialValues | None = None) -> XPlanes:
        """Build planes and decoder from the initial values, if given, otherwise randomly."""
        plane_set = self.plane_set if site.moves else "three"
        background = None if self.background is None else self.background.build(site)
        generator = step_generator(site.seed, 0, Stream.INITIAL_FIELD)
        planes: Mapping[str, Tensor]
        if initial is not None:
            planes = initial.planes
        else:
            rows, texels = self.rows_of_time(site.times), self.coarse_texels(site)
            planes = self.random_planes(plane_set, rows, texels, generator)
        if self.fine is not None and (texels := self.fine_texels(site)):
            zeros = torch.zeros(min(self.fine.channels, self.channels), texels, texels)
            planes = {**planes, **dict.fromkeys(FINE_PLANES, zeros)}
        options = self.decoder
        with initial_values(site.seed, Stream.INITIAL_FIELD):
            decoder = Decoder(
                self.channels,
                precision="bf16" if site.precision == "bf16" else "32",
                **{name: getattr(options, name) for name in DECODER_OPTIONS},
            )
        if initial is not None and initial.decoder is not None:
            decoder.load_state_dict(dict(initial.decoder))
        else:
            with torch.no_grad():
                decoder.layers[-1].bias[0] += options.density_bias  # type: ignore[index]
                if background is None:  # A learnt background would replace white fog.
                    decoder.layers[-1].bias[1:] += options.colour_bias  # type: ignore[index]
        decoder.requires_grad_(not options.freeze)
        return self.field_class(
            planes=planes, decoder=decoder, plane_set=plane_set, background=background
        )


class XPlanesModel(Model):
    """X-Planes with its losses, parameter groups and schedule.

    Args:
        settings: Weights and learning rates.
        field: The field.
        site: Context for which the field was built.
        initial: Initial values; None for a random initialisation.
    """

    # Rays reach a texel at irregular intervals: with a long memory of squared gradients, the steps
    # of texels that are rarely reached would be far too large.
    betas = 0.9, 0.95

    def __init__(
        self,
        settings: XPlanesSettings,
        field: XPlanes,
        site: Site,
        initial: InitialValues | None = None,
    ) -> None:
        self._field, self.settings, self.weights = field, settings, settings.loss
        self.fine_settings = None if field.fine is None else settings.fine
        self.total_variation = self.weights.total_variation
        self._is_rig = site.is_rig
        if field.background is not None:
            self.weights = settings.loss.with_learnt_background()
            if self._is_rig:
                steps = self.weights.rig_passing_steps
                self.weights = replace(self.weights, passing_steps=steps)
        if field.background is not None and field.moves:
            self.total_variation = self.weights.total_variation_with_background
        elif self.fine_settings is not None:
            self.total_variation = self.fine_settings.coarse_variation
        self.smoothing = min(site.coherence * field.space.shape[2], self.weights.rig_smoothing)
        smoother = self._few_views(site)
        self.total_variation *= smoother
        self.background_factor = smoother**0.5
        views = len(site.times)
        steps = self.weights.initial_steps
        self.fade = None if steps is None else steps / views / site.batch_scale
        self.warmup = site.steps(settings.warmup_steps)
        self.fine_start = 0 if settings.fine is None else site.steps(settings.fine.start)
        self.fine_warmup = site.steps(FINE_WARMUP)
        self.opacity = self.weights.opacity
        self._opaque = site.views is not None and site.views.is_opaque
        self.product: SparseProduct | None = None
        self.initial_weight = 0.0
        self._initial: list[tuple[Tensor, Tensor]] = []
        if initial is not None:
            self.initial_weight = self.weights.initial_weight / views**2
            if initial.sparse is not None and field.time is not None and self.weights.sparse_weight:
                self.product = SparseProduct(
                    initial.sparse,
                    field.rows,
                    self.weights.sparse_frames,
                    reduction=self.weights.sparse_reduction,
                )
        if self.initial_weight:
            stacks = [field.space] if field.time is None else [field.space, field.time]
            self._initial = [(stack, stack.detach().clone()) for stack in stacks]
        self.advice = (
            f"Lower model.plane_lr={settings.plane_lr} or model.decoder_lr={settings.decoder_lr}"
        )

    @property
    def field(self) -> XPlanes:
        return self._field

    @property
    def sparse(self) -> Tensor | None:
        return None if self.product is None else self.product.sparse

    def _few_views(self, site: Site) -> float:
        """Factor on total variation: the fewer the camera positions, the larger."""
        wanted = self.weights.variation_views
        if wanted is None or site.positions is None or site.initialised:
            return 1.0
        return min(max(1.0, wanted / site.positions), MOST_SMOOTH)

    def groups(self) -> list[Group]:
        field, settings = self._field, self.settings
        groups: list[Group] = [{"params": [field.space], "lr": settings.plane_lr, "name": "space"}]
        if field.time is not None:
            groups.append({"params": [field.time], "lr": settings.time_lr, "name": "time"})
        if field.fine is not None and self.fine_settings is not None:
            groups.append({"params": [field.fine], "lr": self.fine_settings.lr, "name": "fine"})
        decoder = [p for p in field.decoder.parameters() if p.requires_grad]
        if decoder:
            groups.append({"params": decoder, "lr": settings.decoder_lr, "name": "decoder"})
        if field.background is not None and settings.background is not None:
            groups += settings.background.groups(field.background)
        return groups

    def losses(self, rendering: Rendering, rays: Batch, state: TrainingState) -> dict[str, Tensor]:
        terms = super().losses(rendering, rays, state)
        if weight := self._passing_weight(state.step, state.progress):
            terms["passing"] = weight * ray_mean(1 - rendering.opacity, rays)
            border: Tensor | None = getattr(rendering, "border", None)
            if self._is_rig and border is not None:
                terms["passing"] = terms["passing"] + weight * border
        if (background := self._field.background) is not None:
            if (options := self.settings.background) is not None:
                terms |= options.losses(background, rendering, rays, state)
            return terms  # The images have neither alpha nor a known background.
        if self.opacity:
            error = opacity_shortfall if self._opaque else opacity_error
            terms["opacity"] = self.opacity * error(rendering, rays)
        if self.weights.floaters:
            terms["floaters"] = self.weights.floaters * background_opacity(rendering, rays)
        return terms

    def rate_factor(self, step: int, progress: float) -> float:
        return warm_cosine(step, progress, warmup=self.warmup, final=self.settings.final_lr)

    def group_rate_factor(self, group: str, step: int, progress: float) -> float:
        if group == "time" and self._passing_weight(step, progress):
            return 0.0
        if group != "fine":
            return self.rate_factor(step, progress)
        since = max(0, step - self.fine_start)
        return warm_cosine(since, progress, warmup=self.fine_warmup, final=self.settings.final_lr)

    def before_step(self, state: TrainingState, optimizer: torch.optim.Optimizer) -> None:
        self._field.is_fine = state.step >= self.fine_start

    def regularise(self, state: TrainingState) -> None:
        every, field, weights = self.weights.every, self._field, self.weights
        self._smooth_gradients(state)
        if state.step % every or field.space.grad is None:
            return
        if field.background is not None and self.settings.background is not None:
            self.settings.background.regularise(field.background, every * self.background_factor)
        fading = self._fading(state.step)
        if not fading:
            self._initial, self.product = [], None  # Frees memory: both are large.
        elif self.initial_weight:
            # The field may have been moved to another device.
            self._initial = [(plane, initial.to(plane.device)) for plane, initial in self._initial]
            weight = fading * self.initial_weight * every
            for plane, initial in self._initial:
                if plane.grad is not None:
                    add_distance_gradient(plane.grad, plane, initial, weight)
        for plane, dims, weight in self._variation().values():
            if weight and plane.grad is not None:
                add_total_variation_gradient(plane.grad, plane, dims, weight * every)
        if field.time is None or field.time.grad is None:
            return
        if weight := weights.time_smoothness * every:
            add_time_smoothness_gradient(field.time.grad, field.time, weight)
        if weight := weights.time_magnitude * every:
            scale = 2 * weight / field.time.numel()
            field.time.grad.add_(field.time.detach(), alpha=scale)
        if weight := weights.time_identity * every:
            away = (field.time.detach() - 1).sign()
            field.time.grad.add_(away, alpha=weight / field.time.numel())
        if self.product is not None:
            # The same frames on all ranks, so that their planes stay equal.
            generator = step_generator(state.seed, state.step, Stream.FRAMES)
            weight = fading * weights.sparse_weight * every
            self.product.add_gradient(field.time.grad, field.time, weight, generator)  # Eq. 17

    def _smooth_gradients(self, state: TrainingState) -> None:
        """Smooth the gradients of space planes and background while time planes wait."""
        share = self._static_share(state.step, state.progress)
        if not (radius := int(self.smoothing * share)):
            return
        assert self._field.background is not None
        for planes in (self._field.space, self._field.background.planes):
            if planes.grad is not None:
                planes.grad.copy_(smoothed(planes.grad, radius))

    @torch.no_grad()
    def regularisers(self, state: TrainingState) -> dict[str, float]:
        weights, field, fading = self.weights, self._field, self._fading(state.step)
        terms: dict[str, tuple[float, Callable[[], Any]]] = {
            name: (weight, partial(total_variation, plane, dims))
            for name, (plane, dims, weight) in self._variation().items()
        }
        if (background := field.background) is not None and (options := self.settings.background):
            variation = options.total_variation * self.background_factor
            terms["background"] = (variation, lambda: total_variation(background.planes, (1, 2)))
        if self._initial:
            terms["initialisation"] = (fading * self.initial_weight, self._distance)
        if (time := field.time) is not None:
            terms["time_smoothness"] = (weights.time_smoothness, lambda: time_smoothness(time))
            terms["time_magnitude"] = (weights.time_magnitude, lambda: time.square().mean())
            terms["time_identity"] = (weights.time_identity, lambda: (1 - time).abs().mean())
            if (product := self.product) is not None:
                terms["l_r"] = (fading * weights.sparse_weight, lambda: product.value(time))
        return {name: weight * float(value()) for name, (weight, value) in terms.items() if weight}

    def _variation(self) -> dict[str, tuple[Tensor, tuple[int, ...], float]]:
        """For each term: a stack of planes, the axes of its total variation, and its weight."""
        space, time = self._field.space, self._field.time
        coded = self.weights.variation == "coded"
        # coded: twice the sum over planes, with space planes counted twice (as in `PlaneTerms`).
        weight = self.total_variation * (4 * len(space) if coded else 1)
        found: dict[str, tuple[Tensor, tuple[int, ...], float]] = {
            "total_variation": (space, (1, 2), weight)
        }
        if time is not None:
            weight = self.weights.time_variation * (2 * len(time) if coded else 1)
            found["time_variation"] = (time, (1, 2) if coded else (2,), weight)
        if (fine := self._field.fine) is not None and (options := self.fine_settings):
            found["fine_variation"] = (fine, (1, 2), options.total_variation)
        return found

    def _distance(self) -> float:
        """Mean squared distance from the initial values, summed over the stacks of planes."""
        return sum(
            float((plane - initial.to(plane.device)).square().mean())
            for plane, initial in self._initial
        )

    def _passing_weight(self, step: int, progress: float) -> float:
        """Weight of the cube's mean transmittance; 0 without a learnt background."""
        return self.weights.passing * self._static_share(step, progress)

    def _static_share(self, step: int, progress: float) -> float:
        """What is left of the steps in which static content is learnt first, from 1 to 0."""
        steps = self.weights.passing_steps
        if self._field.background is None or not steps:
            return 0.0
        return max(0.0, 1 - max(step / steps, progress / MOST_STATIC))

    def _fading(self, step: int) -> float:
        """Factor on the regularisers that keep the field near its initialisation."""
        return 1.0 if self.fade is None else max(0.0, 1 - step / self.fade)
