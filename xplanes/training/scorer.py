"""The callback that scores views while training goes on."""

import sys
import time
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from xplanes.backend import threads
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.pictures import plane_sheet, strip, write_png
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views
from xplanes.training.clock import TrainingClock
from xplanes.training.interrupt import Interrupt
from xplanes.training.module import RadianceModule
from xplanes.training.scoring import Curve, ViewScore, mean, score_view, spread

SHOWN = 4
"""Views whose pictures go to TensorBoard at each evaluation."""


class Scorer(Callback):
    """Scores the views at set shares of the budget, off the training clock.

    Args:
        views: The views that are scored.
        split: Their name.
        frame: The field's frame.
        background: Colour behind them. [3]
        at: Shares of the budget, from 0 to 1. The end is always scored, on all views.
        count: Views scored on the way, spread evenly; None for all.
        run: The run directory.
        clock: Paused after each evaluation.
        interrupt: Asked between views.
    """

    def __init__(
        self,
        views: Views,
        split: str,
        frame: Frame,
        background: Tensor,
        *,
        at: list[float],
        count: int | None,
        run: Path,
        clock: TrainingClock,
        interrupt: Interrupt,
    ) -> None:
        self.views, self.split, self.frame, self.background = views, split, frame, background
        self.at = sorted(share for share in at if share < 1)
        self.indices = spread(count or len(views), len(views))
        self.run, self.clock, self.interrupt = run, clock, interrupt
        self.curve: Curve | None = None
        self.latest: list[ViewScore] = []
        self.best = float("-inf")
        self.seconds = 0.0
        self.threads = torch.get_num_threads()
        self._next: int | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        fresh = trainer.global_step == 0
        passed = sum(share <= pl_module.progress for share in self.at)
        # Stopped while it scored, a run scores again; with more of a budget, less of it is passed.
        self._next = passed if self._next is None else min(self._next, passed)
        if fresh and self.at and self.at[0] == 0:
            self._score(trainer, pl_module, self.indices, pl_module.renderer_now)
        self.clock.pause()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, RadianceModule)
        due = sum(share <= pl_module.progress for share in self.at)
        assert self._next is not None
        if due > self._next and pl_module.progress < 1 and not trainer.should_stop:
            self._score(trainer, pl_module, self.indices, pl_module.renderer_now)
            self._next = due
            self.clock.pause()

    def finish(self, trainer: Trainer, module: RadianceModule) -> None:
        """Score all views with all samples: the figures of the final model."""
        self._score(trainer, module, list(range(len(self.views))), module.renderer)

    def _score(
        self, trainer: Trainer, module: RadianceModule, indices: list[int], renderer: RayRenderer
    ) -> None:
        if not trainer.is_global_zero:
            return
        if self.curve is None:
            self.curve = Curve(self.run / "curve.csv", until=trainer.global_step)
        began = time.perf_counter()
        module.eval()
        with threads(self.threads):
            self.latest, pictures = self._compare(module, indices, renderer, trainer)
        module.train()
        step = trainer.global_step
        self.curve.add(module.clock, step, self.split, self.latest)
        scores = {
            f"{self.split}/psnr": mean([s.psnr for s in self.latest]),
            f"{self.split}/ssim": mean([s.ssim for s in self.latest]),
        }
        module.last.update(scores)
        self._log(trainer, module, scores, pictures, step)
        # Of the same views as on the way.
        pairs = zip(indices, self.latest, strict=True)
        compared = mean([score.psnr for index, score in pairs if index in self.indices])
        if compared > self.best:
            self.best, module.improved = compared, True
        self.seconds += time.perf_counter() - began

    def _compare(
        self, module: RadianceModule, indices: list[int], renderer: RayRenderer, trainer: Trainer
    ) -> tuple[list[ViewScore], dict[str, Tensor]]:
        """Scores of views, and the pictures of those that are shown, by the images' names."""
        shown = {indices[place] for place in spread(SHOWN, len(indices))}
        scores, pictures = [], {}
        for index in indices:
            if trainer.world_size == 1:  # Else all processes must stop together, after a step.
                self.interrupt.check()
            score, images = score_view(
                module.field, renderer, self.frame, self.views, index, self.background
            )
            scores.append(score)
            if index in shown:
                pictures[score.file] = strip(
                    images.truth, images.colour, images.depth, images.opacity
                )
        return scores, pictures

    def _log(
        self,
        trainer: Trainer,
        module: RadianceModule,
        scores: dict[str, float],
        pictures: dict[str, Tensor],
        step: int,
    ) -> None:
        sheet = plane_sheet(module.field.planes)
        write_png(self.run / "media" / "planes.png", sheet)
        for file, picture in pictures.items():
            name = f"{self.split}_{file.replace('/', '_').removesuffix('.png')}"
            write_png(self.run / "media" / f"step{step:06d}" / f"{name}.png", picture)
            self._image(trainer, f"{self.split}/{file}", picture, step)
        self._image(trainer, "planes", sheet, step)
        if trainer.logger is not None:
            trainer.logger.log_metrics({**scores, "time/train_s": module.clock}, step)

    @staticmethod
    def _image(trainer: Trainer, tag: str, picture: Tensor, step: int) -> None:
        if trainer.logger is not None:
            writer: Any = trainer.logger.experiment  # type: ignore[attr-defined]
            writer.add_image(tag, picture.clamp(0, 1), step, dataformats="HWC")

    def state_dict(self) -> dict[str, Any]:
        return {"best": self.best, "seconds": self.seconds, "next": self._next}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best, self.seconds = state_dict["best"], state_dict["seconds"]
        self._next = state_dict["next"]


def device_memory(device: torch.device) -> int:
    """Most bytes held so far: on the device if it is a GPU, else by this process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if sys.platform == "win32":
        from psutil import Process

        return Process().memory_info().peak_wset
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024  # Only macOS counts in bytes.
