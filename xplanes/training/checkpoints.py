"""Checkpoints that are never half-written, and loading them as data."""

from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.config import ConfigError
from xplanes.files import replacing
from xplanes.training.clock import TrainingClock
from xplanes.training.module import RadianceModule

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
        step = trainer.global_step
        if step and step % self.every == 0 and step != self._written:
            self.save(trainer, LAST)
            self._written = step
        self._save_best(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.save(trainer, LAST)

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        if isinstance(exception, KeyboardInterrupt) and trainer.global_step:
            self.save(trainer, LAST)

    def finish(self, trainer: Trainer, module: LightningModule) -> None:
        """Keep the final model as the best, if it is."""
        self._save_best(trainer, module)

    def _save_best(self, trainer: Trainer, module: LightningModule) -> None:
        """Keep the model if its score is the best so far."""
        assert isinstance(module, RadianceModule)
        # All ranks take part in saving, but only the first knows the scores.
        if trainer.strategy.broadcast(module.improved):
            self.save(trainer, BEST)
        module.improved = False

    def save(self, trainer: Trainer, name: str) -> None:
        """Write the state of training to ``name``; all ranks must call it."""
        if trainer.is_global_zero:
            with replacing(self.folder / name) as temporary:
                trainer.save_checkpoint(temporary)
        else:
            trainer.save_checkpoint(self.folder / name)
        self.clock.pause()


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
        return torch.load(path, map_location=device, weights_only=True)
    except Exception as error:
        raise ConfigError(
            f"{path} cannot be read ({type(error).__name__}: {str(error).splitlines()[0]}): it is "
            f"damaged; try {BEST if path.name == LAST else LAST} beside it"
        ) from error
