"""Checkpoints that are never half-written, and loading them as data."""

import logging
import shutil
import zipfile
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.config import ConfigError
from xplanes.files import replacing
from xplanes.training.clock import TrainingClock
from xplanes.training.interrupt import Stopped
from xplanes.training.module import RadianceModule

logger = logging.getLogger(__name__)

LAST, BEST = "last.ckpt", "best.ckpt"


class Checkpoints(Callback):
    """Writes ``last.ckpt`` every so many steps and at the end, ``best.ckpt`` at a better score.

    Args:
        folder: Where they go.
        every: Steps between checkpoints.
        clock: Paused after each.
    """

    def __init__(self, folder: Path, every: int, clock: TrainingClock) -> None:
        self.folder, self.every, self.clock = folder, every, clock
        self._written = -1

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._save_best(trainer, pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        # The best comes first: a run that is killed in between scores the model again, but would
        # not write it again if the last one said that it was written.
        self._save_best(trainer, pl_module)
        assert isinstance(pl_module, RadianceModule)
        step = trainer.global_step
        due = step and step % self.every == 0 and step != self._written
        # Gradients of batches that wait for others are in no checkpoint.
        if due and pl_module.between_updates:
            self._save_last(trainer, pl_module)
            self._written = step

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._save_last(trainer, pl_module)

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        # Any other interrupt may have come in the middle of a step.
        if isinstance(exception, Stopped) and trainer.global_step:
            self._save_last(trainer, pl_module)

    def finish(self, trainer: Trainer, module: LightningModule) -> None:
        """Keep the final model as the best, if it is."""
        self._save_best(trainer, module)

    def _save_best(self, trainer: Trainer, module: LightningModule) -> None:
        """Keep the model if its score is the best so far."""
        assert isinstance(module, RadianceModule)
        # All ranks take part in saving, but only the first knows the scores.
        if trainer.strategy.reduce_boolean_decision(module.improved, all=False):
            self.save(trainer, BEST)
        module.improved = False
        if trainer.world_size > 1:
            self.clock.pause()  # The others have waited while the first scored.

    def _save_last(self, trainer: Trainer, module: LightningModule) -> None:
        assert isinstance(module, RadianceModule)
        module.require_finite()
        self.save(trainer, LAST)

    def save(self, trainer: Trainer, name: str) -> None:
        """Write the state of training to ``name``; all ranks must call it."""
        if trainer.is_global_zero:
            with replacing(self.folder / name) as temporary:
                trainer.save_checkpoint(temporary)
        else:
            trainer.save_checkpoint(self.folder / name)
        self.clock.pause()


def find_resumable(folder: Path) -> Path | None:
    """The checkpoint that training goes on from; the best takes the place of a damaged last one.

    Args:
        folder: Where they lie.

    Returns:
        ``last.ckpt``; None where there is none, so that training begins anew.

    Raises:
        ConfigError: If neither can be read.
    """
    last, best = folder / LAST, folder / BEST
    if not last.is_file():
        return None
    try:
        load_checkpoint(last)
    except ConfigError as problem:
        try:
            step = load_checkpoint(best)["global_step"]
        except (ConfigError, KeyError, TypeError):
            raise ConfigError(f"{problem}; or delete {last} to begin anew") from problem
        logger.warning("%s. Going on from %s, step %d", problem, best, step)
        with replacing(last) as temporary:
            shutil.copyfile(best, temporary)
    return last


def load_checkpoint(path: Path, device: str = "cpu") -> dict[str, Any]:
    """Read a checkpoint, tensors and builtins only.

    Raises:
        ConfigError: If the file is missing or damaged.
    """
    if not path.is_file():
        raise ConfigError(
            f"{path} does not exist: the run stopped before its first checkpoint "
            "(trainer.checkpoint_every)"
        )
    try:
        # torch reads changed bytes without a murmur, though it keeps their checksums.
        with zipfile.ZipFile(path) as archive:
            if (name := archive.testzip()) is not None:
                raise zipfile.BadZipFile(f"wrong checksum of {name}")
        return torch.load(path, map_location=device, weights_only=True)
    except Exception as error:
        raise ConfigError(
            f"{path} cannot be read ({type(error).__name__}: {str(error).split('. ')[0]}): it is "
            f"damaged; try {BEST if path.name == LAST else LAST} beside it"
        ) from error
