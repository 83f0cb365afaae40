"""What training asks of a model: a field, its losses, its learning rates."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from xplanes.fields.base import Representation
from xplanes.fields.gaussians import PointCloud
from xplanes.rendering.base import Rendering
from xplanes.rendering.sampler import Group, SamplerSettings, Site, scene_cube
from xplanes.scenes.batches import Batch, RaySettings
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views
from xplanes.settings import Settings, Weight
from xplanes.streams import TrainingState


@dataclass(frozen=True)
class InitialValues:
    """Initial values of a field that is not initialised randomly.

    Attributes:
        planes: Planes by name; none for Gaussians. [C, rows, columns] each
        decoder: Weights of the decoder; None for a fresh one.
        sparse: Target of the regulariser L_r for the time planes; None disables L_r.
            [T, 3, C, H, H]
        points: What Gaussians are made from; None for planes.
    """

    planes: Mapping[str, Tensor]
    decoder: Mapping[str, Tensor] | None = None
    sparse: Tensor | None = None
    points: PointCloud | None = None


class Model(ABC):
    """A field with what its training consists of.

    Attributes:
        advice: What to change when the loss is not finite.
    """

    advice: str = "Lower the model's learning rates"

    @property
    @abstractmethod
    def field(self) -> Representation:
        """What is trained."""

    @abstractmethod
    def groups(self) -> list[Group]:
        """The field's trainable parameters: ``params``, ``lr`` and ``name`` of each group.

        A group may hold arguments of the optimiser besides.
        """

    def optimizer(self, groups: list[Group]) -> torch.optim.Optimizer:
        """The optimiser of the field's and the sampler's parameters."""
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    @abstractmethod
    def rate(self, step: int, progress: float) -> float:
        """Factor on all learning rates.

        Args:
            step: Optimiser steps done.
            progress: Share of the budget that is spent.
        """

    def rate_of(self, group: str, step: int, progress: float) -> float:
        """The same for the learning rate of one group, by its name."""
        return self.rate(step, progress)

    def losses(self, rendering: Any, rays: Batch, state: TrainingState) -> dict[str, Tensor]:
        """Weighted terms of the loss that need the rays, by name; their sum is minimised."""
        return {"colour": colour_error(rendering, rays)}

    def regularise(self, state: TrainingState) -> None:
        """Add the gradients of the terms that need no rays to ``.grad``."""
        return

    def regularisers(self, state: TrainingState) -> dict[str, float]:
        """Weighted values of the terms that `regularise` adds, by name, for the logger."""
        return {}

    def before_step(self, state: TrainingState, optimizer: torch.optim.Optimizer) -> None:
        """Change the field as its schedule asks, before a batch is rendered."""
        return

    def scalars(self) -> dict[str, float]:
        """Further values for the logger."""
        return {}


@dataclass(frozen=True, kw_only=True)
class ModelSettings(Settings, ABC):
    """Base of the settings of models."""

    takes: ClassVar[Literal["planes", "points"] | None] = None
    """What of an initialisation the field can begin with; None for nothing."""
    devices: ClassVar[int | None] = 1
    """Devices that it can be trained on at most; None for any number."""
    field_class: ClassVar[type[Representation] | None] = None
    """What is built, so that samplers can refuse it early; None leaves that to them."""

    name: str  # Name in run directories and tables.
    precision: Literal["auto", "32", "bf16"]  # Of products; auto: bf16 where it is fast.
    rays: RaySettings
    sampler: SamplerSettings

    @property
    def is_static(self) -> bool:
        """Whether these settings leave time out of the field."""
        return False

    @abstractmethod
    def build(self, site: Site, initial: InitialValues | None = None) -> Model:
        """The model for a scene."""

    def stronger(self) -> "ModelSettings | None":
        """These settings with what helps where a field came to show nothing, or fog.

        None where no such settings are known: the field is then left as it is.
        """
        return None

    def frame(self, views: Views, half_side: float | None, points: Tensor | None = None) -> Frame:
        """The frame in which the field lives: the scene's cube, if the model has none of its own.

        Args:
            views: Training views.
            half_side: Half the side of the scene's cube in world units; None finds it.
            points: World points on surfaces, if known. [N, 3]
        """
        return scene_cube(views, half_side, points)

    def bounds(self, views: Views) -> Tensor | None:
        """Box in world units that the field covers, where it needs one. [2, 3]"""
        return None


@dataclass(frozen=True, kw_only=True)
class LossTerm(Settings, ABC):
    """A further term of the loss, for any model: ``+losses.NAME={_target_: module.Class, ...}``."""

    weight: Weight  # Factor on its value.

    @abstractmethod
    def value(
        self, field: Representation, rendering: Any, rays: Batch, state: TrainingState
    ) -> Tensor:
        """The term without its weight, differentiable. []

        Args:
            field: The field.
            rendering: What the rays of this step see.
            rays: The rays, with their ``target`` colours.
            state: How far training is.
        """


def colour_error(rendering: Rendering, rays: Batch) -> Tensor:
    """Mean squared error of the rays' colours. []"""
    return (rendering.colour - rays["target"]).square().mean()


def opacity_error(rendering: Rendering, rays: Batch) -> Tensor:
    """Mean squared error of the rays' opacity against the images' alpha. []"""
    return (rendering.opacity - rays["alpha"]).square().mean()


def background_opacity(rendering: Rendering, rays: Batch) -> Tensor:
    """Opacity of the rays at pixels with alpha 0, summed and divided by the number of all rays. []

    Its gradient does not fade as opacity falls: faint floaters go as well.
    """
    return (rendering.opacity * (rays["alpha"] == 0)).mean()


def opacity_shortfall(rendering: Rendering, rays: Batch) -> Tensor:
    """Mean squared amount by which rays are too transparent for their colours. []

    For images without alpha: a colour ``c`` in front of a background ``b`` takes an opacity of at
    least ``|c - b| / max(b, 1 - b)``, whatever the colour of the surface.
    """
    background = rays["background"]
    gap = (rays["target"] - background).abs() / torch.maximum(background, 1 - background)
    return (gap.amax(dim=-1) - rendering.opacity).relu().square().mean()


def warm_cosine(step: int, progress: float, *, warmup: int, final: float) -> float:
    """A linear rise over ``warmup`` steps on half a cosine from 1 to ``final``."""
    warm = min(1.0, (step + 1) / max(1, warmup))
    return warm * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * progress)))
