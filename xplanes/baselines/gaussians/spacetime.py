"""Spacetime Gaussians (Li et al., CVPR 2024), lite: Gaussians with a lifetime and a trajectory."""

from dataclasses import dataclass
from typing import ClassVar

from xplanes.baselines.gaussians.field import SpacetimeGaussians
from xplanes.baselines.gaussians.model import GaussiansModel, GaussiansSettings, camera_extent
from xplanes.models.base import InitialValues
from xplanes.rendering.sampler import Group, Site
from xplanes.settings import Positive
from xplanes.streams import Stream, initial_values


@dataclass(frozen=True, kw_only=True)
class SpacetimeGaussiansSettings(GaussiansSettings):
    """Spacetime Gaussians: opacity is a radial basis function of time, motion a polynomial."""

    field_class: ClassVar = SpacetimeGaussians

    first_width: Positive  # Initial width of the radial basis; the whole sequence has length 1.
    centre_lr: Positive  # Learning rate of the centres of the radial bases.
    width_lr: Positive  # Learning rate of the log widths of the radial bases.
    motion_lr: Positive  # Learning rate of the motion polynomials, times the cameras' extent.
    spin_lr: Positive  # Learning rate of the rotation polynomials.

    def build(self, site: Site, initial: InitialValues | None = None) -> "SpacetimeGaussiansModel":
        with initial_values(site.seed, Stream.FIELD):
            field = SpacetimeGaussians(
                self.first_points(site, initial),
                degree=self.degree,
                extent=camera_extent(site),
                moves=site.moves,
                width=self.first_width,
            )
        return SpacetimeGaussiansModel(self, field)


class SpacetimeGaussiansModel(GaussiansModel):
    """Colour errors and adaptive density control.

    Args:
        settings: Learning rates, schedule and weights.
        field: The Gaussians.
    """

    def __init__(self, settings: SpacetimeGaussiansSettings, field: SpacetimeGaussians) -> None:
        super().__init__(settings, field)
        self._field, self.settings = field, settings

    @property
    def field(self) -> SpacetimeGaussians:
        return self._field

    def groups(self) -> list[Group]:
        settings, field, groups = self.settings, self._field, super().groups()
        rates = {
            "centres": settings.centre_lr,
            "log_widths": settings.width_lr,
            "motion": settings.motion_lr * float(field.extent),
            "spin": settings.spin_lr,
        }
        return groups + [
            {"params": [getattr(field, name)], "lr": rate, "name": name}
            for name, rate in rates.items()
        ]
