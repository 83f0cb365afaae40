"""The viewer of a field in training: `viewer=true`."""

import logging
import math
import time
from typing import Annotated, Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.errors import ConfigError
from xplanes.settings import Range
from xplanes.tools.viewer import HOST, PORT, Viewer, check_address
from xplanes.training.clock import Interrupt, find_callback, off_clock, training_seconds
from xplanes.training.module import RadianceModule

logger = logging.getLogger(__name__)

PATIENCE = 1.0
"""Longest wait of training for a picture, in seconds, unless the last step took longer."""

TOLD_SECONDS = 0.5
"""Seconds between two updates of the status line."""


class LiveViewer(Callback):
    """Shows the field in the browser during training, which can be paused there.

    Images are rendered between steps, off the training clock, and do not affect training.

    Args:
        enabled: Whether the viewer runs; `viewer=true` sets it.
        host: Address to serve on; 0.0.0.0 for all addresses of this machine.
        port: Port to serve on; 0 for any free one.

    Attributes:
        viewer: The viewer; None before training and after it.

    Raises:
        ConfigError: If the address cannot be served.
        MissingExtraError: Without the extra ``viewer``.
    """

    def __init__(
        self,
        enabled: bool = True,
        host: str = HOST,
        port: Annotated[int, Range(0, 65535)] = PORT,
    ) -> None:
        if enabled:
            check_address(host, port, key="callbacks.viewer.{}=")
        self.enabled, self.host, self.port = enabled, host, port
        self.viewer: Viewer | None = None
        self._told = self._drawn = 0.0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if self.enabled and trainer.world_size > 1:
            raise ConfigError(
                f"viewer=true with trainer.devices={trainer.world_size}: the viewer needs training "
                "in a single process; leave one of them out"
            )

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not self.enabled:
            return
        assert isinstance(pl_module, RadianceModule)
        data: Any = trainer.datamodule  # type: ignore[attr-defined]
        self.viewer = Viewer(pl_module, data.scene, host=self.host, port=self.port, trains=True)
        self._drawn = time.monotonic()
        print(f"viewer      http://localhost:{self.viewer.port}", flush=True)

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, RadianceModule)
        if self.viewer is None or not pl_module.between_updates:
            return
        with off_clock(trainer):
            try:
                self._serve(self.viewer, trainer, pl_module)
            except RuntimeError as error:  # For example out of memory.
                logger.warning("the viewer is closed, training goes on: %s", error)
                self._close()
        self._drawn = time.monotonic()

    def _serve(self, viewer: Viewer, trainer: Trainer, module: RadianceModule) -> None:
        viewer.step = trainer.global_step
        if viewer.is_watched and time.monotonic() - self._told > TOLD_SECONDS:
            viewer.tell(status(trainer, module))
            self._told = time.monotonic()
        # Render for as long as the last step took, so that a moving camera gets several pictures.
        stepped = time.monotonic() - self._drawn
        viewer.patience = max(PATIENCE, stepped)
        viewer.catch_up(stepped)
        interrupt = find_callback(trainer, Interrupt)
        while viewer.paused and not (interrupt is not None and interrupt.asked):
            viewer.patience = math.inf
            viewer.catch_up(PATIENCE)
            viewer.wait()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._close()

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        self._close()

    def _close(self) -> None:
        viewer, self.viewer = self.viewer, None
        if viewer is not None:
            viewer.close()


def status(trainer: Trainer, module: RadianceModule) -> str:
    """Step, seconds and PSNR, in Markdown."""
    most = f" of {trainer.max_steps}" if trainer.max_steps > 0 else ""
    parts = [f"**step {trainer.global_step}**{most}, {training_seconds(trainer):.0f} s"]
    parts += [
        f"{name.split('/')[0] if '/' in name else 'train'} {value:.2f} dB"
        for name, value in module.tally.last.items()
        if name.rsplit("/", 1)[-1] == "psnr"
    ]
    return "  \n".join([parts[0], ", ".join(parts[1:])])
