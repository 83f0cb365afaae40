"""K-Planes (Fridovich-Keil et al., CVPR 2023), hybrid and explicit, as in the released code."""

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from xplanes.baselines.base import BaselineModel
from xplanes.baselines.bounds import fits_origin_cube, origin_cube, seen_range
from xplanes.baselines.kplanes.field import ExplicitDecoder, HybridDecoder, KPlanes
from xplanes.baselines.products import PlaneProducts, PlaneTerms, Variation
from xplanes.errors import ConfigError
from xplanes.models.base import InitialValues, ModelSettings, warm_cosine
from xplanes.rendering.sampler import Group, Site
from xplanes.scenes.frame import NO_HINTS, CubeHints, Frame, scene_frame
from xplanes.scenes.views import Views
from xplanes.settings import Count, Positive, Settings, Steps, Weight
from xplanes.streams import Stream, TrainingState, initial_values


@dataclass(frozen=True, kw_only=True)
class KPlanesLoss(Settings):
    """Weights of the terms of the loss beyond the colour's mean squared error."""

    variation: Variation  # Total variation as in the released code, or corrected (as in the paper).
    total_variation: Weight  # Weight of total variation.
    time_smoothness: Weight  # Weight of time smoothness (squared second differences).
    time_identity: Weight  # Weight of the distance of time planes from 1.


@dataclass(frozen=True, kw_only=True)
class KPlanesSettings(ModelSettings):
    """K-Planes: products of planes at several scales, and a small decoder."""

    field_class: ClassVar = KPlanes

    variant: Literal["hybrid", "explicit"]  # MLP decoder, or linear decoder with learned bases.
    # Contract space outside the cube if images have a real background; planes then cover all space.
    contract: bool
    half_side: Positive | None  # Half the side of a cube at the origin; null: the scene's cube.
    resolution: Count  # Texels along each space axis at the first scale.
    scales: list[Count]  # Factors on the space resolution.
    # Rows along time; null: half the distinct times, or all if four or more views show each.
    time_resolution: Count | None
    channels: Count  # Channels of each plane and scale.
    space_low: float  # Lower bound of the uniform initialisation of space planes.
    space_high: float  # Upper bound. Time planes are initialised to 1.
    width: Count  # Neurons of the hidden layers.
    learning_rate: Positive  # Learning rate of all parameters.
    warmup_steps: Steps  # Warm-up steps, followed by cosine decay to 0.
    loss: KPlanesLoss

    def check(self) -> None:
        if not self.scales:
            raise ConfigError("scales=[]: must be one or more numbers above 0")
        if self.space_low > self.space_high:
            raise ConfigError(
                f"space_low={self.space_low}: must not be above space_high={self.space_high}"
            )

    def frame(self, views: Views, hints: CubeHints = NO_HINTS) -> Frame:
        if self.half_side is None:
            return scene_frame(views, hints)
        return origin_cube(self.half_side, views, hints)

    def for_scene(self, views: Views, hints: CubeHints = NO_HINTS) -> "KPlanesSettings":
        cube = scene_frame(views, hints)
        near, far = seen_range(views, cube)
        fits = self.half_side is None or fits_origin_cube(self.half_side, cube)
        if not hints.is_given and fits and self.sampler.holds(near, far):
            return self
        return replace(self, half_side=None, sampler=self.sampler.bounded(near, far))

    def build(self, site: Site, initial: InitialValues | None = None) -> "KPlanesModel":
        decoder = {"hybrid": HybridDecoder, "explicit": ExplicitDecoder}[self.variant]
        with initial_values(site.seed, Stream.FIELD):
            products = PlaneProducts(
                self.channels,
                self.resolution,
                self.scales,
                (self.time_resolution or site.time_rows) if site.moves else None,
                low=self.space_low,
                high=self.space_high,
            )
            decode = decoder(products.features, self.width, precision=site.precision)
        contracted = self.contract and site.surrounded
        return KPlanesModel(self, KPlanes(products, decode, site.unit, contracted=contracted))


class KPlanesModel(BaselineModel[KPlanesSettings, KPlanes]):
    """Colour error, smoothness of the planes, and distance of time planes from 1."""

    doubted = ("learning_rate",)

    def __init__(self, settings: KPlanesSettings, field: KPlanes) -> None:
        super().__init__(settings, field)
        self.terms = PlaneTerms.of(settings.loss)

    def groups(self) -> list[Group]:
        rate = self.settings.learning_rate
        return [
            {"params": list(part.parameters()), "lr": rate, "name": name}
            for name, part in self._field.named_children()
        ]

    def rate_factor(self, step: int, progress: float) -> float:
        return warm_cosine(step, progress, warmup=self.settings.warmup_steps, final=0.0)

    def regularise(self, state: TrainingState) -> None:
        self.terms.add_gradients(self._field.products)

    def regularisers(self, state: TrainingState) -> dict[str, float]:
        return self.terms.weighted(self._field.products)
