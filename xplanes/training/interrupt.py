"""Ctrl-C that waits for the end of a step, so that nothing is saved half-updated."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.training.clock import agreeing


class Stopped(KeyboardInterrupt):
    """Training was asked to stop, and did so between two steps."""


class Interrupt(Callback):
    """Turns the first SIGINT or SIGTERM into a stop after the step; the second stops at once."""

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, Any] = {}

    def check(self) -> None:
        """Stop here if asked to; to be called between two steps.

        Raises:
            Stopped: If a signal came.
        """
        if self.asked:
            raise Stopped

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if not agreeing(trainer):
            return
        if trainer.world_size > 1:
            # Saving takes all processes: they must stop after the same step.
            self.asked = trainer.strategy.reduce_boolean_decision(self.asked, all=False)
        # Modules that gather batches for an update say where one is whole.
        if getattr(pl_module, "between_updates", True):
            self.check()

    def on_test_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        if trainer.world_size == 1:  # Else all processes must stop together, after a step.
            self.check()

    on_validation_batch_end = on_test_batch_end

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if self._before or threading.current_thread() is not threading.main_thread():
            return  # Only the main thread can take signals.
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._note)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._restore()

    @contextmanager
    def exits(self) -> Iterator[None]:
        """Turn Lightning's exit after an interrupt back into `KeyboardInterrupt`.

        Lightning ends the process with code 1; the run's record must be written first.
        """
        try:
            yield
            self.check()  # For a signal that came after the last step.
        except SystemExit:
            if not self.asked:
                raise
            raise KeyboardInterrupt from None
        finally:
            self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
