"""Ends training between two steps: the training clock at its time limit, Ctrl-C on request."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import FrameType
from typing import Any, TypeVar

import numpy as np
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.backend import synchronize

C = TypeVar("C", bound=Callback)


SHARED = 8
"""Batches between synchronisations of clocks and stop requests in a distributed run."""


def agreeing(trainer: Trainer) -> bool:
    """Whether the processes synchronise after this batch; always true for a single process."""
    # Counted over all epochs, because an epoch may have fewer batches than the interval.
    batches = trainer.fit_loop.epoch_loop.total_batch_idx + 1 if trainer.world_size > 1 else 0
    return batches % SHARED == 0


class TrainingClock(Callback):
    """Counts the seconds spent on training, and ends training after ``max_seconds``.

    Drawing rays and work queued on a GPU count. Validation does not, nor do blocks inside
    `off_clock`, such as writing images and checkpoints. Works in any Trainer.

    Args:
        max_seconds: Seconds after which training ends; None for no limit.

    Attributes:
        seconds: Seconds counted so far, including those before a resume.
        counted: Wall-clock seconds and CPU seconds counted in this process. float64 [2]
    """

    def __init__(self, max_seconds: float | None = None) -> None:
        self.max_seconds = max_seconds
        self.seconds = 0.0
        self.counted = np.zeros(2)
        self._mark = np.zeros(2)
        self._device = torch.device("cpu")

    @property
    def progress(self) -> float:
        """Share of the time budget that has been used."""
        return 0.0 if self.max_seconds is None else self.seconds / self.max_seconds

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.max_seconds is not None and self.seconds >= self.max_seconds:
            trainer.should_stop = True
        self._device = pl_module.device
        self._mark = _now()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if not agreeing(trainer):
            return
        now = _now()
        self.counted += now - self._mark
        spent = float((now - self._mark)[0])
        if trainer.world_size > 1:
            # All ranks must stop at the same step and use the same learning rate.
            shared = torch.tensor(spent, device=pl_module.device)
            spent = float(trainer.strategy.reduce(shared, reduce_op="mean"))
        self.seconds += spent
        self._mark = now
        over = self.max_seconds is not None and self.seconds >= self.max_seconds
        # Modules that accumulate gradients tell when an update is complete.
        if over and getattr(pl_module, "between_updates", True):
            trainer.should_stop = True

    @contextmanager
    def off(self) -> Iterator[None]:
        """Do not count the time of the block."""
        synchronize(self._device)
        began = _now()
        try:
            yield
        finally:
            synchronize(self._device)
            self._mark += _now() - began

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        synchronize(self._device)
        self._left = _now()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        synchronize(self._device)
        self._mark += _now() - self._left

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._device.type != "cpu" or trainer.world_size > 1:
            synchronize(self._device)
            now = _now()
            self.seconds += float((now - self._mark)[0])
            self._mark = now

    def state_dict(self) -> dict[str, Any]:
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.seconds = state_dict["seconds"]


def _now() -> np.ndarray:
    """Wall-clock time and this process's CPU time in seconds. [2]"""
    return np.array([time.perf_counter(), time.process_time()])


def find_callback(trainer: Trainer, kind: type[C]) -> C | None:
    """The trainer's first callback of a class, if any."""
    callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
    return next((callback for callback in callbacks if isinstance(callback, kind)), None)


def off_clock(trainer: Trainer) -> AbstractContextManager[None]:
    """Exclude the time of the block from the training clock."""
    clock = find_callback(trainer, TrainingClock)
    return nullcontext() if clock is None else clock.off()


def training_seconds(trainer: Trainer) -> float:
    """Seconds of the training clock; 0 without one."""
    clock = find_callback(trainer, TrainingClock)
    return 0.0 if clock is None else clock.seconds


def training_share(trainer: Trainer) -> float:
    """CPU seconds of this process per second of its training; 1 if it did not train."""
    clock = find_callback(trainer, TrainingClock)
    wall, cpu = (0.0, 0.0) if clock is None else clock.counted.tolist()
    return cpu / wall if wall else 1.0


class Stopped(KeyboardInterrupt):
    """Training was interrupted, and has stopped between two steps."""


class Interrupt(Callback):
    """The first SIGINT or SIGTERM stops training after the current step, the second immediately."""

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
        self, trainer: Trainer, pl_module: LightningModule, *_: Any, **__: Any
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
