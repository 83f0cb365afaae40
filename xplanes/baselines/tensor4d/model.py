"""Tensor4D (Shao et al., CVPR 2023) as in the released code, and a variant with a density."""

from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.baselines.base import BaselineModel
from xplanes.baselines.proposal import ProposalRendering
from xplanes.baselines.tensor4d.field import Tensor4D, Tensor4DDensity
from xplanes.baselines.tensor4d.hierarchy import DYNAMIC, STATIC, Groups, HierarchicalPlanes, Level
from xplanes.baselines.tensor4d.neus import NeusSettings, SurfaceRendering
from xplanes.errors import ConfigError
from xplanes.fields.base import Representation
from xplanes.fields.xplanes import XPlanes
from xplanes.models.base import InitialValues, LossTerm, Model, ModelSettings, warm_cosine
from xplanes.rendering.sampler import Group, Site
from xplanes.scenes.batches import Batch
from xplanes.settings import Count, Positive, Settings, Share, Steps, Weight
from xplanes.streams import Stream, TrainingState, initial_values


@dataclass(frozen=True, kw_only=True)
class Tensor4DDensitySettings(ModelSettings):
    """Tensor4D's nine planes with a density instead of a surface."""

    field_class: ClassVar = Tensor4DDensity

    resolution: Count  # Texels along each space axis of the coarse planes.
    fine_resolution: Count  # Texels along each space axis of the fine planes.
    time_resolution: Count  # Rows along time.
    channels: Count  # Channels of the coarse planes.
    fine_channels: Count  # Channels of the fine planes.
    width: Count  # Neurons of the hidden layers.
    point_octaves: Steps  # Frequencies of the position encoding.
    time_octaves: Steps  # Frequencies of the time encoding.
    direction_octaves: Steps  # Frequencies of the direction encoding.
    fine_from: Steps  # Step from which the fine planes are used.
    blur_until: Steps  # Step until which planes are downsampled before the lookup.
    blur_resolution: Count  # Texels along each axis of downsampled planes.
    learning_rate: Positive  # Learning rate of the networks.
    plane_learning_rate: Positive  # Learning rate of the planes.
    warmup_steps: Steps  # Warm-up steps, followed by cosine decay.
    final_rate: Share  # Final learning rate relative to the peak.

    def planes(self, groups: Groups, *, fine: bool) -> HierarchicalPlanes:
        """Planes of the coarse level, and of the fine one."""
        rows = self.time_resolution
        levels = [Level(self.resolution, rows, self.channels)]
        if fine:
            levels.append(Level(self.fine_resolution, rows, self.fine_channels))
        return HierarchicalPlanes(groups, levels, blur=self.blur_resolution)

    @property
    def octaves(self) -> tuple[int, int, int]:
        """Frequencies of the encodings of positions, time and directions."""
        return self.point_octaves, self.time_octaves, self.direction_octaves

    def build(self, site: Site, initial: InitialValues | None = None) -> Model:
        with initial_values(site.seed, Stream.FIELD):
            field = Tensor4DDensity(
                self.planes(DYNAMIC if site.moves else STATIC, fine=True),
                self.width,
                octaves=self.octaves,
            )
        return Tensor4DDensityModel(self, field)


@dataclass(frozen=True, kw_only=True)
class Tensor4DLoss(Settings):
    """Weights of the terms of the loss beyond the colour error."""

    masked: bool  # Restrict the colour loss to the silhouettes.
    eikonal: Weight  # Weight of the eikonal loss.
    opacity: Weight  # Weight of the cross-entropy between opacity and silhouette.
    smoothness: Weight  # Weight of feature differences over a small distance.
    smoothness_distance: Positive  # Distance of the smoothness term; the cube is 2 wide.


@dataclass(frozen=True, kw_only=True)
class Tensor4DSettings(Tensor4DDensitySettings):
    """Tensor4D: a surface in canonical space, and a flow that maps points to it."""

    field_class: ClassVar = Tensor4D

    flow_planes: bool  # Train the flow planes; the released code does not.
    radius: Positive  # Radius of the initial sphere; the cube is 2 wide.
    sharpness: Positive  # Initial width of the surface: exp(-10 * sharpness).
    loss: Tensor4DLoss

    def check(self) -> None:
        if not isinstance(self.sampler, NeusSettings):
            raise ConfigError(
                f"sampler.name={self.sampler.name}: the surface needs the sampler of NeuS; set "
                "model/sampler=neus, or model=tensor4d_density"
            )

    def build(self, site: Site, initial: InitialValues | None = None) -> Model:
        with initial_values(site.seed, Stream.FIELD):
            field = Tensor4D(
                self.planes(STATIC, fine=True),
                self.planes(DYNAMIC, fine=False) if site.moves else None,
                self.width,
                octaves=self.octaves,
                radius=self.radius,
                sharpness=self.sharpness,
            )
        return Tensor4DModel(self, field)


S = TypeVar("S", bound=Tensor4DDensitySettings)
Field = TypeVar("Field", Tensor4D, Tensor4DDensity)


class Tensor4DDensityModel(BaselineModel[S, Field]):
    """Colour error, and the schedule of coarse and fine planes."""

    doubted = ("learning_rate", "plane_learning_rate")

    def groups(self) -> list[Group]:
        settings, field = self.settings, self._field
        groups: list[Group] = []
        own = list(field.parameters(recurse=False))
        if own:
            groups.append({"params": own, "lr": settings.learning_rate, "name": "steepness"})
        for name, part in field.named_children():
            planes = isinstance(part, HierarchicalPlanes)
            rate = settings.plane_learning_rate if planes else settings.learning_rate
            if parameters := [p for p in part.parameters() if p.requires_grad]:
                groups.append({"params": parameters, "lr": rate, "name": name})
        return groups

    def optimizer(self, groups: list[Group]) -> torch.optim.Optimizer:
        return torch.optim.Adam(groups, fused=True)

    def rate_factor(self, step: int, progress: float) -> float:
        settings = self.settings
        warmup, final = settings.warmup_steps, settings.final_rate
        return warm_cosine(step, progress, warmup=warmup, final=final)

    def before_step(self, state: TrainingState, optimizer: torch.optim.Optimizer) -> None:
        for part in self._field.children():
            if isinstance(part, HierarchicalPlanes):
                part.show(
                    fine=state.step >= self.settings.fine_from,
                    blurred=state.step < self.settings.blur_until,
                )


class Tensor4DModel(Tensor4DDensityModel[Tensor4DSettings, Tensor4D]):
    """Colour error, silhouette loss, eikonal loss and smoothness of features."""

    def __init__(self, settings: Tensor4DSettings, field: Tensor4D) -> None:
        super().__init__(settings, field)
        if field.flow_planes is not None:
            field.flow_planes.requires_grad_(settings.flow_planes)

    def losses(
        self, rendering: SurfaceRendering, rays: Batch, state: TrainingState
    ) -> dict[str, Tensor]:
        weights = self.settings.loss
        mask = (rays["alpha"] > 0.5).to(rays["target"].dtype)
        compared = mask if weights.masked else torch.ones_like(mask)
        eikonal = eikonal_error(rendering.slopes, len(rendering.samples))
        terms = {
            "colour": masked_colour_error(rendering.colour, rays["target"], compared),
            "eikonal": weights.eikonal * eikonal,
            "silhouette": weights.opacity * silhouette_error(rendering.opacity, mask),
        }
        if weights.smoothness:
            places, features = rendering.places, self._field.features
            nearby = places + _aside(places, weights.smoothness_distance, state)
            shares = rendering.weights, len(mask)
            change = feature_change(features(places), features(nearby), *shares)
            terms["smoothness"] = weights.smoothness * change
        return terms

    def scalars(self) -> dict[str, float]:
        return {"surface/sharpness": float(self._field.sharpness.detach())}


@dataclass(frozen=True, kw_only=True)
class FeatureSmoothness(LossTerm):
    """Change of an X-Planes field's features over a small distance, weighted as in compositing.

    Source: Tensor4D, released code.
    """

    distance: Positive  # Distance in the field's frame.

    def value(
        self, field: Representation, rendering: Any, rays: Batch, state: TrainingState
    ) -> Tensor:
        if not isinstance(field, XPlanes) or not isinstance(rendering, ProposalRendering):
            raise ConfigError(
                f"losses with {type(self).__name__}: it needs model=six_planes or nine_planes and "
                "model/sampler=proposal; leave it out"
            )
        points, ray = rendering.samples.points, rendering.samples.ray
        times = rays["times"][ray]
        here = field.features(points, times)
        there = field.features(points + _aside(points, self.distance, state), times)
        weights = rendering.levels[-1].weights.flatten()
        return feature_change(here, there, weights, len(rays["times"]))


def _aside(places: Tensor, distance: float, state: TrainingState) -> Tensor:
    """Offsets of a fixed length in random directions. [N, 3] -> [N, 3]"""
    generator = state.generator(places.device, Stream.NEARBY)
    steps = torch.randn(places.shape, generator=generator, device=places.device)
    return F.normalize(steps, dim=1) * distance


def masked_colour_error(colour: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Absolute error, summed over channels, mean over rays in a mask. [R, 3], [R, 3], [R] -> []

    Source: NeuS and Tensor4D, released code.
    """
    error = (colour - target).abs().sum(dim=1)
    return (error * mask).sum() / (mask.sum() + 1e-5)


def silhouette_error(opacity: Tensor, mask: Tensor) -> Tensor:
    """Cross entropy of opacities, clamped to [0.001, 0.999], with a mask. [R], [R] -> []

    Source: NeuS and Tensor4D, released code.
    """
    # torch's function raises an error at NaN on some devices, but training skips such steps.
    light = opacity.clamp(1e-3, 1 - 1e-3)
    return -(mask * light.log() + (1 - mask) * (1 - light).log()).mean()


def eikonal_error(slopes: Tensor, samples: int) -> Tensor:
    """Mean squared deviation of gradient norms from 1. [M, 3] -> []

    Args:
        slopes: Gradients of the samples in the field's cube. [M, 3]
        samples: Number of all samples: the error outside the cube is 0.

    Source: NeuS; IGR; Tensor4D, released code.
    """
    # The constant avoids the infinite derivative of the square root at 0.
    lengths = (slopes.square().sum(dim=1) + 1e-12).sqrt()
    return (lengths - 1).square().sum() / max(1, samples)


def feature_change(here: Tensor, nearby: Tensor, weights: Tensor, rays: int) -> Tensor:
    """Squared change of features over a small distance: weighted sum along rays, mean over rays.

    Args:
        here: Features at samples. [N, F]
        nearby: Features at nearby points. [N, F]
        weights: Compositing weight of each sample, without gradient. [N]
        rays: Number of rays.

    Source: Tensor4D, released code.
    """
    return ((nearby - here).square().mean(dim=1) * weights).sum() / rays
