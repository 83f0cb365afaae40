"""Sources of a field's initialisation: an LRM, a triplane file, or random values."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import torch
from torch import Tensor

from xplanes.components import build
from xplanes.config import CONF
from xplanes.errors import ConfigError
from xplanes.models.base import InitialValues, LossTerm, ModelSettings
from xplanes.scenes.frame import NO_HINTS, CubeHints, Frame
from xplanes.scenes.views import Scene
from xplanes.settings import Count, Location, Positive, Range, Settings

STAGES = ("fixed_view", "lrm", "decomposition", "convert", "fill")

NO_TIME: dict[str, float] = dict.fromkeys(STAGES, 0.0)
"""Seconds of each stage, all 0."""

NOTHING_SKIPPED = {"frames": 0.0, "directions": 0.0}
"""Shares of work that was skipped, all 0."""


@dataclass(frozen=True)
class Initialisation:
    """A field's initialisation and how it was made.

    Attributes:
        model: Settings with which the field is built. The source determines channels, decoder and
            whether there are time planes.
        frame: The field's frame: the source's, if it has one, or the scene's.
        values: Planes, decoder and sparse part; None for a random initialisation.
        report: Decomposition reports for metrics.json, by orientation. ``unexplained``: share of
            the sparse part's energy that the time planes do not explain, ``before`` with random
            planes and ``after`` with the initial ones.
        seconds: Seconds of each stage; for a cached stage, those of its original computation.
            ``fill``, the occupancy grid, is added once the field is built.
        description: One-line description.
        pictures: Images by name, from 0 to 1: the LRM's input, and low-rank and sparse part at a
            few timesteps. [H, W, 3] each
        lrm: Facts about the LRM's input and frame, for metrics.json.
        skipped: Shares for metrics.json: ``frames`` that equal others and were not encoded, and
            singular ``directions`` of robust PCA below the threshold.
    """

    model: ModelSettings
    frame: Frame
    values: InitialValues | None = None
    report: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=NO_TIME.copy)
    description: str = "random initialisation"
    pictures: dict[str, Tensor] = field(default_factory=dict)
    lrm: dict[str, Any] = field(default_factory=dict)
    skipped: dict[str, float] = field(default_factory=NOTHING_SKIPPED.copy)


@dataclass(frozen=True)
class Place:
    """Context of an initialisation.

    Attributes:
        scene: The scene.
        frame: The frame of the scene, for sources without their own.
        device: Device of the computation.
        devices: Number of processes that share the run.
        say: Prints a line before a slow stage.
        hints: Information about the scene's cube.
    """

    scene: Scene
    frame: Frame
    device: torch.device
    devices: int = 1
    say: Callable[[str], None] = print
    hints: CubeHints = NO_HINTS


class Initialiser(ABC):
    """A source of the initialisation, with its files found and its weights loaded.

    Attributes:
        key: Hash of the weights, for the keys of cached stages; empty if there are none.
    """

    key: str = ""

    @abstractmethod
    def initialise(self, method: "Method", place: Place) -> Initialisation:
        """Compute the initialisation of a field.

        Raises:
            ConfigError, SceneError, LRMError: If the source is damaged or does not fit the settings
                or the scene.
        """


def initialisation_of(method: "Method", source: Initialiser | None, place: Place) -> Initialisation:
    """The initialisation of a field: from a source, or random if there is none."""
    if source is None:
        return Initialisation(method.model, place.frame)
    return source.initialise(method, place)


@dataclass(frozen=True, kw_only=True)
class InitialiserSettings(Settings, ABC):
    """Base of the settings in the group ``lrm``."""

    gives: ClassVar[str] = "planes"
    """Kind of initialisation; a model accepts it only if its `takes` is the same."""

    name: str  # Name in run directories and tables.

    @abstractmethod
    def load(self, say: Callable[[str], None] = print) -> Initialiser | None:
        """Find files and load weights before a slow stage; None for a random initialisation.

        Args:
            say: Prints a line before a download.

        Raises:
            ConfigError: If a file is missing or not named.
            LRMError: If an LRM's weights cannot be obtained or do not fit.
        """


@dataclass(frozen=True, kw_only=True)
class RandomSettings(InitialiserSettings):
    """Random initialisation of the planes."""

    def load(self, say: Callable[[str], None] = print) -> None:
        return None


@dataclass(frozen=True, kw_only=True)
class PreparationSettings(Settings):
    """Steps before training, unless the initialisation is random."""

    cache: Location | None  # Folder of cached stages; null disables the cache.
    frames: Count | None  # Timesteps of the fixed-view video; null: the views' distinct times.
    # Source of the fixed-view video. video: the scene; train: rendered by a trained field; auto:
    # the scene if its video is usable, else train.
    fixed_view: Literal["auto", "video", "train"]
    fixed_view_model: str  # Model of the trained field: a file of conf/model.
    fixed_view_seconds: Positive | None  # Maximum training seconds of the field; null: no limit.
    fixed_view_steps: Count  # Maximum number of training steps of the trained field.
    azimuth: float | None  # Azimuth of the fixed view in degrees; null: along a world axis.
    elevation: Annotated[float, Range(-90, 90)]  # Elevation of the fixed view in degrees.

    def check(self) -> None:
        models = sorted(path.stem for path in (CONF / "model").glob("*.yaml"))
        if self.fixed_view_model not in models:
            raise ConfigError(
                f"fixed_view_model={self.fixed_view_model}: must be one of {', '.join(models)}"
            )


@dataclass(frozen=True, kw_only=True)
class DecompositionSettings(Settings):
    """Decomposition of triplanes into low-rank and sparse parts, and their conversion to planes."""

    name: str  # Name of the settings.
    method: Literal["adaptive", "admm"]  # Robust PCA solver. admm: the paper's.
    sparsity_weight: Positive | Literal["auto"]  # Weight of the sparse part; auto: by matrix size.
    penalty: Positive  # Penalty of ADMM; for adaptive, its initial value.
    scale: Literal["rms", "none"]  # Unit of the penalty. rms: RMS of the features; none: 1.
    tolerance: Positive  # Relative residual at convergence.
    max_iterations: Count  # Maximum number of iterations.
    static: Literal["middle", "median", "mean"]  # Space planes: frame T/2, median or mean.
    # Time planes. rank1: fitted to the sparse part; random: near 0; ones: 1, as in K-Planes.
    dynamic: Literal["random", "ones", "rank1"]
    noise: Annotated[float, Range(0)]  # Standard deviation of the noise on time planes.
    cache: bool  # Cache the two parts (twice the size of the triplanes).

    def check(self) -> None:
        if self.dynamic == "random" and self.noise == 0:
            raise ConfigError(
                "noise=0 with decomposition.dynamic=random: time planes of zeros never learn, as a "
                "product of two zeros has no gradient; set decomposition.noise=0.01"
            )


@dataclass(frozen=True)
class Method:
    """All settings of a method that do not depend on the data or the machine.

    Attributes:
        seed: Seed of all random numbers.
        model: Field, sampler, losses and learning rates.
        lrm: Source of the initialisation.
        preparation: Steps before training.
        decomposition: Decomposition of triplanes, and their conversion to planes.
        losses: Further terms of the loss by name; those of weight 0 are left out.
    """

    seed: int
    model: ModelSettings
    lrm: InitialiserSettings
    preparation: PreparationSettings
    decomposition: DecompositionSettings
    losses: Mapping[str, LossTerm] = field(default_factory=dict)

    GROUPS: ClassVar = ("seed", "model", "lrm", "preparation", "decomposition", "losses")

    @classmethod
    def read(cls, config: Mapping[str, Any]) -> "Method":
        """The method of a configuration, checked.

        Raises:
            ConfigError: If settings are missing, out of range, or contradict one another.
        """
        seed = config.get("seed")
        if type(seed) is not int or not 0 <= seed < 2**32:
            raise ConfigError(
                f"seed={seed}: must be a whole number, not negative and below 4294967296 (2^32)"
            )
        try:
            model = build(config["model"], ModelSettings, "model")
        except ConfigError as error:
            if (recipe := config.get("recipe")) is None:
                raise
            raise ConfigError(f"{error} (recipe={recipe} changes settings of the model)") from None
        if "lrm" not in config:
            raise ConfigError(
                f"lrm: model={model.name} chooses none; add `- /lrm@_global_.lrm: none`, or its "
                "default LRM, to the defaults list of the model's file"
            )
        lrm = build(config["lrm"], InitialiserSettings, "lrm")
        if not isinstance(lrm, RandomSettings) and lrm.gives != model.takes:
            same = "" if model.takes is None else f", an lrm that gives {model.takes}"
            models = "model=six_planes or model=nine_planes"
            raise ConfigError(
                f"lrm={lrm.name} with model={model.name}: the initialisation is {lrm.gives}, and "
                f"the model takes {model.takes or 'none'}; set lrm=none{same}, or "
                f"{models if lrm.gives == 'planes' else f'a model that takes {lrm.gives}'}"
            )
        if model.field_class is not None:
            model.sampler.require_kind(model.field_class)
            model.sampler.require(model.field_class)
        losses = {
            name: build(node, LossTerm, f"losses.{name}")
            for name, node in (config.get("losses") or {}).items()
        }
        return cls(
            seed,
            model,
            lrm,
            build(config["preparation"], PreparationSettings, "preparation"),
            build(config["decomposition"], DecompositionSettings, "decomposition"),
            {name: term for name, term in losses.items() if term.weight},
        )

    def require_devices(self, count: int) -> None:
        """Refuse more devices than model and sampler can train on.

        Raises:
            ConfigError: If there are more.
        """
        model, sampler = self.model, self.model.sampler
        most = min((n for n in (model.devices, sampler.devices) if n), default=count)
        if count > most:
            raise ConfigError(
                f"trainer.devices={count} with model={model.name} and model/sampler="
                f"{sampler.name}: they train on one device; set trainer.devices=1"
            )

    def plain(self) -> dict[str, Any]:
        """The settings as builtins; the inverse of `read`."""
        return {
            "seed": self.seed,
            **{name: getattr(self, name).plain() for name in self.GROUPS[1:-1]},
            "losses": {name: term.plain() for name, term in self.losses.items()},
        }
