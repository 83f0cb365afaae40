"""What all baselines are built from: views, a frame, and streams of start values."""

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from xplanes.config import ConfigError, TrainConfig
from xplanes.fields.base import RadianceField
from xplanes.scenes.batches import step_generator
from xplanes.scenes.errors import SceneError
from xplanes.scenes.frame import Frame, cube_frame, scene_frame
from xplanes.scenes.views import Views
from xplanes.training.methods.base import Method
from xplanes.training.sampling.base import Sampling

logger = logging.getLogger(__name__)

FIELD_STREAM, SAMPLER_STREAM = 1_000_099, 1_000_117
"""Random streams of the start values."""


@dataclass(frozen=True)
class Site:
    """What a field is built for.

    Attributes:
        views: Training views.
        frame: The field's frame.
        precision: Of matrix products: "32" or "bf16".
        begun: Whether the field starts from something that it shows.
    """

    views: Views
    frame: Frame
    precision: str
    begun: bool = False

    @property
    def unit(self) -> float:
        """World units per unit of the frame."""
        return 1 / self.frame.scale

    @property
    def moments(self) -> int:
        """Number of distinct times; 1 for a scene that stands still."""
        return len(self.views.times.unique())


def time_rows(times: Tensor) -> int:
    """Rows of time where the settings leave them open: one for two distinct times. [V]"""
    return max(2, math.ceil(len(times.unique()) / 2))


@dataclass(frozen=True)
class Plan:
    """How a family of models is built.

    Attributes:
        frame: Its frame, for training views.
        method: Its field and training.
    """

    frame: Callable[[TrainConfig, Views], Frame]
    method: Callable[[TrainConfig, Site], Method]


SamplingBuilder = Callable[[TrainConfig, Site, RadianceField], Sampling]


@contextmanager
def start_values(seed: int, stream: int) -> Iterator[None]:
    """Draw random start values from a stream of the run's seed, and leave other streams alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(step_generator(seed, 0, stream).initial_seed())
        yield


def scene_cube(config: TrainConfig, views: Views) -> Frame:
    """The scene's own cube."""
    return scene_frame(views, config.data.half_side)


def origin_cube(half_side: float, config: TrainConfig, views: Views) -> Frame:
    """A cube around the world's origin; says so where the scene looks to be of another size.

    Args:
        half_side: Half the side of the cube, in world units.
        config: The run's settings.
        views: Training views.
    """
    try:
        scene = scene_cube(config, views)
    except SceneError:
        return cube_frame(half_side, torch.zeros(3))
    reach = 1 / scene.scale + float(scene.centre.norm())
    # A scene that fills the cube's corners reaches sqrt(3) times as far as its sides.
    if not half_side / 4 < reach < half_side * 3**0.5:
        logger.warning(
            "model.half_side=%g: the scene reaches %.3g world units from the origin; set it to "
            "about that, or to null for the scene's own cube",
            half_side,
            reach,
        )
    return cube_frame(half_side, torch.zeros(3))


def check_range(site: Site, near: float, far: float) -> None:
    """Refuse distances between which the cameras do not see the centre of the field's cube.

    Raises:
        ConfigError: With the cameras' distances.
    """
    away = (site.views.camera_to_world[:, :3, 3] - site.frame.centre).norm(dim=-1)
    nearest, farthest = float(away.min()), float(away.max())
    if nearest <= near or farthest >= far:
        raise ConfigError(
            f"sampler.near={near} with sampler.far={far}: the cameras stand {nearest:.3g} to "
            f"{farthest:.3g} world units from the centre of the field's cube; set both to numbers "
            "around these"
        )
