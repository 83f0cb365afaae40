"""Evaluations during training, and the curve of their scores."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from xplanes.errors import ConfigError
from xplanes.files import write_rows
from xplanes.metrics import mean
from xplanes.rendering.pictures import plane_sheet, strip, write_png
from xplanes.rendering.sampler import Site
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.views import Views
from xplanes.training.clock import off_clock, training_seconds
from xplanes.training.module import RadianceModule

SHOWN = 4
"""Number of views whose images are logged at each evaluation."""

ROW, LEAST_VIEWS = 200_000, 2
"""Default number of pixels scored for a row of the curve, and minimum number of views."""

CURVE = ("seconds", "step", "split", "psnr", "ssim")
"""Columns of curve.csv."""


def affordable(limit: float, views: Views) -> int | float:
    """Number or share of views scored for a row of the curve; by default fewer if they are large.

    Args:
        limit: ``trainer.limit_val_batches``; 1.0 for the default.
        views: Validation views.
    """
    if limit != 1.0 or isinstance(limit, int):
        return limit
    return max(LEAST_VIEWS, ROW // (views.height * views.width))


def scored_before_training(site: Site) -> bool:
    """Whether a field is scored before its first step, see `Evaluation`."""
    return site.initialised or not site.surrounded


class Evaluation(Callback):
    """Makes Lightning validate at given shares of the budget, and saves the results.

    The views are those of `SceneDataModule.val_dataloader`; ``trainer.limit_val_batches`` of them
    are scored each time, see `affordable`. Writes curve.csv and images into the trainer's
    ``default_root_dir``, and passes images to its loggers. All rows of the curve score the same
    views; checkpoints contain the rows so far.

    Args:
        at: Shares of the budget, from 0 to 1. 1 is always included. Randomly initialised fields of
            scenes with surroundings are not scored at 0, when they are slowest to render.

    Attributes:
        step: Step of the last evaluation; -1 before the first.
        seconds: Total time of all evaluations.
    """

    def __init__(self, at: Sequence[float] = (0.0, 1.0)) -> None:
        if any(not 0 <= share <= 1 for share in at):
            raise ConfigError(f"at={list(at)}: must be shares of the budget, from 0 to 1")
        self.at = sorted(share for share in at if share < 1)
        self.step = -1
        self.seconds = 0.0
        self._passed: int | None = None
        self._rows: list[list[str]] = []
        self._pictures: dict[str, Tensor] = {}
        self._began = 0.0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if stage == "fit":
            data: Any = getattr(trainer, "datamodule", None)
            if isinstance(data, SceneDataModule):
                views = data.read_split(data.validation_split or data.test_split)
                trainer.limit_val_batches = affordable(trainer.limit_val_batches, views)
            trainer.check_val_every_n_epoch = None

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        first = 0 in self.at and scored_before_training(pl_module.site)
        trainer.num_sanity_val_steps = float("inf") if first else 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        trainer.val_check_batch = sys.maxsize
        if trainer.global_step and trainer.is_global_zero:
            forget_later(trainer, trainer.global_step)
        passed = sum(share <= pl_module.progress for share in self.at)
        # A run stopped during an evaluation repeats it; a larger budget lowers the progress.
        self._passed = passed if self._passed is None else min(self._passed, passed)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, RadianceModule)
        assert self._passed is not None
        due = sum(share <= pl_module.progress for share in self.at) > self._passed
        # With min_steps training goes on after the budget is used up.
        ends = trainer.should_stop and trainer.fit_loop._can_stop_early
        ends |= pl_module.global_step >= pl_module._steps
        ends &= pl_module.progress >= 1
        if (due or ends) and pl_module.between_updates:
            # Lightning validates after multiples of this number of batches, hence now.
            trainer.val_check_batch = trainer.fit_loop.epoch_loop.total_batch_idx + 1
        else:
            trainer.val_check_batch = sys.maxsize

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._began = time.perf_counter()
        self._pictures = {}

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        if batch_idx < SHOWN and trainer.is_global_zero:
            colour, *others = (outputs[name].float() for name in ("colour", "depth", "opacity"))
            picture = strip(batch["target"].cpu(), colour.clamp(0, 1), *others)
            self._pictures[batch["file"]] = picture

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        self.step = trainer.global_step
        self._passed = sum(share <= pl_module.progress for share in self.at)
        if trainer.is_global_zero:
            with off_clock(trainer):
                self._write(trainer, pl_module)
        self.seconds += time.perf_counter() - self._began

    def _write(self, trainer: Trainer, module: RadianceModule) -> None:
        data: Any = trainer.datamodule  # type: ignore[attr-defined]
        split, step = data.validation_split or data.test_split, trainer.global_step
        run = Path(trainer.default_root_dir)
        psnr, ssim = (mean([getattr(s, name) for s in module.scores]) for name in CURVE[3:])
        row = [f"{training_seconds(trainer):.3f}", str(step), split, f"{psnr:.4f}", f"{ssim:.5f}"]
        self._rows = [*(old for old in self._rows if old[1] != row[1]), row]
        write_rows(run / "curve.csv", CURVE, self._rows)
        if planes := module.field.planes:
            sheet = plane_sheet(planes)
            write_png(run / "media" / "planes.png", sheet)
            log_image(trainer, "planes", sheet, step)
        for file, picture in self._pictures.items():
            tag = f"{split}/{file.removeprefix(f'{split}/')}"
            name = tag.replace("/", "_").removesuffix(".png")
            write_png(run / "media" / f"step{step:06d}" / f"{name}.png", picture)
            log_image(trainer, tag, picture, step)
        if trainer.sanity_checking:  # Lightning does not log scores of a sanity check.
            last = module.tally.last
            scores = {n: last[n] for n in last if n.startswith(("val/", "test/"))}
            for log in trainer.loggers:
                log.log_metrics(scores, step)

    def state_dict(self) -> dict[str, Any]:
        return {"seconds": self.seconds, "passed": self._passed, "rows": self._rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.seconds, self._passed = state_dict["seconds"], state_dict["passed"]
        self._rows = list(state_dict["rows"])


def forget_later(trainer: Trainer, step: int) -> None:
    """Make TensorBoard drop points after a step, left by an interrupted run."""
    for log in trainer.loggers:
        if isinstance(log, TensorBoardLogger):
            from tensorboard.compat.proto.event_pb2 import (  # pyright: ignore
                Event,  # pyright: ignore[reportAttributeAccessIssue]
                SessionLog,  # pyright: ignore[reportAttributeAccessIssue]
            )

            begins = Event(session_log=SessionLog(status=SessionLog.START))
            log.experiment.file_writer.add_event(begins, step + 1)  # pyright: ignore[reportAttributeAccessIssue]


def log_image(trainer: Trainer, tag: str, picture: Tensor, step: int) -> None:
    """Pass an image to every logger that accepts images.

    Args:
        trainer: The Trainer with the loggers.
        tag: The image's name.
        picture: Colours from 0 to 1. [H, W, 3]
        step: The training step.
    """
    picture = picture.clamp(0, 1)
    for log in trainer.loggers:
        writer: Any = getattr(log, "experiment", None)
        if hasattr(writer, "add_image"):
            writer.add_image(tag, picture, step, dataformats="HWC")
        elif hasattr(log, "log_image"):
            log.log_image(tag, [picture.cpu().numpy()], step=step)  # type: ignore[attr-defined]
