"""Ctrl-C that waits for the end of a step, so that nothing is saved half-updated."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback


class Stopped(KeyboardInterrupt):
    """Training was asked to stop, and did so where its state is whole."""


class Interrupt(Callback):
    """Turns the first SIGINT or SIGTERM into a stop after the step; a second one is at once."""

    def __init__(self) -> None:
        self.asked = False

    def check(self) -> None:
        """Stop here if asked to; call it where the state is whole.

        Raises:
            Stopped: If a signal came.
        """
        if self.asked:
            raise Stopped

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if trainer.world_size > 1:
            # Saving takes all processes: they must stop after the same step.
            self.asked = trainer.strategy.reduce_boolean_decision(self.asked, all=False)
        # Modules that gather batches for an update say where one is whole.
        if getattr(pl_module, "between_updates", True):
            self.check()

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take the signals for the time of the block; helper threads cannot, and leave them be."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        signals = (signal.SIGINT, signal.SIGTERM)
        before = {number: signal.signal(number, self._note) for number in signals}
        try:
            yield
            self.check()  # For a signal that came after the last step.
        except SystemExit:
            # Lightning ends the process after an interrupt; the run record must be written first.
            if not self.asked:
                raise
            raise KeyboardInterrupt from None
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
