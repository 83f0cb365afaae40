"""The training clock, which ends training after a time limit."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.backend import synchronize

C = TypeVar("C", bound=Callback)


SHARED = 8
"""Batches after which the processes of a distributed run synchronise clocks and stop requests."""


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


@contextmanager
def off_clock(trainer: Trainer) -> Iterator[None]:
    """Exclude the time of the block from the training clock."""
    clock = find_callback(trainer, TrainingClock)
    if clock is None:
        yield
        return
    with clock.off():
        yield


def training_seconds(trainer: Trainer) -> float:
    """Seconds of the training clock; 0 without one."""
    clock = find_callback(trainer, TrainingClock)
    return 0.0 if clock is None else clock.seconds


def training_share(trainer: Trainer) -> float:
    """CPU seconds of this process per second of its training; 1 if it did not train."""
    clock = find_callback(trainer, TrainingClock)
    wall, cpu = (0.0, 0.0) if clock is None else clock.counted.tolist()
    return cpu / wall if wall else 1.0
