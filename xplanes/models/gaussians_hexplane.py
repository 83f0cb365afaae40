"""4D Gaussian splatting (Wu et al., CVPR 2024): canonical Gaussians, deformed by six planes."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from xplanes.errors import ConfigError
from xplanes.fields.gaussians import HexPlaneGaussians
from xplanes.fields.products import PlaneProducts
from xplanes.fields.regularisers import add_time_smoothness_gradient, time_smoothness
from xplanes.metrics import dissimilarity
from xplanes.models.base import InitialValues, Model, ModelSettings
from xplanes.models.densification import DensifySettings, densify, reset_opacity
from xplanes.models.hull import hull_points, random_points
from xplanes.rendering.gaussians.harmonics import MAX_DEGREE
from xplanes.rendering.gaussians.renderer import RasterisedRendering
from xplanes.rendering.sampler import Group, Site
from xplanes.scenes.batches import Batch, ViewSettings
from xplanes.scenes.views import Views
from xplanes.settings import Count, Positive, Settings, Share, Steps, Weight
from xplanes.streams import Stream, TrainingState, initial_values

EXTENT = 1.1
"""Factor on the largest distance of a camera from their mean (Kerbl et al. 2023)."""


@dataclass(frozen=True, kw_only=True)
class HexPlaneLoss(Settings):
    """Weights of the terms of the loss beyond the mean absolute error of colours."""

    dissimilarity: Weight  # Weight of 1 - SSIM.
    space_smoothness: Weight  # Weight of squared second differences of space planes.
    time_smoothness: Weight  # Weight of squared second differences of time planes along time.
    time_identity: Weight  # Weight of the distance of time planes from 1.
    every: Count  # Steps between the gradients of the planes' terms, which count as many times.


@dataclass(frozen=True, kw_only=True)
class HexPlaneGaussiansSettings(ModelSettings):
    """4D-GS: canonical Gaussians, a static stage, then their deformation by a six-plane field."""

    field_class: ClassVar = HexPlaneGaussians

    rays: ViewSettings  # pyright: ignore[reportIncompatibleVariableOverride]
    points: Literal["silhouettes", "random"]  # First means: on the visual hull, or in the cube.
    count: Count  # Their number.
    degree: Steps  # Highest degree of the spherical harmonics.
    degree_every: Count  # Steps after which the next degree is used.
    static_share: Share  # Share of the budget before the deformation begins.
    resolution: Count  # Texels along each space axis at the first scale.
    scales: list[Count]  # Factors on the space resolution.
    time_resolution: Count | None  # Rows of time; null: half the training views.
    channels: Count  # Channels of each plane and scale.
    width: Count  # Neurons of the hidden layers.
    mean_lr: Positive  # Learning rate of means, times the cameras' extent.
    colour_lr: Positive  # Learning rate of colours; a twentieth for what depends on direction.
    opacity_lr: Positive  # Learning rate of opacities, before the sigmoid.
    scale_lr: Positive  # Learning rate of scales, before the exponential.
    rotation_lr: Positive  # Learning rate of quaternions.
    plane_lr: Positive  # Learning rate of planes.
    network_lr: Positive  # Learning rate of the network behind them.
    final_lr: Share  # Final share of the learning rates of means, planes and network.
    densify: DensifySettings
    loss: HexPlaneLoss

    def check(self) -> None:
        if self.precision == "bf16":
            raise ConfigError("precision=bf16: Gaussians are computed in float32; set 32 or auto")
        if not self.scales:
            raise ConfigError("scales=[]: must be one or more numbers above 0")
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

    def build(self, site: Site, initial: InitialValues | None = None) -> "HexPlaneGaussiansModel":
        with initial_values(site.seed, Stream.BASELINE_FIELD):
            planes = None
            if site.moves:
                rows = self.time_resolution or site.time_rows
                planes = PlaneProducts(
                    self.channels, self.resolution, self.scales, rows, low=0.1, high=0.5
                )
            if self.points == "silhouettes" and site.views is not None:
                points, colours = hull_points(site.views, site.frame, self.count)
            else:
                points, colours = random_points(self.count)
            extent = 1.0 if site.views is None else camera_extent(site.views) * site.frame.scale
            field = HexPlaneGaussians(
                *(points, colours),
                degree=self.degree,
                extent=extent,
                planes=planes,
                width=self.width,
            )
        return HexPlaneGaussiansModel(self, field)


class HexPlaneGaussiansModel(Model):
    """The colours' absolute error, smooth planes, and adaptive density control.

    Args:
        settings: Learning rates, schedule and weights.
        field: The Gaussians.
    """

    def __init__(self, settings: HexPlaneGaussiansSettings, field: HexPlaneGaussians) -> None:
        self._field, self.settings = field, settings
        self.advice = (
            f"Lower model.scale_lr={settings.scale_lr} or model.plane_lr={settings.plane_lr}"
        )

    @property
    def field(self) -> HexPlaneGaussians:
        return self._field

    def groups(self) -> list[Group]:
        settings, field = self.settings, self._field
        rates = {
            "means": settings.mean_lr * float(field.extent),
            "quaternions": settings.rotation_lr,
            "log_scales": settings.scale_lr,
            "logits": settings.opacity_lr,
            "base": settings.colour_lr,
            "detail": settings.colour_lr / 20,
        }
        groups: list[Group] = [
            {"params": [getattr(field, name)], "lr": rate, "name": name}
            for name, rate in rates.items()
        ]
        if field.products is not None:
            planes, network = list(field.products.parameters()), list(field.network.parameters())
            groups.append({"params": planes, "lr": settings.plane_lr, "name": "planes"})
            groups.append({"params": network, "lr": settings.network_lr, "name": "network"})
        return groups

    def rate(self, step: int, progress: float) -> float:
        return 1.0

    def rate_of(self, group: str, step: int, progress: float) -> float:
        """Exponential decay of means, planes and network, from the start in each stage."""
        if group not in ("means", "planes", "network"):
            return 1.0
        static = self.settings.static_share if self._field.moves else 0.0
        begun = static if progress >= static else 0.0
        return self.settings.final_lr ** ((progress - begun) / max(1 - static, 1e-6))

    def before_step(self, state: TrainingState, optimizer: torch.optim.Optimizer) -> None:
        settings, field, step = self.settings, self._field, state.step
        if state.batch % settings.rays.accumulate:
            return  # Gradients wait, row by row.
        field.degree.fill_(min(settings.degree, step // settings.degree_every))
        if field.moves and not field.deforms and state.progress >= settings.static_share:
            field.deforms.fill_(True)
            optimizer.state.clear()
            field.slopes.zero_()
            field.seen.zero_()
        control = settings.densify
        if not step or state.progress >= control.until:
            return
        reset = control.reset_every
        if step > control.first and step % control.every == 0:
            generator = state.generator(torch.device("cpu"), Stream.SPLITTING)
            late = reset is not None and step > reset
            densify(field, optimizer, control, generator, remove_large=late)
        if reset is not None and step % reset == 0:
            reset_opacity(field, optimizer)

    def losses(
        self, rendering: RasterisedRendering, rays: Batch, state: TrainingState
    ) -> dict[str, Tensor]:
        terms = {"colour": (rendering.colour - rays["target"]).abs().mean()}
        if weight := self.settings.loss.dissimilarity:
            truth = rays["target"].view_as(rendering.image.colour)
            terms["dissimilarity"] = weight * dissimilarity(rendering.image.colour, truth)
        return terms

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

    def scalars(self) -> dict[str, float]:
        return {"gaussians": float(len(self._field))}


def camera_extent(views: Views) -> float:
    """How far the cameras stand from their mean at most, 1.1 times, in world units."""
    places = views.camera_to_world[:, :3, 3]
    return EXTENT * float((places - places.mean(dim=0)).norm(dim=1).max())
