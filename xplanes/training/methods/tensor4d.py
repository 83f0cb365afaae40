"""Tensor4D in training: a surface in the silhouettes, or a density."""

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.fields.hierarchy import HierarchicalPlanes
from xplanes.fields.tensor4d import Tensor4D, Tensor4DDensity
from xplanes.rendering.neus import SurfaceRendering
from xplanes.scenes.batches import Batch
from xplanes.schemas.tensor4d import (
    Tensor4DConfig,
    Tensor4DDensityConfig,
    Tensor4DLossConfig,
)
from xplanes.training.losses import (
    eikonal_error,
    feature_change,
    masked_colour_error,
    silhouette_error,
)
from xplanes.training.methods.base import Method, colour_error, warm_cosine
from xplanes.training.sampling.base import Group, Moment

NEARBY_STREAM = 1_000_151
"""Random stream of the directions in which features must not change."""


class Tensor4DDensityMethod(Method):
    """Colour error, and planes that are read coarsely at first.

    Args:
        field: The field.
        config: Learning rates and schedule.

    Source: Tensor4D, released code.
    """

    def __init__(self, field: Tensor4D | Tensor4DDensity, config: Tensor4DDensityConfig) -> None:
        self._field, self.config = field, config
        self.advice = (
            f"Lower model.learning_rate={config.learning_rate} or "
            f"model.plane_learning_rate={config.plane_learning_rate}"
        )

    @property
    def field(self) -> Tensor4D | Tensor4DDensity:
        return self._field

    def groups(self) -> list[Group]:
        config, field = self.config, self._field
        groups: list[Group] = []
        own = list(field.parameters(recurse=False))
        if own:
            groups.append({"params": own, "lr": config.learning_rate, "name": "steepness"})
        for name, part in field.named_children():
            planes = isinstance(part, HierarchicalPlanes)
            rate = config.plane_learning_rate if planes else config.learning_rate
            if parameters := [p for p in part.parameters() if p.requires_grad]:
                groups.append({"params": parameters, "lr": rate, "name": name})
        return groups

    def optimizer(self, groups: list[Group]) -> torch.optim.Optimizer:
        return torch.optim.Adam(groups, fused=True)

    def rate(self, step: int, progress: float) -> float:
        config = self.config
        return warm_cosine(step, progress, warmup=config.warmup_steps, final=config.final_rate)

    def before_step(self, moment: Moment, optimizer: torch.optim.Optimizer) -> None:
        for part in self._field.children():
            if isinstance(part, HierarchicalPlanes):
                part.fine.fill_(moment.step >= self.config.fine_from)
                part.blurred.fill_(moment.step < self.config.blur_until)


class Tensor4DMethod(Tensor4DDensityMethod):
    """Colours in the silhouettes, silhouettes, distances that are distances, smooth features.

    Args:
        field: The field.
        config: Learning rates and schedule.
        loss: Weights.

    Source: Tensor4D, released code.
    """

    def __init__(self, field: Tensor4D, config: Tensor4DConfig, loss: Tensor4DLossConfig) -> None:
        super().__init__(field, config)
        self._field, self.weights = field, loss
        if field.flow_planes is not None:
            field.flow_planes.requires_grad_(config.flow_planes)

    @property
    def field(self) -> Tensor4D:
        return self._field

    def loss(
        self, rendering: SurfaceRendering, rays: Batch, moment: Moment
    ) -> tuple[Tensor, Tensor]:
        weights = self.weights
        mask = (rays["alpha"] > 0.5).to(rays["target"].dtype)
        compared = mask if weights.masked else torch.ones_like(mask)
        total = masked_colour_error(rendering.colour, rays["target"], compared)
        total = total + weights.eikonal * eikonal_error(rendering.slopes, len(rendering.samples))
        total = total + weights.opacity * silhouette_error(rendering.opacity, mask)
        if weights.smoothness:
            change = self._change(rendering, len(mask), moment)
            total = total + weights.smoothness * change
        return total, colour_error(rendering, rays)

    def _change(self, rendering: SurfaceRendering, rays: int, moment: Moment) -> Tensor:
        places = rendering.places
        generator = moment.generator(places.device, NEARBY_STREAM)
        aside = torch.randn(places.shape, generator=generator, device=places.device)
        aside = F.normalize(aside, dim=1) * self.weights.smoothness_distance
        here, nearby = self._field.features(places), self._field.features(places + aside)
        return feature_change(here, nearby, rendering.weights, rays)

    def scalars(self) -> dict[str, float]:
        return {"surface/sharpness": float(self._field.sharpness.detach())}
