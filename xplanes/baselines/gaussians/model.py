"""Base of all models of Gaussians: initial points, learning rates, loss, density control."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, TypeVar

import torch
from torch import Tensor

from xplanes.baselines.base import BaselineModel
from xplanes.baselines.gaussians.densification import DensifySettings, densify, reset_opacity
from xplanes.baselines.gaussians.field import Gaussians, PointCloud
from xplanes.baselines.gaussians.harmonics import MAX_DEGREE
from xplanes.baselines.gaussians.hull import hull_points, random_points
from xplanes.errors import ConfigError
from xplanes.metrics import dissimilarity
from xplanes.models.base import InitialValues, ModelSettings
from xplanes.rendering.sampler import Group, Site
from xplanes.scenes.batches import Batch, ViewSettings
from xplanes.settings import Count, Positive, Settings, Share, Steps
from xplanes.streams import Stream, TrainingState

EXTENT = 1.1
"""Factor on the largest distance of a camera from the cameras' mean (Kerbl et al. 2023)."""


@dataclass(frozen=True, kw_only=True)
class InitialPoints(InitialValues):
    """Points from which Gaussians are initialised."""

    planes: Mapping[str, Tensor] = field(default_factory=dict)
    cloud: PointCloud


@dataclass(frozen=True, kw_only=True)
class GaussiansLoss(Settings):
    """Weights of the terms of the loss."""

    dissimilarity: Share  # Share of 1 - SSIM; the rest is the mean absolute colour error.


@dataclass(frozen=True, kw_only=True)
class GaussiansSettings(ModelSettings):
    """Base of the settings of models of Gaussians."""

    takes: ClassVar = "points"

    rays: ViewSettings  # pyright: ignore[reportIncompatibleVariableOverride]
    # Initial means if lrm gives none: on the visual hull, or random in the cube.
    points: Literal["silhouettes", "random"]
    count: Count  # Number of these initial means.
    degree: Steps  # Highest degree of the spherical harmonics.
    degree_every: Count  # Steps between increases of the degree.
    mean_lr: Positive  # Learning rate of means, times the cameras' extent.
    colour_lr: Positive  # Learning rate of colours; a twentieth for their view-dependent part.
    opacity_lr: Positive  # Learning rate of opacity logits.
    scale_lr: Positive  # Learning rate of log scales.
    rotation_lr: Positive  # Learning rate of quaternions.
    final_lr: Share  # Final value of decaying learning rates relative to the initial one.
    densify: DensifySettings
    loss: GaussiansLoss

    def check(self) -> None:
        if self.precision == "bf16":
            raise ConfigError("precision=bf16: Gaussians are computed in float32; set 32 or auto")
        if self.degree > MAX_DEGREE:
            raise ConfigError(f"degree={self.degree}: must be 0 to {MAX_DEGREE}")
        if self.final_lr == 0:
            raise ConfigError(
                "final_lr=0.0: the decay is exponential; set 0.01 or any share above 0"
            )
        if self.count > self.densify.most:
            raise ConfigError(
                f"count={self.count}: must not be above densify.most={self.densify.most}"
            )

    def canonical(self, site: Site, initial: InitialValues | None) -> dict[str, Any]:
        """Arguments of all fields: initial points, degree, and extent of the cameras.

        Points are drawn with torch's global generator.
        """
        if isinstance(initial, InitialPoints):
            cloud = initial.cloud
        elif site.views is None:
            cloud = random_points(1)  # The Gaussians are loaded from a checkpoint.
        elif self.points == "silhouettes":
            cloud = hull_points(site.views, site.frame, self.count)
        else:
            cloud = random_points(self.count)
        return {"cloud": cloud, "degree": self.degree, "extent": camera_extent(site)}


S = TypeVar("S", bound=GaussiansSettings)
F = TypeVar("F", bound=Gaussians)


class GaussiansModel(BaselineModel[S, F]):
    """Absolute colour error and dissimilarity (1 - SSIM), and adaptive density control."""

    doubted = ("scale_lr", "mean_lr")

    @property
    def static_share(self) -> float:
        """Share of the budget before anything moves."""
        return getattr(self.settings, "static_share", 0.0)

    @property
    def replaces_parameters(self) -> bool:
        return self.settings.densify.until > 0

    def rates(self) -> dict[str, float]:
        """Learning rates of the tensors with one row per Gaussian."""
        settings = self.settings
        return {
            "means": settings.mean_lr * float(self._field.extent),
            "quaternions": settings.rotation_lr,
            "log_scales": settings.scale_lr,
            "logits": settings.opacity_lr,
            "base": settings.colour_lr,
            "detail": settings.colour_lr / 20,
        }

    def groups(self) -> list[Group]:
        return [
            {"params": [getattr(self._field, name)], "lr": rate, "name": name}
            for name, rate in self.rates().items()
        ]

    def rate_factor(self, step: int, progress: float) -> float:
        return 1.0

    def group_rate_factor(self, group: str, step: int, progress: float) -> float:
        """Exponential decay of the means' learning rate."""
        return self.settings.final_lr**progress if group == "means" else 1.0

    def before_step(self, state: TrainingState, optimizer: torch.optim.Optimizer) -> None:
        settings, field, step = self.settings, self._field, state.step
        field.degree.fill_(min(settings.degree, step // settings.degree_every))
        if field.moves and not field.deforms and state.progress >= self.static_share:
            field.deforms.fill_(True)
            self.begin_to_move(optimizer)
        control = settings.densify
        if not step or state.progress >= control.until:
            return
        reset = control.reset_every
        if step > control.first and step % control.every == 0:
            generator = state.generator(torch.device("cpu"), Stream.SPLITTING)
            late = reset is not None and step > reset
            views = max(1, round(state.batch / step))
            densify(field, optimizer, control, generator, remove_large=late, views=views)
        if reset is not None and step % reset == 0:
            reset_opacity(field, optimizer)

    def begin_to_move(self, optimizer: torch.optim.Optimizer) -> None:
        """Called at the end of the static stage."""
        return

    def losses(self, rendering: Any, rays: Batch, state: TrainingState) -> dict[str, Tensor]:
        share, target = self.settings.loss.dissimilarity, rays["target"]
        colour = rendering.colour
        if (shown := rays.get("shown")) is not None:  # Ignored pixels have no error.
            colour = torch.where(shown[:, None], colour, target)
        terms = {"colour": (1 - share) * (colour - target).abs().mean()}
        if share:
            shape = rendering.image.colour.shape
            terms["dissimilarity"] = share * dissimilarity(colour.view(shape), target.view(shape))
        return terms

    def scalars(self) -> dict[str, float]:
        return {"gaussians": float(len(self._field))}


def camera_extent(site: Site) -> float:
    """Extent of the cameras: 1.1 times their largest distance from their mean, in frame units.

    It is at least 1, half the side of the cube, since all cameras may have the same position.
    """
    if site.views is None:
        return 1.0
    places = site.views.camera_to_world[:, :3, 3]
    farthest = float((places - places.mean(dim=0)).norm(dim=1).max())
    return max(1.0, EXTENT * farthest * site.frame.scale)
