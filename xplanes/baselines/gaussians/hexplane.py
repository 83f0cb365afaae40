"""4D Gaussian splatting (Wu et al., CVPR 2024): canonical Gaussians, deformed by six planes."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from xplanes.baselines.gaussians.field import HexPlaneGaussians
from xplanes.baselines.gaussians.model import GaussiansLoss, GaussiansModel, GaussiansSettings
from xplanes.baselines.products import PlaneProducts
from xplanes.errors import ConfigError
from xplanes.fields.regularisers import add_time_smoothness_gradient, time_smoothness
from xplanes.models.base import InitialValues
from xplanes.rendering.sampler import Group, Site
from xplanes.settings import Count, Positive, Share, Weight
from xplanes.streams import Stream, TrainingState, initial_values


@dataclass(frozen=True, kw_only=True)
class HexPlaneLoss(GaussiansLoss):
    """Weights of the terms of the loss."""

    space_smoothness: Weight  # Weight of the space planes' squared second differences.
    time_smoothness: Weight  # Weight of the time planes' squared second differences along time.
    time_identity: Weight  # Weight of the distance of time planes from 1.
    every: Count  # Steps between gradients of the planes' terms; weights are scaled to match.


@dataclass(frozen=True, kw_only=True)
class HexPlaneGaussiansSettings(GaussiansSettings):
    """4D-GS: canonical Gaussians that a six-plane field deforms after a static stage."""

    field_class: ClassVar = HexPlaneGaussians

    static_share: Share  # Share of the budget before the deformation begins.
    resolution: Count  # Texels along each space axis at the first scale.
    scales: list[Count]  # Factors on the space resolution.
    # Rows along time; null: half the distinct times, or all if four or more views show each.
    time_resolution: Count | None
    channels: Count  # Channels of each plane and scale.
    width: Count  # Neurons of the hidden layers.
    plane_lr: Positive  # Learning rate of the planes.
    network_lr: Positive  # Learning rate of the network after the planes.
    loss: HexPlaneLoss

    def check(self) -> None:
        super().check()
        if not self.scales:
            raise ConfigError("scales=[]: must be one or more numbers above 0")

    def build(self, site: Site, initial: InitialValues | None = None) -> "HexPlaneGaussiansModel":
        with initial_values(site.seed, Stream.FIELD):
            planes = None
            if site.moves:
                rows = self.time_resolution or site.time_rows
                planes = PlaneProducts(
                    self.channels, self.resolution, self.scales, rows, low=0.1, high=0.5
                )
            field = HexPlaneGaussians(
                **self.canonical(site, initial), planes=planes, width=self.width
            )
        return HexPlaneGaussiansModel(self, field)


class HexPlaneGaussiansModel(GaussiansModel[HexPlaneGaussiansSettings, HexPlaneGaussians]):
    """Colour errors, smoothness of planes, and adaptive density control."""

    doubted = ("scale_lr", "plane_lr")

    def groups(self) -> list[Group]:
        settings, field, groups = self.settings, self._field, super().groups()
        if field.products is not None:
            planes, network = list(field.products.parameters()), list(field.network.parameters())
            groups.append({"params": planes, "lr": settings.plane_lr, "name": "planes"})
            groups.append({"params": network, "lr": settings.network_lr, "name": "network"})
        return groups

    def group_rate_factor(self, group: str, step: int, progress: float) -> float:
        """Exponential decay for means, planes and network, restarted in the dynamic stage."""
        if group not in ("means", "planes", "network"):
            return 1.0
        static = self.static_share if self._field.moves else 0.0
        begun = static if progress >= static else 0.0
        return self.settings.final_lr ** ((progress - begun) / max(1 - static, 1e-6))

    def begin_to_move(self, optimizer: torch.optim.Optimizer) -> None:
        """Reset the optimiser's moments and the statistics, as in the released code."""
        optimizer.state.clear()
        self._field.slopes.zero_()
        self._field.seen.zero_()

    def regularise(self, state: TrainingState) -> None:
        weights = self.settings.loss
        if not self._field.deforms or state.step % weights.every:
            return
        for name, plane in self._planes():
            gradient = plane.grad
            assert gradient is not None
            smooth = weights.time_smoothness if "t" in name else weights.space_smoothness
            add_time_smoothness_gradient(gradient[0], plane[0], weights.every * smooth)
            if "t" in name and (weight := weights.every * weights.time_identity):
                gradient.add_((plane.detach() - 1).sign(), alpha=weight / plane.numel())

    @torch.no_grad()
    def regularisers(self, state: TrainingState) -> dict[str, float]:
        weights, zero = self.settings.loss, torch.zeros(())
        if not self._field.deforms:
            return {}
        found: dict[str, Tensor] = {}
        for name, plane in self._planes():
            smooth = "time_smoothness" if "t" in name else "space_smoothness"
            terms = {smooth: time_smoothness(plane[0])}
            if "t" in name:
                terms["time_identity"] = (plane - 1).abs().mean()
            for term, value in terms.items():
                found[term] = found.get(term, zero) + getattr(weights, term) * value
        return {term: float(value) for term, value in found.items()}

    def _planes(self) -> list[tuple[str, Tensor]]:
        return [] if self._field.products is None else self._field.products.planes()
