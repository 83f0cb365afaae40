"""TiNeuVox (Fang et al., SIGGRAPH Asia 2022), small and base, as in the released code."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from xplanes.baselines.base import BaselineModel
from xplanes.baselines.bounds import origin_cube, seen_range
from xplanes.baselines.tineuvox.field import TiNeuVox
from xplanes.baselines.tineuvox.fixed_step import FixedStepRendering
from xplanes.errors import ConfigError
from xplanes.models.background import BackgroundSettings
from xplanes.models.base import InitialValues, ModelSettings, colour_error
from xplanes.rendering.base import Rendering
from xplanes.rendering.sampler import Group, Site
from xplanes.scenes.batches import Batch
from xplanes.scenes.frame import NO_HINTS, CubeHints, Frame, cube_frame, scene_frame
from xplanes.scenes.views import Views
from xplanes.settings import Count, Positive, Range, Settings, Steps, Weight
from xplanes.streams import Stream, TrainingState, initial_values

LEAST_LIGHT = 1e-6
"""Transmittance is clamped to [LEAST_LIGHT, 1 - LEAST_LIGHT] in the entropy."""


@dataclass(frozen=True, kw_only=True)
class TiNeuVoxLoss(Settings):
    """Weights of the terms of the loss beyond the colour's mean squared error."""

    entropy: Weight  # Weight of the entropy of the rays' opacity.
    sample_colour: Weight  # Weight of the squared colour error of individual samples.


@dataclass(frozen=True, kw_only=True)
class TiNeuVoxSettings(ModelSettings):
    """TiNeuVox: a feature grid in canonical space, a deformation network and small decoders."""

    field_class: ClassVar = TiNeuVox

    near: Weight  # Near bound of the camera frusta that define the grid's bounding box.
    far: Positive  # Far bound of these camera frusta, in world units.
    margin: Positive  # Factor on the size of the bounding box.
    half_side: Positive | None  # Half the side of a cube at the origin; null: the bounding box.
    resolution: Count  # Cube root of the final number of cells.
    channels: Count  # Channels of each cell.
    width: Count  # Neurons of the hidden layers.
    alpha_start: Annotated[float, Range(0, 1, open=True)]  # Initial opacity of one cell.
    point_octaves: Steps  # Frequencies of the position encoding.
    time_octaves: Steps  # Frequencies of the time encoding.
    direction_octaves: Steps  # Frequencies of the direction encoding.
    feature_octaves: Steps  # Frequencies of the feature encoding.
    grow_at: list[int]  # Steps at which the number of cells doubles.
    grid_learning_rate: Positive  # Learning rate of the grid.
    deformation_learning_rate: Positive  # Learning rate of the deformation network.
    network_learning_rate: Positive  # Learning rate of the other networks.
    decay_steps: Count  # Steps over which the learning rates decay to a tenth.
    # Learnt background, for opaque images with a real background; null: a plain colour.
    background: BackgroundSettings | None = None
    loss: TiNeuVoxLoss

    def check(self) -> None:
        if self.near >= self.far:
            raise ConfigError(f"near={self.near}: must be below far={self.far}")

    def bounds(self, views: Views) -> Tensor:
        if self.half_side is None:
            return frusta_box(views, self.near, self.far, self.margin)
        return torch.tensor([[-1.0] * 3, [1.0] * 3]) * self.half_side

    def frame(self, views: Views, hints: CubeHints = NO_HINTS) -> Frame:
        """The smallest cube around the world's origin that holds the grid's box."""
        if self.half_side is not None:
            return origin_cube(self.half_side, views, hints)
        return cube_frame(float(self.bounds(views).abs().max()), torch.zeros(3))

    def for_scene(self, views: Views, hints: CubeHints = NO_HINTS) -> "TiNeuVoxSettings":
        near, far = seen_range(views, scene_frame(views, hints))
        seen = self.near <= near and far <= self.far and self.sampler.holds(near, far)
        if seen and not hints.is_given:
            return self
        sampler = self.sampler.bounded(near, far)
        return replace(self, near=near, far=far, half_side=None, sampler=sampler)

    def build(self, site: Site, initial: InitialValues | None = None) -> "TiNeuVoxModel":
        assert site.bounds is not None
        octaves = (
            *(self.point_octaves, self.time_octaves),
            *(self.direction_octaves, self.feature_octaves),
        )
        with initial_values(site.seed, Stream.FIELD):
            field = TiNeuVox(
                site.bounds,
                self.resolution,
                self.channels,
                self.width,
                octaves=octaves,
                alpha=self.alpha_start,
                halvings=len(self.grow_at),
                moves=site.moves,
                unit=site.unit,
                precision=site.precision,
                background=None if self.background is None else self.background.build(site),
            )
        return TiNeuVoxModel(self, field)


class TiNeuVoxModel(BaselineModel[TiNeuVoxSettings, TiNeuVox]):
    """Colour error, entropy of the opacity, and colour error of individual samples.

    The optimiser's state and the decay of learning rates are reset whenever the grid grows.
    """

    doubted = ("grid_learning_rate", "network_learning_rate")

    @property
    def replaces_parameters(self) -> bool:
        return bool(self.settings.grow_at)

    def groups(self) -> list[Group]:
        settings, field = self.settings, self._field
        grid = {"params": [field.grid], "lr": settings.grid_learning_rate, "name": "grid"}
        groups: list[Group] = [grid | {"masked": True}]
        for name, part in field.named_children():
            if part is field.background:
                continue
            deforms = name == "deformation"
            rate = settings.deformation_learning_rate if deforms else settings.network_learning_rate
            groups.append({"params": list(part.parameters()), "lr": rate, "name": name})
        if field.background is not None and settings.background is not None:
            groups += settings.background.groups(field.background)
        return groups

    def optimizer(self, groups: list[Group]) -> torch.optim.Optimizer:
        return MaskedAdam(groups)

    def rate_factor(self, step: int, progress: float) -> float:
        begun = max([at for at in self.settings.grow_at if at <= step], default=0)
        return 0.1 ** ((step - begun) / self.settings.decay_steps)

    def voxels(self, step: int) -> int:
        """Number of cells at a step."""
        to_come = sum(at > step for at in self.settings.grow_at)
        return self._field.resolution**3 // 2**to_come

    def before_step(self, state: TrainingState, optimizer: torch.optim.Optimizer) -> None:
        voxels = self.voxels(state.step)
        if self._field.count != voxels:
            self._field.resize(voxels)
            optimizer.state.clear()

    def regularise(self, state: TrainingState) -> None:
        if self._field.background is not None and self.settings.background is not None:
            self.settings.background.regularise(self._field.background)

    def losses(self, rendering: Rendering, rays: Batch, state: TrainingState) -> dict[str, Tensor]:
        weights = self.settings.loss
        terms = {
            "colour": colour_error(rendering, rays),
            "entropy": weights.entropy * light_entropy(rendering.opacity),
        }
        if isinstance(rendering, FixedStepRendering):
            samples = rendering.weights, rendering.ray
            spread = sample_colour_error(rendering.colours, rays["target"], *samples)
            terms["sample_colour"] = weights.sample_colour * spread
        if self._field.background is not None and self.settings.background is not None:
            terms |= self.settings.background.losses(self._field.background, rendering, rays, state)
        return terms

    def scalars(self) -> dict[str, float]:
        return {"grid/cells": float(self._field.count)}


def frusta_box(views: Views, near: float, far: float, margin: float) -> Tensor:
    """Bounding box of camera frusta between two distances, enlarged by ``margin``. [2, 3]"""
    low, high = torch.full((3,), torch.inf), torch.full((3,), -torch.inf)
    for index in range(len(views)):
        origins, directions = views.image_rays(index)
        for distance in (near, far):
            ends = origins + distance * directions
            low, high = torch.minimum(low, ends.amin(dim=0)), torch.maximum(high, ends.amax(dim=0))
    room = (margin - 1) / 2 * (high - low)
    return torch.stack([low - room, high + room])


def light_entropy(opacity: Tensor) -> Tensor:
    """Binary entropy of the opacity in nats, mean over rays. [R] -> []

    Source: TiNeuVox, released code; DirectVoxGO.
    """
    light = (1 - opacity).clamp(LEAST_LIGHT, 1 - LEAST_LIGHT)
    return -(light * light.log() + (1 - light) * (1 - light).log()).mean()


def sample_colour_error(colours: Tensor, target: Tensor, weights: Tensor, ray: Tensor) -> Tensor:
    """Squared colour error of individual samples, weighted and summed along rays, mean over rays.

    Args:
        colours: Colour of each sample. [M, 3]
        target: Ground-truth colour of each ray. [R, 3]
        weights: Compositing weight of each sample, without gradient. [M]
        ray: Ray of each sample. [M]

    Source: TiNeuVox, released code; DirectVoxGO.
    """
    error = (colours - target[ray]).square().sum(dim=1)
    return (error * weights).sum() / len(target)


class MaskedAdam(torch.optim.Optimizer):
    """Adam with ``masked`` groups, where entries with zero gradient keep value and moments.

    Bias corrections are part of the step size, so ``eps`` is added to the uncorrected root.

    Args:
        groups: Parameter groups with ``params``, ``lr`` and optionally ``masked``.
        betas: Decay rates of the two moments.
        eps: Added to the denominator.

    Source: TiNeuVox and DirectVoxGO, released code.
    """

    def __init__(
        self,
        groups: list[dict[str, Any]],
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-8,
    ) -> None:
        super().__init__(groups, {"lr": 1e-3, "betas": betas, "eps": eps, "masked": False})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Update all parameters that have a gradient."""
        result = None
        if closure is not None:
            with torch.enable_grad():
                result = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._update(parameter, group)
        return result

    def _update(self, parameter: torch.Tensor, group: dict[str, Any]) -> None:
        gradient, state = parameter.grad, self.state[parameter]
        assert gradient is not None
        if not state:
            state["step"] = 0
            state["mean"] = torch.zeros_like(parameter)
            state["square"] = torch.zeros_like(parameter)
        state["step"] += 1
        first, second = group["betas"]
        mean, square = state["mean"], state["square"]
        size = (1 - second ** state["step"]) ** 0.5 / (1 - first ** state["step"])
        if not group["masked"]:
            mean.lerp_(gradient, 1 - first)
            square.mul_(second).addcmul_(gradient, gradient, value=1 - second)
            parameter.addcdiv_(mean, square.sqrt().add_(group["eps"]), value=-size * group["lr"])
            return
        if parameter.device.type != "cpu":
            # ``nonzero`` would synchronise with the GPU.
            unreached = gradient == 0
            new_mean = torch.where(unreached, mean, mean.lerp(gradient, 1 - first))
            new_square = (square * second).addcmul_(gradient, gradient, value=1 - second)
            mean.copy_(new_mean)
            square.copy_(torch.where(unreached, square, new_square))
            change = mean / square.sqrt().add_(group["eps"])
            parameter.sub_(change.masked_fill_(unreached, 0), alpha=size * group["lr"])
            return
        reached = gradient.flatten().nonzero()[:, 0]
        flat = gradient.flatten()[reached]
        new_mean = mean.view(-1)[reached].lerp_(flat, 1 - first)
        new_square = square.view(-1)[reached].mul_(second).addcmul_(flat, flat, value=1 - second)
        mean.view(-1)[reached], square.view(-1)[reached] = new_mean, new_square
        change = new_mean / new_square.sqrt().add_(group["eps"])
        parameter.view(-1).index_add_(0, reached, change, alpha=-size * group["lr"])
