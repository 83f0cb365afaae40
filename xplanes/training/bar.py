"""One line that says how far training is."""

import sys
import time
from typing import Any, TextIO

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.training.module import RadianceModule

LIVE_SECONDS = 0.2
PIPED_SECONDS = 30.0


class StepBar(Callback):
    """Steps, rays per second, PSNR and time left.

    On a terminal one line is redrawn; elsewhere a plain line appears every 30 s, without control
    codes.

    Args:
        max_steps: Steps at most.
        max_seconds: Training clock at most; None for no limit.
        split: Split whose score is shown.
        stream: Where to write.
    """

    def __init__(
        self, max_steps: int, max_seconds: float | None, split: str, stream: TextIO = sys.stdout
    ) -> None:
        self.max_steps, self.max_seconds, self.split = max_steps, max_seconds, split
        self.stream = stream
        self.live = stream.isatty()
        self._due = 0.0
        self._width = 0
        self._seen = (0.0, 0)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        self._due = time.monotonic() + (0 if self.live else PIPED_SECONDS)
        self._seen = (pl_module.clock, pl_module.counts["rays"])

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, RadianceModule)
        if not trainer.is_global_zero or time.monotonic() < self._due:
            return
        self._due = time.monotonic() + (LIVE_SECONDS if self.live else PIPED_SECONDS)
        self._write(self.line(trainer.global_step, pl_module))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        if trainer.is_global_zero:
            self._write(self.line(trainer.global_step, pl_module), last=True)

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        if self.live and self._width:
            self.stream.write("\n")

    def line(self, step: int, module: RadianceModule) -> str:
        """The line for the present state."""
        clock, rays = module.clock, module.counts["rays"]
        rate = (rays - self._seen[1]) / max(clock - self._seen[0], 1e-9)
        left = clock * (1 / max(module.progress, 1e-6) - 1)
        parts = [
            f"step {step}/{self.max_steps}",
            f"{clock:.0f}/{self.max_seconds:.0f} s" if self.max_seconds else f"{clock:.0f} s",
            f"{100 * module.progress:.0f}%",
            f"{rate / 1000:.1f}k rays/s",
        ]
        if "psnr" in module.last:
            parts.append(f"train psnr {module.last['psnr']:.2f}")
        if f"{self.split}/psnr" in module.last:
            parts.append(f"{self.split} psnr {module.last[f'{self.split}/psnr']:.2f}")
        parts.append(f"{int(left) // 60}:{int(left) % 60:02d} left")
        return "  ".join(parts)

    def _write(self, line: str, last: bool = False) -> None:
        if not self.live:
            self.stream.write(line + "\n")
        else:
            self.stream.write("\r" + line.ljust(self._width) + ("\n" if last else ""))
            self._width = len(line)
        self.stream.flush()
