"""The training clock, checkpoints, scalars, looks at held-out objects, and the end."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger

from xplanes.files import replacing
from xplanes.pretraining.module import PretrainingModule
from xplanes.pretraining.quick import QuickLook
from xplanes.pretraining.settings import ScheduleConfig

LONGEST = 10.0
"""Seconds that a step counts at most: a process that was stopped for a while did not train."""


class Upkeep(Callback):
    """All that a step needs besides the step.

    Args:
        path: The checkpoint, written whole or not at all.
        schedule: How often.
        look: Scores held-out objects.
        announce: Takes a line now and then.
    """

    def __init__(
        self,
        path: Path,
        schedule: ScheduleConfig,
        look: QuickLook,
        announce: Callable[[str], None],
    ) -> None:
        self.path, self.schedule, self.look, self.announce = path, schedule, look, announce
        self.started = 0.0
        self.since = {"checkpoint": 0.0, "score": 0.0}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, PretrainingModule)
        self.since = dict.fromkeys(self.since, pl_module.clock)
        self.started = time.perf_counter()
        trainer.should_stop = pl_module.progress >= 1

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        assert isinstance(pl_module, PretrainingModule)
        pl_module.clock += min(time.perf_counter() - self.started, LONGEST)
        done = pl_module.progress >= 1
        if pl_module.steps % self.schedule.log_every == 0 or done:
            self._log(trainer, pl_module, pl_module.last)
        if done or self._due("score", pl_module.clock, self.schedule.score_seconds):
            self._log(trainer, pl_module, self.look.scores(pl_module.average))
        if done or self._due("checkpoint", pl_module.clock, self.schedule.checkpoint_seconds):
            self.save(trainer)
        trainer.should_stop = done
        self.started = time.perf_counter()

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        if isinstance(exception, KeyboardInterrupt):
            self.save(trainer)
            self.announce(f"stopped; the same command goes on from {self.path}")

    def save(self, trainer: Trainer) -> None:
        """Write the checkpoint."""
        with replacing(self.path) as temporary:
            trainer.save_checkpoint(temporary)

    def _due(self, what: str, clock: float, every: float) -> bool:
        if clock - self.since[what] < every:
            return False
        self.since[what] = clock
        return True

    def _log(self, trainer: Trainer, module: PretrainingModule, values: dict[str, float]) -> None:
        logger = trainer.logger
        assert isinstance(logger, TensorBoardLogger)
        logger.log_metrics({**values, "seconds": module.clock}, step=module.steps)
        shown = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        self.announce(f"step {module.steps}  {module.clock:.0f} s  {shown}")
