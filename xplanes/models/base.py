"""Base classes of models: the field, its losses and its learning rates."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from xplanes.fields.base import Representation
from xplanes.rendering.base import Rendering
from xplanes.rendering.sampler import Group, SamplerSettings, Site
from xplanes.scenes.batches import Batch, RaySettings
from xplanes.scenes.frame import NO_HINTS, CubeHints, Frame, scene_frame
from xplanes.scenes.views import Views
from xplanes.settings import Settings, Weight
from xplanes.streams import TrainingState


@dataclass(frozen=True)
class InitialValues:
    """Initial values of a field that is not initialised randomly.

    Models that are not initialised with planes derive their own class.

    Attributes:
        planes: Planes by name. [C, rows, columns] each
        decoder: Weights of the decoder; None for random ones.
        sparse: Target of the regulariser L_r for the time planes; None disables L_r.
            [T, 3, C, H, H]
    """

    planes: Mapping[str, Tensor]
    decoder: Mapping[str, Tensor] | None = None
    sparse: Tensor | None = None


class Model(ABC):
    """A field with its loss terms, optimiser and learning rates.

    Attributes:
        advice: What to change when the loss is not finite, for the error message.
        betas: Adam's decay rates.
    """

    advice: str = "Lower the model's learning rates"
    betas: tuple[float, float] = (0.9, 0.999)

    @property
    @abstractmethod
    def field(self) -> Representation:
        """The field that is trained."""

    @abstractmethod
    def groups(self) -> list[Group]:
        """Parameter groups of the field, each with ``params``, ``lr`` (peak) and ``name``.

        Names must be unique, also among the sampler's groups. A group may contain further arguments
        of the optimiser.
        """

    def optimizer(self, groups: list[Group]) -> torch.optim.Optimizer:
        """The optimiser of the field's and the sampler's parameters; Adam by default.

        Args:
            groups: Parameter groups of the field and the sampler.
        """
        return torch.optim.Adam(groups, betas=self.betas, eps=1e-15, fused=True)

    @abstractmethod
    def rate_factor(self, step: int, progress: float) -> float:
        """Common factor on the learning rates.

        Args:
            step: Number of optimiser steps done.
            progress: Share of the training budget that has been used, from 0 to 1.
        """

    def group_rate_factor(self, group: str, step: int, progress: float) -> float:
        """Factor on the learning rate of one parameter group; `rate_factor` by default.

        Args:
            group: Name of the group.
            step: As for `rate_factor`.
            progress: As for `rate_factor`.
        """
        return self.rate_factor(step, progress)

    def losses(self, rendering: Any, rays: Batch, state: TrainingState) -> dict[str, Tensor]:
        """Weighted loss terms that need the rays, by name; training minimises their sum. [] each

        Args:
            rendering: The rendering of the rays.
            rays: The batch.
            state: Seed and progress of training.
        """
        return {"colour": colour_error(rendering, rays)}

    def regularise(self, state: TrainingState) -> None:
        """Add the gradients of loss terms that need no rays to the parameters' ``.grad``."""
        return

    def regularisers(self, state: TrainingState) -> dict[str, float]:
        """Weighted values of the terms in `regularise`, by name, for the logger."""
        return {}

    def before_step(self, state: TrainingState, optimizer: torch.optim.Optimizer) -> None:
        """Apply scheduled changes to the field before a batch is rendered.

        Args:
            state: Seed and progress of training.
            optimizer: The optimiser; if parameters are replaced, its state must be, too.
        """
        return

    def scalars(self) -> dict[str, float]:
        """Further values for the logger, by name."""
        return {}

    @property
    def replaces_parameters(self) -> bool:
        """Whether training changes the parameters' shapes, so that weights cannot be averaged."""
        return False

    @property
    def sparse(self) -> Tensor | None:
        """The sparse part of the initial values, while a loss term needs it. [T, 3, C, H, H]

        Only the model keeps a reference, so that the memory can be freed.
        """
        return None


@dataclass(frozen=True, kw_only=True)
class ModelSettings(Settings, ABC):
    """Base class of the settings of models."""

    takes: ClassVar[str | None] = None
    """Kind of initialisation that the field accepts, such as "planes"; None: only random."""
    devices: ClassVar[int | None] = 1
    """Maximum number of devices for training; None for no limit."""
    field_class: ClassVar[type[Representation] | None] = None
    """Class of the field, to check the sampler before the scene is read; None skips this."""

    name: str  # Name in run directories and tables.
    precision: Literal["auto", "32", "bf16"]  # Precision of matrix products; auto: bf16 if fast.
    rays: RaySettings
    sampler: SamplerSettings

    @property
    def is_static(self) -> bool:
        """Whether the field ignores time."""
        return False

    @abstractmethod
    def build(self, site: Site, initial: InitialValues | None = None) -> Model:
        """Build the model for a scene.

        Args:
            site: Context of the field: frame, times, training views, seed and device.
            initial: Initial values; random when None.
        """

    def stronger(self) -> "ModelSettings | None":
        """Settings for a restart after the field collapsed to empty space or fog.

        None if there are none: training then continues with the collapsed field.
        """
        return None

    def texels(self, site: Site) -> int | None:
        """Texels of the finest space planes along each axis; None for fields without planes."""
        texels = getattr(self, "resolution", None)
        return texels if isinstance(texels, int) else None

    def frame(self, views: Views, hints: CubeHints = NO_HINTS) -> Frame:
        """The field's frame: the scene's cube, unless the model defines another.

        Args:
            views: Training views.
            hints: Information about the scene's cube.

        Raises:
            SceneError: If the cameras see no common volume.
        """
        return scene_frame(views, hints)

    def for_scene(self, views: Views, hints: CubeHints = NO_HINTS) -> "ModelSettings":
        """The settings with the scene's cube, near and far, where published ones do not fit it.

        Unchanged by default: most models take these from the scene anyway.

        Args:
            views: Training views.
            hints: As for `frame`; a given cube also replaces a published one that fits.
        """
        return self

    def bounds(self, views: Views) -> Tensor | None:
        """Lower and upper corner of the field's bounding box in the world, if it has one. [2, 3]"""
        return None


@dataclass(frozen=True, kw_only=True)
class LossTerm(Settings, ABC):
    """An additional loss term for any model: ``+losses.NAME={_target_: module.Class, ...}``."""

    weight: Weight  # Factor on its value.

    @abstractmethod
    def value(
        self, field: Representation, rendering: Any, rays: Batch, state: TrainingState
    ) -> Tensor:
        """The unweighted value of the term, differentiable. []

        Args:
            field: The field.
            rendering: The rendering of this batch.
            rays: The batch of rays, with their ``target`` colours [R, 3].
            state: Seed and progress of training.
        """


def colour_error(rendering: Rendering, rays: Batch) -> Tensor:
    """Mean squared error of the rays' colours. []"""
    return ray_mean((rendering.colour - rays["target"]).square().mean(dim=1), rays)


def ray_mean(values: Tensor, rays: Batch) -> Tensor:
    """Mean over rays; ``weight``, if any, corrects for importance sampling. [R] -> []"""
    weight = rays.get("weight")
    return values.mean() if weight is None else (weight * values).mean()


def opacity_error(rendering: Rendering, rays: Batch) -> Tensor:
    """Mean squared error of the rays' opacity against the images' alpha. []"""
    return ray_mean((rendering.opacity - rays["alpha"]).square(), rays)


def background_opacity(rendering: Rendering, rays: Batch) -> Tensor:
    """Opacity of the rays at pixels with alpha 0, summed and divided by the number of all rays. []

    Its gradient does not vanish with the opacity, so that faint floaters are removed, too.
    """
    return ray_mean(rendering.opacity * (rays["alpha"] == 0), rays)


def opacity_shortfall(rendering: Rendering, rays: Batch) -> Tensor:
    """Mean squared amount by which rays are too transparent for their colours. []

    For images without alpha: a colour ``c`` over a background ``b`` needs an opacity of at least
    ``|c - b| / max(b, 1 - b)``, whatever the colour of the surface.
    """
    background = rays["background"]
    gap = (rays["target"] - background).abs() / torch.maximum(background, 1 - background)
    return ray_mean((gap.amax(dim=-1) - rendering.opacity).relu().square(), rays)


def warm_cosine(step: int, progress: float, *, warmup: int, final: float) -> float:
    """Linear warm-up over ``warmup`` steps, times cosine decay from 1 to ``final``."""
    warm = min(1.0, (step + 1) / max(1, warmup))
    return warm * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * progress)))
