"""The progress line."""

import sys
import time
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar

from xplanes.training.clock import TrainingClock, find_callback, training_seconds
from xplanes.training.module import RadianceModule

LIVE_SECONDS = 0.2
PIPED_SECONDS = 30.0


class StepBar(ProgressBar):
    """Shows steps, rays per second, PSNR and time left.

    On a terminal one line is redrawn; elsewhere a new line is written every 30 s, without control
    codes.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stream = sys.stdout
        self.live = self.stream.isatty()
        self._every = LIVE_SECONDS if self.live else PIPED_SECONDS
        self._shown, self._due, self._width = True, 0.0, 0
        self._began = (0.0, 0)

    def disable(self) -> None:
        self._shown = False

    def enable(self) -> None:
        self._shown = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        self._due = time.monotonic() + (0 if self.live else PIPED_SECONDS)
        self._began = training_seconds(trainer), pl_module.tally.counts["rays"]

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self._is_due(trainer):
            self._write(self.line(trainer, pl_module))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._shown and trainer.is_global_zero:
            self._write(self.line(trainer, pl_module), last=True)
            self._width = 0

    def on_test_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        if self._is_due(trainer):
            counts = trainer.num_test_batches if trainer.testing else trainer.num_val_batches
            counts = trainer.num_sanity_val_batches if trainer.sanity_checking else counts
            self._write(f"scoring: {batch_idx + 1} of {sum(map(int, counts))} views")

    on_validation_batch_end = on_test_batch_end

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.live and self._width:
            self.stream.write("\r" + " " * self._width + "\r")
            self._width = 0

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        if self.live and self._width:
            self.stream.write("\n")

    def _is_due(self, trainer: Trainer) -> bool:
        """Whether to show a line now; if so, schedules the next one."""
        now = time.monotonic()
        due = self._shown and trainer.is_global_zero and now >= self._due
        self._due = now + self._every if due else self._due
        return due

    def line(self, trainer: Trainer, module: LightningModule) -> str:
        """The line for the current state."""
        assert isinstance(module, RadianceModule)
        seconds, rays = training_seconds(trainer), module.tally.counts["rays"]
        clock = find_callback(trainer, TrainingClock)
        most = None if clock is None else clock.max_seconds
        rate = (rays - self._began[1]) / max(seconds - self._began[0], 1e-9)
        parts = [
            f"step {trainer.global_step}" + f"/{trainer.max_steps}" * (trainer.max_steps >= 0),
            f"{seconds:.0f}/{most:.0f} s" if most else f"{seconds:.0f} s",
            f"{100 * module.progress:.0f}%",
            f"{rate / 1000:.1f}k rays/s",
        ]
        if "psnr" in module.tally.last:
            parts.append(f"train psnr {module.tally.last['psnr']:.2f}")
        for name, value in module.tally.last.items():
            if name.endswith("/psnr"):
                parts.append(f"{name.replace('/', ' ')} {value:.2f}")
        if module.progress < 1:
            left = seconds * (1 / max(module.progress, 1e-6) - 1)
            parts.append(f"{int(left) // 60}:{int(left) % 60:02d} of training left")
        return "  ".join(parts)

    def _write(self, line: str, last: bool = False) -> None:
        if not self.live:
            self.stream.write(line + "\n")
        else:
            self.stream.write("\r" + line.ljust(self._width) + ("\n" if last else ""))
            self._width = len(line)
        self.stream.flush()
