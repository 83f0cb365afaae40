"""A whole run: its method, data, trainer, callbacks and logger, from a configuration.

Lightning is slow to import, so only `build_trainer` imports it: invalid settings of the method and
the data are refused in half the time.
"""

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from xplanes.backend import find_device
from xplanes.components import build, class_of, plugins
from xplanes.errors import ConfigError
from xplanes.models.initialisation import Method
from xplanes.scenes.source import SceneSettings

if TYPE_CHECKING:
    from lightning.pytorch.loggers import Logger

    from xplanes.training.fit import Trainer

OWNERS = {
    "callbacks": "the group callbacks",
    "logger": "logger=none, or another logger,",
    "default_root_dir": "hydra.run.dir",
}
"""Arguments of the Trainer that cannot be set directly, and what to set instead."""


@dataclass(frozen=True)
class Experiment:
    """The settings of a run, checked.

    Attributes:
        config: The configuration from which they were read.
        method: Model, initialisation and losses.
        data: The scene.
        trainer: Arguments of the Trainer.
        callbacks: Callbacks by name.
        logger: Loggers; empty for none.
        media: Whether a video is rendered at the end.
    """

    config: Mapping[str, Any]
    method: Method
    data: SceneSettings
    trainer: Mapping[str, Any]
    callbacks: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    logger: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    media: bool = True

    @classmethod
    def read(cls, config: Mapping[str, Any], modules: Sequence[str] | None = None) -> "Experiment":
        """Read the experiment from a configuration.

        Args:
            config: The resolved configuration, builtins only.
            modules: The user's own modules whose classes it may name. None: those it lists under
                ``plugins``, which is unsafe for configurations from others.

        Raises:
            ConfigError: If settings are missing, out of range, or contradict one another.
        """
        asked = config.get("plugins") or [] if modules is None else modules
        if not isinstance(media := config.get("media", True), bool):
            raise ConfigError(f"media={media}: must be true or false")
        with plugins(asked):
            try:
                experiment = cls(
                    config,
                    Method.read(config),
                    build(config["data"], SceneSettings, "data"),
                    dict(config["trainer"]),
                    _nodes(config.get("callbacks")),
                    _nodes(config.get("logger")),
                    media,
                )
            except KeyError as error:
                raise ConfigError(f"the configuration lacks the group {error}") from error
        experiment.method.require_devices(experiment.devices)
        return experiment

    def require_folder(self) -> None:
        """Check that the folder of the scene exists, unless its reader may fetch it.

        Raises:
            SceneError: If it does not; the message says where to get the scene.
        """
        fetches = type(self.data).prepare is not SceneSettings.prepare
        if self.data.files and not fetches and not self.data.folder.exists():
            self.data.load(("train",))

    @property
    def device(self) -> torch.device:
        """Device on which the field is trained.

        Raises:
            ConfigError: If the machine lacks the device.
        """
        try:
            return find_device(str(self.trainer.get("accelerator", "auto")))
        except ConfigError as error:
            raise ConfigError(f"trainer.{error}") from None

    @property
    def devices(self) -> int:
        """Number of processes that share the run."""
        devices = self.trainer.get("devices", 1)
        return devices if isinstance(devices, int) and devices > 0 else 1

    def build_trainer(self, run: Path) -> "Trainer":
        """The Trainer, with callbacks and loggers, for a run directory.

        Raises:
            ConfigError: If one of them rejects its arguments.
        """
        from lightning.pytorch.callbacks import Callback

        from xplanes.training.fit import Trainer

        if self.devices > 1 and self.trainer.get("strategy", "auto") == "auto":
            raise ConfigError(
                f"trainer.devices={self.devices} with trainer.strategy=auto: several devices need "
                "trainer=ddp"
            )
        for name, owner in OWNERS.items():
            if name in self.trainer:
                raise ConfigError(f"trainer.{name}={self.trainer[name]}: set {owner} instead")
        with plugins(self.config.get("plugins") or []):
            callbacks = [
                build(node, Callback, f"callbacks.{name}") for name, node in self.callbacks.items()
            ]
            loggers = [_logger(name, node, run) for name, node in self.logger.items()]
            return build(
                self.trainer,
                Trainer,
                "trainer",
                callbacks=callbacks,
                logger=loggers,
                default_root_dir=str(run),
            )


def _nodes(content: Any) -> dict[str, Mapping[str, Any]]:
    """Components by name; those that were set to null are left out."""
    return {str(name): node for name, node in (content or {}).items() if node is not None}


def _logger(name: str, node: Mapping[str, Any], run: Path) -> "Logger":
    """The logger of a node.

    TensorBoardLogger passes unknown arguments on to its writer, which rejects them only when the
    first curve is written. They are rejected here instead.
    """
    from lightning.pytorch.loggers import Logger, TensorBoardLogger

    key = f"logger.{name}"
    cls = class_of(node.get("_target_"), Logger, f"{key}._target_")
    taken = inspect.signature(cls).parameters
    open_ended = any(each.kind is each.VAR_KEYWORD for each in taken.values())
    saves = (open_ended or "save_dir" in taken) and "save_dir" not in node
    logger = build(node, Logger, key, **({"save_dir": str(run)} if saves else {}))
    if isinstance(logger, TensorBoardLogger):
        from torch.utils.tensorboard import SummaryWriter

        known = {"_target_", *taken, *inspect.signature(SummaryWriter).parameters}
        if foreign := [entry for entry in node if entry not in known]:
            raise ConfigError(
                f"{key}.{foreign[0]}={node[foreign[0]]}: {cls.__name__} has no such argument; "
                "leave it out"
            )
    return logger
