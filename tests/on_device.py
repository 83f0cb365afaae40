"""Training on the device of `tests.fake_device`, its operations counted step by step."""

from typing import Any

import lightning
import torch
from lightning.pytorch.accelerators import Accelerator
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.strategies import SingleDeviceStrategy

from tests.fake_device import NAME, Counts, counted
from xplanes.training.fit import quiet_lightning


class FakeAccelerator(Accelerator):
    """What Lightning asks of a device."""

    def setup_device(self, device: torch.device) -> None:
        return

    def teardown(self) -> None:
        return

    @staticmethod
    def parse_devices(devices: Any) -> Any:
        return devices

    @staticmethod
    def get_parallel_devices(devices: Any) -> list[torch.device]:
        return [torch.device(NAME, 0)]

    @staticmethod
    def auto_device_count() -> int:
        return 1

    @staticmethod
    def is_available() -> bool:
        return True

    @staticmethod
    def name() -> str:
        return NAME

    def get_device_stats(self, device: Any) -> dict[str, Any]:
        return {}


class StepCounts(Callback):
    """Counts of each batch, from the end of the one before: drawing and moving it included."""

    def __init__(self) -> None:
        self.steps: list[Counts] = []

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        self._before: Counts | None = None
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


def trainer(callbacks: Any = (), more: Any = (), **options: Any) -> lightning.Trainer:
    """A Trainer on the device, without logs and files."""
    quiet_lightning()
    return lightning.Trainer(
        callbacks=[*callbacks, *more],
        strategy=SingleDeviceStrategy(torch.device(NAME, 0), accelerator=FakeAccelerator()),
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        **options,
    )
