"""Spacetime Gaussians (Li et al., CVPR 2024), lite: Gaussians with a lifetime and a trajectory."""

from dataclasses import dataclass
from typing import ClassVar

from xplanes.baselines.gaussians.field import SpacetimeGaussians
from xplanes.baselines.gaussians.model import GaussiansModel, GaussiansSettings
from xplanes.models.base import InitialValues
from xplanes.rendering.sampler import Site
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
                **self.canonical(site, initial), moves=site.moves, width=self.first_width
            )
        return SpacetimeGaussiansModel(self, field)


class SpacetimeGaussiansModel(GaussiansModel[SpacetimeGaussiansSettings, SpacetimeGaussians]):
    """Colour errors and adaptive density control."""

    def rates(self) -> dict[str, float]:
        settings = self.settings
        return super().rates() | {
            "centres": settings.centre_lr,
            "log_widths": settings.width_lr,
            "motion": settings.motion_lr * float(self._field.extent),
            "spin": settings.spin_lr,
        }
