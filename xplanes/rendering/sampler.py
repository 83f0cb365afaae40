"""Base classes of samplers, and the context in which fields and samplers are built."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from xplanes.errors import ConfigError
from xplanes.fields.base import RadianceField, Representation
from xplanes.rendering.base import Renderer, Rendering
from xplanes.scenes.batches import Batch
from xplanes.scenes.frame import CameraGroups, Frame
from xplanes.scenes.views import Views
from xplanes.settings import Settings
from xplanes.streams import TrainingState

VIEWS_PER_ROW = 4
"""Views that a timestep needs to have its own row of the time planes."""

RIG_VIEWS = 2
"""Minimum mean number of views per timestep for which cameras count as a rig."""

MANY_POSITIONS = 50
"""Number of camera positions from which fields have more detail."""

Group = dict[str, Any]
"""A parameter group of the optimiser: ``params``, ``lr`` and ``name``."""


@dataclass(frozen=True)
class Site:
    """The context in which a field is built: the scene's frame, times and views, and the run.

    Attributes:
        frame: The field's frame.
        times: Times of the training views, from 0 to 1. [V]
        seed: The run's seed.
        precision: Precision of matrix products: "32" or "bf16".
        bounds: Lower and upper corner of the field's box in the world; None for fields that need
            none. [2, 3]
        views: Training views; None if a checkpoint is loaded without its data.
        positions: Number of positions of the training cameras; None if unknown.
        initialised: Whether the initial field already shows the scene.
        pixels: Image pixels that a side of the field's cube covers.
        coherence: Largest radius of a blur that leaves the training images recognisable, as a share
            of the cube's side; 0 if nothing is to be smoothed.
        surrounded: Whether the training images show surroundings, which lie behind the field's
            cube.
        cameras: Training cameras whose poses are refined; None if they are taken as exact.
        exposed: Training cameras whose exposures are matched; None if they are taken as equal.
        device: Device on which the field will be trained; the CPU when None.
        samples_per_batch: Maximum average number of samples per training batch; None if unknown.
        batch_scale: Batch size relative to the one that schedules assume, see `steps`.
    """

    frame: Frame
    times: Tensor
    seed: int
    precision: str
    bounds: Tensor | None = None
    views: Views | None = None
    positions: int | None = None
    initialised: bool = False
    pixels: float = 0.0
    coherence: float = 0.0
    surrounded: bool = False
    cameras: CameraGroups | None = None
    exposed: CameraGroups | None = None
    device: torch.device | None = None
    samples_per_batch: int | None = None
    batch_scale: float = 1.0

    def steps(self, count: int) -> int:
        """Convert a number of steps to this batch size, for the same number of rays.

        Args:
            count: Steps at the batch size that schedules assume.
        """
        return math.ceil(count / self.batch_scale)

    @property
    def unit(self) -> float:
        """World units per unit of the field's frame."""
        return 1 / self.frame.scale

    @property
    def moves(self) -> bool:
        """Whether the training views show more than one timestep."""
        return len(self.times.unique()) > 1

    @property
    def is_rig(self) -> bool:
        """Whether several cameras show each timestep."""
        return self.moves and len(self.times) >= RIG_VIEWS * len(self.times.unique())

    @property
    def is_seen_from_many(self) -> bool:
        """Whether the training cameras have many positions; false if these are unknown."""
        return (self.positions or 0) >= MANY_POSITIONS

    @property
    def time_rows(self) -> int:
        """Default number of rows along time."""
        return time_rows(self.times)


def time_rows(times: Tensor) -> int:
    """Default number of rows of the time planes.

    One per two distinct times, or up to one per time if there are `VIEWS_PER_ROW` views per row; at
    least 2.

    Args:
        times: Time of each training view. [V]
    """
    distinct = len(times.unique())
    return max(2, math.ceil(distinct / 2), min(distinct, len(times) // VIEWS_PER_ROW))


class Sampler(ABC):
    """Renders training batches, adds its own loss terms, and updates itself between steps."""

    fill_seconds: float = 0.0
    """Extra seconds to build it for an initialised field; they count as preparation."""

    @property
    @abstractmethod
    def renderer(self) -> Renderer:
        """Renderer for whole images."""

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Modules to store in checkpoints, by name."""
        return {}

    @property
    def outline(self) -> str:
        """Short description for reports."""
        return ""

    def groups(self) -> list[Group]:
        """Parameter groups of the sampler, trained together with the field; see `Model.groups`."""
        return []

    @property
    def pruned_at(self) -> int:
        """First step at which empty space is pruned, after which rays are cheaper; 0: never."""
        return 0

    def first_rays(self, most: int) -> int:
        """Number of rays in the first batch, at most ``most``."""
        return most

    @abstractmethod
    def render(self, field: Any, rays: Batch, state: TrainingState) -> Rendering:
        """Render the rays of a training batch.

        Args:
            field: The field.
            rays: The batch: rays, or a whole view.
            state: Seed and progress of training, for jitter and schedules.
        """

    def corrected(self, poses: Tensor, frame: Frame) -> Tensor:
        """Poses in the world as training has corrected them; unchanged by default. [V, 4, 4]

        Args:
            poses: Given poses, such as those of held-out frames of a training camera. [V, 4, 4]
            frame: The field's frame.
        """
        return poses

    def losses(self, rendering: Any) -> dict[str, Tensor]:
        """Weighted loss terms of the sampler, by name. [] each"""
        return {}

    def regularise(self, field: Any, state: TrainingState) -> None:
        """Add the gradients of loss terms that need no rays, once per optimiser step.

        Args:
            field: The field.
            state: Seed and progress of training.
        """
        return

    def regularisers(self, field: Any, state: TrainingState) -> dict[str, float]:
        """Weighted values of the terms in `regularise`, by name, for the logger."""
        return {}

    def observe(self, rendering: Any) -> None:
        """Update the sampler from the rendering of a batch, before the optimiser step."""
        return

    def update(self, field: Any, state: TrainingState) -> None:
        """Update the sampler after an optimiser step, such as its occupancy grid."""
        return

    def expect(self, samples: float) -> None:
        """Prepare for batches with this average number of samples."""
        return

    def scalars(self) -> dict[str, float]:
        """Values for the logger, by name."""
        return {}


class WrappingSampler(Sampler):
    """Base class of samplers that wrap another one.

    Args:
        inner: The wrapped sampler; methods that are not overridden are delegated to it.
    """

    def __init__(self, inner: Sampler) -> None:
        self.inner, self.fill_seconds = inner, inner.fill_seconds

    @property
    def renderer(self) -> Renderer:
        return self.inner.renderer

    @property
    def modules(self) -> dict[str, nn.Module]:
        return self.inner.modules

    @property
    def outline(self) -> str:
        return self.inner.outline

    def groups(self) -> list[Group]:
        return self.inner.groups()

    @property
    def pruned_at(self) -> int:
        return self.inner.pruned_at

    def first_rays(self, most: int) -> int:
        return self.inner.first_rays(most)

    def render(self, field: Any, rays: Batch, state: TrainingState) -> Rendering:
        return self.inner.render(field, rays, state)

    def corrected(self, poses: Tensor, frame: Frame) -> Tensor:
        return self.inner.corrected(poses, frame)

    def losses(self, rendering: Any) -> dict[str, Tensor]:
        return self.inner.losses(rendering)

    def regularise(self, field: Any, state: TrainingState) -> None:
        self.inner.regularise(field, state)

    def regularisers(self, field: Any, state: TrainingState) -> dict[str, float]:
        return self.inner.regularisers(field, state)

    def observe(self, rendering: Any) -> None:
        self.inner.observe(rendering)

    def update(self, field: Any, state: TrainingState) -> None:
        self.inner.update(field, state)

    def expect(self, samples: float) -> None:
        self.inner.expect(samples)

    def scalars(self) -> dict[str, float]:
        return self.inner.scalars()


@dataclass(frozen=True, kw_only=True)
class SamplerSettings(Settings, ABC):
    """Base class of the settings of samplers."""

    devices: ClassVar[int | None] = None
    """Maximum number of devices for training; None for no limit."""

    kind: ClassVar[type[Representation]] = RadianceField
    """Base class of the fields that the sampler accepts."""

    name: str  # Name in tables.

    def require_kind(self, field: type[Representation]) -> None:
        """Check that the class of a field is derived from `kind`.

        Args:
            field: Class of the field.

        Raises:
            ConfigError: If it is not; the message names the remedy.
        """
        if not issubclass(field, self.kind):
            raise ConfigError(
                f"model.sampler.name={self.name}: takes a {self.kind.__name__}, but the model's "
                f"field is a {field.__name__}; leave model/sampler out"
            )

    def require(self, field: Any) -> None:
        """Check that the sampler supports a field of its `kind`.

        Args:
            field: A field, or the class of a field.

        Raises:
            ConfigError: If it does not; the message names samplers that do.
        """

    @abstractmethod
    def build(self, field: Any, site: Site) -> Sampler:
        """Build the sampler for a field.

        Args:
            field: The field.
            site: Context for which the field was built.

        Raises:
            ConfigError, SceneError: If the sampler does not support this field or these cameras.
        """

    def for_video(self) -> "SamplerSettings":
        """Settings for the low-resolution fixed-view video of an LRM; unchanged by default."""
        return self

    def holds(self, near: float, far: float) -> bool:
        """Whether samples cover a scene; true by default, for samplers without near and far.

        Args:
            near: Least distance of the scene from a camera, in world units.
            far: Its largest distance.
        """
        return True

    def bounded(self, near: float, far: float) -> "SamplerSettings":
        """The settings with bounds for a scene; unchanged by default.

        Args:
            near: As for `holds`.
            far: As for `holds`.
        """
        return self
