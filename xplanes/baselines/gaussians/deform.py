"""Deformable 3D Gaussians (Yang et al., CVPR 2024): canonical Gaussians, deformed by a network."""

from dataclasses import dataclass
from typing import ClassVar

from xplanes.baselines.gaussians.field import DeformedGaussians
from xplanes.baselines.gaussians.model import GaussiansModel, GaussiansSettings
from xplanes.errors import ConfigError
from xplanes.models.base import InitialValues
from xplanes.rendering.sampler import Group, Site
from xplanes.settings import Count, Positive, Share, Steps, Weight
from xplanes.streams import Stream, initial_values

MEANS_UNTIL = 0.75
"""Share of the budget over which the means' learning rate decays: 30,000 of 40,000 steps."""


@dataclass(frozen=True, kw_only=True)
class DeformedGaussiansSettings(GaussiansSettings):
    """Deformable 3D Gaussians: a static stage, then a network deforms them over time."""

    field_class: ClassVar = DeformedGaussians

    static_share: Share  # Share of the budget before the deformation begins.
    depth: Count  # Number of hidden layers of the deformation network.
    width: Count  # Neurons of each hidden layer.
    point_octaves: Steps  # Frequencies of the position encoding.
    time_octaves: Steps  # Frequencies of the time encoding.
    time_noise: Weight  # Noise on training times, in units of the mean interval between views.
    time_noise_until: Share  # Share of the budget over which the noise fades.
    network_lr: Positive  # Learning rate of the deformation network.
    final_network_lr: Share  # Its final value relative to the initial one.

    def check(self) -> None:
        super().check()
        if self.final_network_lr == 0:
            raise ConfigError(
                "final_network_lr=0.0: the decay is exponential; set 0.002 or any share above 0"
            )

    def build(self, site: Site, initial: InitialValues | None = None) -> "DeformedGaussiansModel":
        with initial_values(site.seed, Stream.FIELD):
            field = DeformedGaussians(
                **self.canonical(site, initial),
                moves=site.moves,
                depth=self.depth,
                width=self.width,
                octaves=(self.point_octaves, self.time_octaves),
                noise=self.time_noise / len(site.times),
                noise_until=self.time_noise_until,
            )
        return DeformedGaussiansModel(self, field)


class DeformedGaussiansModel(GaussiansModel[DeformedGaussiansSettings, DeformedGaussians]):
    """Colour errors and adaptive density control."""

    doubted = ("scale_lr", "network_lr")

    def groups(self) -> list[Group]:
        groups, network = super().groups(), list(self._field.network.parameters())
        if network:
            groups.append({"params": network, "lr": self.settings.network_lr, "name": "network"})
        return groups

    def group_rate_factor(self, group: str, step: int, progress: float) -> float:
        """Exponential decay of the learning rates of means and network."""
        if group == "network":
            return self.settings.final_network_lr**progress
        return super().group_rate_factor(group, step, min(1.0, progress / MEANS_UNTIL))
