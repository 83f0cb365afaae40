"""Graceful Ctrl-C: training stops after the current step, so that the saved state is consistent."""

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
    """Training was interrupted, and has stopped between two steps."""


class Interrupt(Callback):
    """The first SIGINT or SIGTERM stops training after the current step, the second at once."""

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, Any] = {}

    def check(self) -> None:
        """Stop if a signal was received; call it between two steps.

        Raises:
            Stopped: If a signal was received.
        """
        if self.asked:
            raise Stopped

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if not agreeing(trainer):
            return
        if trainer.world_size > 1:
            # All processes take part in saving: they must stop after the same step.
            self.asked = trainer.strategy.reduce_boolean_decision(self.asked, all=False)
        # Modules that accumulate gradients tell when an update is complete.
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
        if trainer.world_size == 1:  # Several processes must stop together, after a step.
            self.check()

    on_validation_batch_end = on_test_batch_end

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if self._before or threading.current_thread() is not threading.main_thread():
            return  # Only the main thread can handle signals.
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
            self.check()  # For a signal after the last step.
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
