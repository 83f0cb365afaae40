"""The training clock, and the end of training by it."""

import time
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.training.module import RadianceModule


class TrainingClock(Callback):
    """Counts the seconds spent on training steps into ``module.clock`` and stops at the budget.

    Drawing rays counts; scoring, pictures and checkpoints do not: callbacks that take their time
    call `pause` when they are done. Must be the first callback.

    Args:
        max_seconds: Seconds after which training ends; None for no limit.
    """

    def __init__(self, max_seconds: float | None) -> None:
        self.max_seconds = max_seconds
        self._mark = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        if self.max_seconds is not None and pl_module.clock >= self.max_seconds:
            trainer.should_stop = True
        self.pause()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, RadianceModule)
        now = time.perf_counter()
        spent = now - self._mark
        if trainer.world_size > 1:
            # All ranks must agree on when to stop and on the learning rate.
            shared = torch.tensor(spent, device=pl_module.device)
            spent = float(trainer.strategy.reduce(shared, reduce_op="mean"))
        pl_module.clock += spent
        self._mark = now
        over = self.max_seconds is not None and pl_module.clock >= self.max_seconds
        if over and pl_module.between_updates:
            trainer.should_stop = True

    def pause(self) -> None:
        """Leave out what happened since the last step."""
        self._mark = time.perf_counter()
