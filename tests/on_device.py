"""Training on the device of `tests.fake_device`, its operations counted step by step."""

from typing import Any

import lightning
import torch
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.strategies import SingleDeviceStrategy

from tests.fake_device import NAME, Counts, counted
from xplanes.training.fit import quiet_lightning


class FakeAccelerator(CPUAccelerator):
    """Takes the device for what it is."""

    def setup_device(self, device: torch.device) -> None:
        return


class StepCounts(Callback):
    """Counts of each batch, from the end of the one before: drawing and moving it included."""

    def __init__(self) -> None:
        self.steps: list[Counts] = []

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        self._context = counted()
        self._counts = self._context.__enter__()

    def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
        self._end()
        self.steps.append(self._counts)
        self._context = counted()
        self._counts = self._context.__enter__()

    def _end(self) -> None:
        self._context.__exit__(None, None, None)

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        self._end()


def trainer(**options: Any) -> lightning.Trainer:
    """A Trainer on the device, unless the options say otherwise, without logs and files."""
    quiet_lightning()
    there = SingleDeviceStrategy(torch.device(NAME, 0), accelerator=FakeAccelerator())
    shown = ("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary")
    return lightning.Trainer(**{"strategy": there, **dict.fromkeys(shown, False)} | options)
