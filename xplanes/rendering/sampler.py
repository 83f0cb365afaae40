"""What training asks of a sampler, and what fields and samplers are built for."""

import logging
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
from xplanes.scenes.errors import SceneError
from xplanes.scenes.frame import Frame, cube_frame, scene_frame
from xplanes.scenes.views import Views
from xplanes.settings import Settings
from xplanes.streams import TrainingState

logger = logging.getLogger(__name__)

VIEWS_PER_ROW = 4
"""Views of one timestep that a row of time for it alone needs."""

Group = dict[str, Any]
"""Parameters of one learning rate: ``params``, ``lr`` and ``name``."""


@dataclass(frozen=True)
class Site:
    """What a field is built for.

    Attributes:
        frame: The field's frame.
        times: Times of the training views. [V]
        seed: The run's seed.
        precision: Of matrix products: "32" or "bf16".
        bounds: Box in world units that some fields cover; None for those that need none. [2, 3]
        views: Training views; None where a checkpoint is loaded without its data.
        initialised: Whether the initial field already shows the scene.
        surrounded: Whether the training images show a world around the scene, so that there is
            something to see behind the field's cube.
        device: Where it is going to be trained; the CPU when None.
        samples_per_batch: Samples of a training batch on average; None if not known.
        batch_scale: Size of a batch over that for which schedules are made, see `steps`.
    """

    frame: Frame
    times: Tensor
    seed: int
    precision: str
    bounds: Tensor | None = None
    views: Views | None = None
    initialised: bool = False
    surrounded: bool = False
    device: torch.device | None = None
    samples_per_batch: int | None = None
    batch_scale: float = 1.0

    def steps(self, count: int) -> int:
        """Steps that show as many rays as so many steps of the batches of the schedules."""
        return math.ceil(count / self.batch_scale)

    @property
    def unit(self) -> float:
        """World units per unit of the frame."""
        return 1 / self.frame.scale

    @property
    def moves(self) -> bool:
        """Whether there are views of more than one time."""
        return len(self.times.unique()) > 1

    @property
    def time_rows(self) -> int:
        """Rows of time where the settings leave them open."""
        return time_rows(self.times)


def time_rows(times: Tensor) -> int:
    """Rows of time where the settings leave them open.

    One for two distinct times; one for each where there are enough views of it to tell what it
    shows without its neighbours.

    Args:
        times: Time of each training view. [V]
    """
    distinct = len(times.unique())
    return max(2, math.ceil(distinct / 2), min(distinct, len(times) // VIEWS_PER_ROW))


class Sampler(ABC):
    """How a step places samples, what that adds to the loss, and the upkeep between steps."""

    @property
    @abstractmethod
    def renderer(self) -> Renderer:
        """Renders images."""

    @property
    def parts(self) -> dict[str, nn.Module]:
        """Modules that belong into checkpoints, by name."""
        return {}

    @property
    def outline(self) -> str:
        """What the sampler does, in a few words."""
        return ""

    def groups(self) -> list[Group]:
        """Parameters that train along."""
        return []

    def first_rays(self, most: int) -> int:
        """Rays of the first batch, of ``most`` at most."""
        return most

    def renderer_at(self, step: int) -> Renderer:
        """Renders images when so many steps are done."""
        return self.renderer

    @abstractmethod
    def render(self, field: Any, rays: Batch, state: TrainingState) -> Rendering:
        """Render the rays of a batch, with jitter."""

    def pass_on(self, rendering: Any, state: TrainingState) -> int | Tensor:
        """Take gradients to the field where rendering cut them off.

        Returns:
            Number of samples that the field got gradients of.
        """
        return rendering.samples.count

    def losses(self, rendering: Any) -> dict[str, Tensor]:
        """The sampler's own terms of the loss, weighted, by name. [] each"""
        return {}

    def regularise(self) -> None:
        """Add gradients of the sampler's own parameters."""
        return

    def observe(self, rendering: Any) -> None:
        """Learn from what a batch showed."""
        return

    def update(self, field: Any, state: TrainingState) -> None:
        """Do what is due after an optimiser step."""
        return

    def expect(self, samples: float) -> None:
        """Make ready for batches of so many samples on average."""
        return

    def scalars(self) -> dict[str, float]:
        """Values for the logger."""
        return {}


@dataclass(frozen=True, kw_only=True)
class SamplerSettings(Settings, ABC):
    """Base of the settings of samplers."""

    devices: ClassVar[int | None] = None
    """Devices that it can train on at most; None for any number."""

    kind: ClassVar[type[Representation]] = RadianceField
    """What it takes: a class from which that of the field must be derived."""

    name: str  # Name in tables.

    def require_kind(self, field: type[Representation]) -> None:
        """Refuse a class of fields that is not of the sampler's `kind`.

        Raises:
            ConfigError: With the way out.
        """
        if not issubclass(field, self.kind):
            takes = "radiance fields" if self.kind is RadianceField else "Gaussians"
            raise ConfigError(
                f"model.sampler.name={self.name}: takes {takes}, and the model's are of another "
                "kind; leave model/sampler out"
            )

    def require(self, field: Any) -> None:
        """Refuse a field, or a class of fields, of its `kind` that cannot be sampled so.

        Raises:
            ConfigError: With the samplers that can.
        """

    @abstractmethod
    def build(self, field: Any, site: Site) -> Sampler:
        """The sampler for a field.

        Raises:
            ConfigError: If it cannot serve this field or these cameras.
        """

    def for_video(self) -> "SamplerSettings":
        """These settings where a model looks at few pixels of what is rendered."""
        return self


def scene_cube(views: Views, half_side: float | None, points: Tensor | None = None) -> Frame:
    """The scene's own cube; ``half_side`` in world units, found when None, see `scene_frame`."""
    return scene_frame(views, half_side, points)


def origin_cube(half_side: float, views: Views, given: float | None = None) -> Frame:
    """A cube around the world's origin; says so where the scene looks to be of another size.

    Args:
        half_side: Half the side of the cube, in world units.
        views: Training views.
        given: Half the side of the scene's cube, which the settings must leave open.

    Raises:
        ConfigError: If both are given.
    """
    if given is not None:
        raise ConfigError(
            f"data.half_side={given} with model.half_side={half_side}: two cubes; set "
            "model.half_side=null to use the former, or leave data.half_side out"
        )
    try:
        scene = scene_frame(views, None)
    except SceneError:
        return cube_frame(half_side, torch.zeros(3), "model.half_side")
    reach = 1 / scene.scale + float(scene.centre.norm())
    # A scene that fills the cube's corners reaches sqrt(3) times as far as its sides.
    if not half_side / 4 < reach < half_side * 3**0.5:
        logger.warning(
            "model.half_side=%g: the scene reaches %.3g world units from the origin; set it to "
            "about that, or to null for the scene's own cube",
            half_side,
            reach,
        )
    return cube_frame(half_side, torch.zeros(3), "model.half_side")


def check_range(site: Site, near: float, far: float) -> None:
    """Refuse distances between which the cameras do not see the centre of the field's cube.

    Raises:
        ConfigError: With the cameras' distances.
    """
    if site.views is None:
        return
    away = (site.views.camera_to_world[:, :3, 3] - site.frame.centre).norm(dim=-1)
    nearest, farthest = float(away.min()), float(away.max())
    if nearest <= near or farthest >= far:
        raise ConfigError(
            f"model.sampler.near={near} with model.sampler.far={far}: the cameras stand "
            f"{nearest:.3g} to {farthest:.3g} world units from the centre of the field's cube; set "
            "both to numbers around these"
        )
