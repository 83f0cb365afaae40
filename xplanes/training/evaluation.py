"""Scores of views while training goes on, and the curve of them."""

import logging
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import (
    Callback,
    EarlyStopping,
    ModelCheckpoint,
    WeightAveraging,
)
from torch import Tensor

from xplanes.errors import ConfigError
from xplanes.fields.base import Representation
from xplanes.files import read_rows, write_rows
from xplanes.metrics import psnr, ssim
from xplanes.rendering.base import Renderer, leave_empty
from xplanes.rendering.pictures import plane_sheet, strip, write_png
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views
from xplanes.training.clock import find_callback, off_clock, training_seconds
from xplanes.training.interrupt import check_interrupt
from xplanes.training.module import RadianceModule

logger = logging.getLogger(__name__)

VISIBLE = 0.05
"""Opacity above which a background pixel shows a floater."""

SOLID = 128
"""Share of a pixel, of 255, from which it shows the thing."""

SHOWN = 4
"""Views whose images go to the logger at each evaluation."""


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view.

    Attributes:
        file: Name of the true image.
        time: Its time, from 0 to 1.
        psnr: In dB.
        ssim: Structural similarity.
        psnr_thing: In dB, over the pixels that show the thing; NaN where they are not known.
        floaters: Share of background pixels (alpha 0 in the true image) that are not transparent;
            NaN where the image has none.
    """

    file: str
    time: float
    psnr: float
    ssim: float
    floaters: float
    psnr_thing: float = math.nan

    @property
    def scores(self) -> dict[str, float]:
        """The numbers by name, those that are known."""
        found = {"psnr": self.psnr, "ssim": self.ssim}
        maybe = {"psnr_thing": self.psnr_thing, "floaters": self.floaters}
        return found | {name: value for name, value in maybe.items() if not math.isnan(value)}


@dataclass(frozen=True)
class ViewImages:
    """What was compared.

    Attributes:
        truth: True colours. [H, W, 3]
        colour: Rendered colours. [H, W, 3]
        depth: Rendered depth in the field's frame. [H, W]
        opacity: Rendered opacity. [H, W]
    """

    truth: Tensor
    colour: Tensor
    depth: Tensor
    opacity: Tensor


def render_view(
    field: Representation,
    renderer: Renderer,
    frame: Frame,
    views: Views,
    index: int,
    background: Tensor,
) -> dict[str, Tensor]:
    """Render one view whole: ``colour`` [h, w, 3], ``opacity`` and ``depth`` [h, w], on the CPU."""
    time = float(views.times[index])
    image = renderer.view(field, frame, views.camera(index), time, background)
    found = {name: value.cpu() for name, value in image.items()}
    if (shown := views.intrinsics.has_ray(index)) is not None:
        leave_empty(found, ~shown, background)
    return found


def score_view(
    field: Representation,
    renderer: Renderer,
    frame: Frame,
    views: Views,
    index: int,
    background: Tensor,
) -> tuple[ViewScore, ViewImages]:
    """Render one view and compare it with the true image in front of ``background``."""
    image = render_view(field, renderer, frame, views, index, background)
    truth = views.composite(index, background)
    colour = image["colour"].float().clamp(0, 1)
    score = ViewScore(
        file=views.files[index],
        time=float(views.times[index]),
        psnr=psnr(colour, truth),
        ssim=ssim(colour, truth),
        floaters=floaters(image["opacity"].float(), views.image(index)[..., 3]),
        psnr_thing=psnr_thing(colour, truth, views.thing_in(index)),
    )
    return score, ViewImages(truth, colour, image["depth"].float(), image["opacity"].float())


def psnr_thing(colour: Tensor, truth: Tensor, thing: Tensor | None) -> float:
    """PSNR in dB of the pixels most of which show the thing; NaN where there are none.

    Args:
        colour: Rendered colours. [H, W, 3]
        truth: True colours. [H, W, 3]
        thing: Share of each pixel that shows the thing; None where it is not known. uint8 [H, W]
    """
    if thing is None or not (shown := thing >= SOLID).any():
        return math.nan
    return psnr(colour[shown], truth[shown])


def floaters(opacity: Tensor, alpha: Tensor) -> float:
    """Share of pixels with alpha 0 whose rendered opacity is above `VISIBLE`. [H, W], uint8 [H, W]

    NaN without such pixels.
    """
    return float((opacity[alpha == 0] > VISIBLE).float().mean())


def mean_scores(scores: Sequence[ViewScore]) -> dict[str, float]:
    """Means over views of each score that any of them has."""
    names = ("psnr", "ssim", "psnr_thing", "floaters")
    found = {name: [s.scores[name] for s in scores if name in s.scores] for name in names}
    return {name: mean(values) for name, values in found.items() if values}


def mean_colour(views: Views, background: Tensor) -> Tensor:
    """Mean over images in front of ``background`` [3] of their mean colour. [3]"""
    images = (views.composite(index, background) for index in range(len(views)))
    return torch.stack([image.flatten(0, 1).mean(dim=0) for image in images]).mean(dim=0)


def blank_psnr(views: Views, background: Tensor) -> float:
    """Mean PSNR in dB of images that show nothing but the background."""
    truths = (views.composite(index, background) for index in range(len(views)))
    return mean([psnr(background.expand_as(truth), truth) for truth in truths])


def spread(count: int, total: int) -> list[int]:
    """``count`` indices spread evenly over ``total``, both ends included."""
    if count >= total:
        return list(range(total))
    return torch.linspace(0, total - 1, count).round().long().tolist()


def mean(values: Sequence[float]) -> float:
    """Plain mean; NaN for none."""
    return math.fsum(values) / len(values) if values else math.nan


class Curve:
    """curve.csv: one row per evaluation, rewritten whole at each.

    Args:
        path: The file.
        until: Rows of later steps are dropped, as when a run goes on from a checkpoint.
    """

    HEADER = ("seconds", "step", "split", "psnr", "ssim")

    def __init__(self, path: Path, until: int) -> None:
        self.path = path
        self.rows: list[tuple[str, ...]] = []
        for row in read_rows(path):
            values = tuple(row.get(name) or "" for name in self.HEADER)
            if not all(values) or not values[1].isdecimal():
                logger.warning("%s is damaged: a row without all its numbers is dropped", path)
            elif int(values[1]) <= until:
                self.rows.append(values)

    def add(self, seconds: float, step: int, split: str, scores: Sequence[ViewScore]) -> None:
        """Append the means over views; a row of the same step is replaced."""
        row = (
            f"{seconds:.3f}",
            str(step),
            split,
            f"{mean([s.psnr for s in scores]):.4f}",
            f"{mean([s.ssim for s in scores]):.5f}",
        )
        self.rows = [old for old in self.rows if old[1] != row[1]]
        self.rows.append(row)
        write_rows(self.path, self.HEADER, self.rows)


class Evaluation(Callback):
    """Scores validation views at given shares of the budget, off the training clock.

    These are views of `SceneDataModule.validation_split`. Where there are none it scores test
    views, and no evaluation counts as the best.

    Writes curve.csv and images into the trainer's ``default_root_dir``, and gives scalars and
    images to its loggers. All rows of the curve score the same views. Lightning's EarlyStopping and
    ModelCheckpoint see ``val/psnr`` and ``val/ssim`` after each evaluation.

    Args:
        at: Shares of the budget, from 0 to 1; 1 is always scored.
        views: Number of views scored, spread evenly; None for all.

    Attributes:
        latest: Scores of the last evaluation.
        step: Its step; -1 before the first.
        best: Highest mean PSNR so far.
        best_step: Step at which it was reached; -1 before the first evaluation.
        seconds: Time spent on it.
    """

    def __init__(self, at: Sequence[float] = (0.0, 1.0), views: int | None = None) -> None:
        if any(not 0 <= share <= 1 for share in at):
            raise ConfigError(f"at={list(at)}: shares of the budget, from 0 to 1")
        if views is not None and views < 1:
            raise ConfigError(f"views={views}: must be above 0, or null for all")
        self.at, self.views = sorted(share for share in at if share < 1), views
        self.latest: list[ViewScore] = []
        self.best, self.best_step = float("-inf"), -1
        self.seconds = 0.0
        self._curve: Curve | None = None
        self._next: int | None = None
        self.step = -1

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        passed = sum(share <= pl_module.progress for share in self.at)
        # Stopped while it scored, a run scores again; with more of a budget, less of it is passed.
        self._next = passed if self._next is None else min(self._next, passed)
        if trainer.is_global_zero:
            self._curve = Curve(_folder(trainer) / "curve.csv", until=trainer.global_step)
        if trainer.global_step == 0 and self.at and self.at[0] == 0:
            self.score(trainer, pl_module, pl_module.renderer_now)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, RadianceModule)
        due = sum(share <= pl_module.progress for share in self.at)
        assert self._next is not None
        # Not between the batches of an update: it may stop here, and write the best checkpoint.
        if not pl_module.between_updates or trainer.should_stop:
            return
        if due > self._next and pl_module.progress < 1:
            self.score(trainer, pl_module, pl_module.renderer_now)
            self._next = due

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        coarse = pl_module.renderer_now is not pl_module.renderer
        if self.step != trainer.global_step or coarse:
            self.score(trainer, pl_module, pl_module.renderer)

    def score(self, trainer: Trainer, module: RadianceModule, renderer: Renderer) -> None:
        """Score the views now; only the first process does."""
        self.step = trainer.global_step
        with off_clock(trainer):
            with averaged(trainer, module):
                scores = self._score(trainer, module, renderer) if trainer.is_global_zero else {}
            if trainer.world_size > 1:
                scores = trainer.strategy.broadcast(scores)  # The others wait off the clock.
            split = trainer.datamodule.validation_split  # type: ignore[attr-defined]
            if split is not None and scores[f"{split}/psnr"] > self.best:
                self.best, self.best_step = scores[f"{split}/psnr"], self.step
            trainer.callback_metrics.update({n: torch.tensor(v) for n, v in scores.items()})
            for callback in trainer.callbacks:  # type: ignore[attr-defined]
                if isinstance(callback, EarlyStopping | ModelCheckpoint):
                    try:
                        callback.on_validation_end(trainer, module)
                    except (MisconfigurationException, RuntimeError) as error:
                        name = type(callback).__name__
                        raise ConfigError(f"callbacks: {name}: {error}") from error

    def _score(
        self, trainer: Trainer, module: RadianceModule, renderer: Renderer
    ) -> dict[str, float]:
        data: Any = trainer.datamodule  # type: ignore[attr-defined]
        split = data.validation_split or data.test_split
        views, step, run = data.scene.splits[split], trainer.global_step, _folder(trainer)
        if self._curve is None:
            self._curve = Curve(run / "curve.csv", until=step)
        began = time.perf_counter()
        module.eval()
        indices = spread(self.views or len(views), len(views))
        shown = {indices[place] for place in spread(SHOWN, len(indices))}
        self.latest, pictures = [], {}
        assert module.frame is not None
        for index in indices:
            if trainer.world_size == 1:  # Else all processes must stop together, after a step.
                check_interrupt(trainer)
            score, images = score_view(
                module.field, renderer, module.frame, views, index, data.scene.background
            )
            self.latest.append(score)
            if index in shown:
                pictures[score.file] = strip(
                    images.truth, images.colour, images.depth, images.opacity
                )
        module.train()
        self._curve.add(training_seconds(trainer), step, split, self.latest)
        psnr_now = mean([s.psnr for s in self.latest])
        scores = {f"{split}/psnr": psnr_now, f"{split}/ssim": mean([s.ssim for s in self.latest])}
        module.last.update(scores)
        self._write(trainer, module, run, split, scores, pictures)
        self.seconds += time.perf_counter() - began
        return scores

    def _write(
        self,
        trainer: Trainer,
        module: RadianceModule,
        run: Path,
        split: str,
        scores: Mapping[str, float],
        pictures: Mapping[str, Tensor],
    ) -> None:
        step, planes = trainer.global_step, module.field.planes
        if planes:
            sheet = plane_sheet(planes)
            write_png(run / "media" / "planes.png", sheet)
            log_image(trainer, "planes", sheet, step)
        for file, picture in pictures.items():
            path = file if file.startswith(f"{split}/") else f"{split}/{file}"
            name = path.replace("/", "_").removesuffix(".png")
            write_png(run / "media" / f"step{step:06d}" / f"{name}.png", picture)
            log_image(trainer, path, picture, step)
        for log in trainer.loggers:
            log.log_metrics({**scores, "time/train_s": training_seconds(trainer)}, step)

    def state_dict(self) -> dict[str, Any]:
        return {
            "best": self.best,
            "best_step": self.best_step,
            "seconds": self.seconds,
            "next": self._next,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best, self.best_step = state_dict["best"], state_dict["best_step"]
        self.seconds, self._next = state_dict["seconds"], state_dict["next"]


def final_scores(trainer: Trainer, module: RadianceModule, data: Any) -> list[ViewScore]:
    """Scores of all views of the data's ``test_split`` by the final model.

    Those of the last evaluation serve where it scored all of them.

    Args:
        trainer: Has trained the module.
        module: The module.
        data: A `SceneDataModule`.
    """
    views = data.scene.splits[data.test_split]
    evaluation = find_callback(trainer, Evaluation)
    same = data.test_split == (data.validation_split or data.test_split)
    if same and evaluation is not None and evaluation.step == trainer.global_step:
        latest = evaluation.latest
        if len(latest) == len(views):
            return latest
    assert module.frame is not None
    scored = (
        score_view(module.field, module.renderer, module.frame, views, index, data.scene.background)
        for index in range(len(views))
    )
    return [score for score, _ in scored]


def log_image(trainer: Trainer, tag: str, picture: Tensor, step: int) -> None:
    """Give an image to every logger that takes images; the others have it in the run's media.

    Args:
        trainer: Has the loggers.
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


@contextmanager
def averaged(trainer: Trainer, module: RadianceModule) -> Iterator[None]:
    """With the averaged weights, where a callback averages them: those that checkpoints hold."""
    callbacks: list[Any] = trainer.callbacks  # type: ignore[attr-defined]
    averages = [callback for callback in callbacks if isinstance(callback, WeightAveraging)]
    for callback in averages:
        callback.on_validation_epoch_start(trainer, module)
    try:
        yield
    finally:
        for callback in averages:
            callback.on_validation_epoch_end(trainer, module)


def _folder(trainer: Trainer) -> Path:
    return Path(trainer.default_root_dir)


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
