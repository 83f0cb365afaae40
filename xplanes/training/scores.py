"""Scores of views: rendered, compared with the true images, and averaged."""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor, distributed, nn

from xplanes.fields.base import Representation
from xplanes.metrics import psnr, ssim
from xplanes.rendering.base import Renderer, leave_empty
from xplanes.scenes.datamodule import whole_view
from xplanes.scenes.frame import Frame
from xplanes.scenes.matte import SOLID
from xplanes.scenes.views import Views
from xplanes.training.meters import Tally

VISIBLE = 0.05
"""Opacity above which a background pixel counts as a floater."""


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view.

    Attributes:
        file: Name of the true image.
        time: Its time, from 0 to 1.
        psnr: In dB.
        ssim: Structural similarity.
        psnr_foreground: In dB, over the pixels of the foreground object; NaN if unknown.
        floaters: Share of background pixels (alpha 0 in the true image) that are not transparent;
            NaN if the image has none.
    """

    file: str
    time: float
    psnr: float
    ssim: float
    floaters: float
    psnr_foreground: float = math.nan

    @property
    def scores(self) -> dict[str, float]:
        """Scores by name, without unknown ones."""
        found = {"psnr": self.psnr, "ssim": self.ssim}
        maybe = {"psnr_foreground": self.psnr_foreground, "floaters": self.floaters}
        return found | {name: value for name, value in maybe.items() if not math.isnan(value)}


def render_item(
    field: Representation, renderer: Renderer, frame: Frame, item: Mapping[str, Any]
) -> dict[str, Tensor]:
    """Render a whole view: ``colour`` [h, w, 3], ``opacity`` and ``depth`` [h, w], on the CPU.

    Args:
        field: The field.
        renderer: The renderer.
        frame: The field's frame.
        item: Result of `whole_view`.
    """
    background: Tensor = item["background"].cpu()
    image = renderer.view(field, frame, item["camera"], float(item["time"]), background)
    found = {name: value.cpu() for name, value in image.items()}
    if (shown := item.get("shown")) is not None:
        leave_empty(found, ~shown.cpu(), background)
    return found


def score_image(image: Mapping[str, Tensor], item: Mapping[str, Any]) -> ViewScore:
    """Compare a rendered view with the true image."""
    truth = item["target"].cpu()
    colour = image["colour"].float().clamp(0, 1)
    opacity, alpha = image["opacity"].float(), item["alpha"].cpu()
    if (shown := item.get("shown")) is not None:
        shown = shown.cpu()
        truth = torch.where(shown[..., None], truth, item["background"].cpu())
        opacity, alpha = opacity[shown], alpha[shown]
    return ViewScore(
        file=item["file"],
        time=float(item["time"]),
        psnr=psnr(colour, truth, shown),
        ssim=ssim(colour, truth, shown),
        floaters=floaters(opacity, alpha),
        psnr_foreground=psnr_foreground(colour, truth, item.get("foreground")),
    )


def score_view(
    field: Representation,
    renderer: Renderer,
    frame: Frame,
    views: Views,
    index: int,
    background: Tensor,
) -> tuple[ViewScore, dict[str, Tensor]]:
    """Render one of the views in front of ``background`` [3], and compare it with the true image.

    Returns:
        Its score, and its images as in `render_item`, with ``truth`` [H, W, 3].
    """
    item = whole_view(views, index, background)
    image = render_item(field, renderer, frame, item)
    return score_image(image, item), image | {"truth": item["target"]}


def gathered(scores: Sequence[ViewScore], trainer: Trainer) -> list[ViewScore]:
    """The scores of all processes in the order of the views; each scores every n-th view.

    A process without a view repeats a view of another process; duplicates count once.
    """
    if trainer.world_size == 1:
        return list(scores)
    parts: list[Any] = [None] * trainer.world_size
    distributed.all_gather_object(parts, list(scores))
    most = max(len(part) for part in parts)
    found = [part[place] for place in range(most) for part in parts if place < len(part)]
    return list({score.file: score for score in found}.values())


def psnr_foreground(colour: Tensor, truth: Tensor, foreground: Tensor | None) -> float:
    """PSNR in dB of the pixels that show the foreground object; NaN if there are none.

    Args:
        colour: Rendered colours. [H, W, 3]
        truth: True colours. [H, W, 3]
        foreground: Coverage of each pixel by the object; None if unknown. uint8 [H, W]
    """
    if foreground is None or not (shown := foreground.cpu() >= SOLID).any():
        return math.nan
    return psnr(colour[shown], truth[shown])


def floaters(opacity: Tensor, alpha: Tensor) -> float:
    """Share of pixels with alpha 0 whose rendered opacity is above `VISIBLE`. [N], uint8 [N]

    NaN without such pixels.
    """
    return float((opacity[alpha == 0] > VISIBLE).float().mean())


def mean_scores(scores: Sequence[ViewScore]) -> dict[str, float]:
    """Mean of each score over the views that have it."""
    names = dict.fromkeys(name for score in scores for name in score.scores)
    return {name: mean([s.scores[name] for s in scores if name in s.scores]) for name in names}


def mean_colour(views: Views, background: Tensor) -> Tensor:
    """Mean colour of all images, composited on ``background`` [3]. [3]"""
    images = (views.composite(index, background) for index in range(len(views)))
    return torch.stack([image.flatten(0, 1).mean(dim=0) for image in images]).mean(dim=0)


def blank_psnr(views: Views, background: Tensor) -> float:
    """Mean PSNR in dB of images that show nothing but the background."""
    truths = (views.composite(index, background) for index in range(len(views)))
    return mean([psnr(background.expand_as(truth), truth) for truth in truths])


def mean(values: Sequence[float]) -> float:
    """Mean; NaN for no values."""
    return math.fsum(values) / len(values) if values else math.nan


class ViewScoring(LightningModule):
    """Scores whole views, as `SceneDataModule` serves them, in validation and test.

    Attributes:
        field: The field that is rendered.
        tally: Receives the means over views.
        scores: Scores of the views of the last validation or test, from all processes.
    """

    field: Representation
    tally: Tally
    scores: list[ViewScore]
    _tag = ""

    @property
    @abstractmethod
    def frame(self) -> Frame | None:
        """The field's frame; None before it is built."""

    @property
    @abstractmethod
    def renderer(self) -> Renderer:
        """Renders images of the field."""

    @abstractmethod
    def corrected(self, poses: Tensor) -> Tensor:
        """Poses in the world as training has corrected them. [V, 4, 4]"""

    @property
    @abstractmethod
    def shared_parts(self) -> list[nn.Module]:
        """Modules whose buffers differ between processes during training."""

    def predict_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Tensor]:
        """One view: ``colour`` [H, W, 3], ``opacity`` and ``depth`` [H, W]."""
        frame, camera = self.frame, batch["camera"]
        assert frame is not None
        pose = self.corrected(camera.camera_to_world[None])[0]
        item = batch | {"camera": replace(camera, camera_to_world=pose)}
        return render_item(self.field, self.renderer, frame, item)

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Tensor]:
        """Render and score a view; the mean scores are logged at the end of the epoch."""
        image = self.predict_step(batch, batch_idx)
        self.scores.append(score_image(image, batch))
        self._tag = batch["tag"]
        return image

    test_step = validation_step

    def on_validation_epoch_start(self) -> None:
        self.agree()
        self.scores = []

    on_test_epoch_start = on_validation_epoch_start

    def on_validation_epoch_end(self) -> None:
        self.scores = gathered(self.scores, self.trainer)
        tag = self.trainer.strategy.broadcast(self._tag)  # A process may have had no view.
        means = {f"{tag}/{name}": value for name, value in mean_scores(self.scores).items()}
        self.tally.last |= means
        if self.trainer.state.fn == TrainerFn.FITTING:
            # Lightning's own count is one less, and does not continue in a resumed run.
            means["step"] = float(self.trainer.global_step)
        # All processes already have the means of all views; sync_dist avoids Lightning's warning.
        self.log_dict(means, batch_size=1, sync_dist=self.trainer.world_size > 1)

    on_test_epoch_end = on_validation_epoch_end

    def agree(self) -> None:
        """Copy the sampler's buffers from the first process to all others.

        Each has observed only its own rays; afterwards all score and save the same field.
        """
        if self._trainer is None or self._trainer.world_size == 1:
            return
        for part in self.shared_parts:
            own = getattr(part, "own", ())
            for name, buffer in part.named_buffers():
                if name not in own:
                    distributed.broadcast(buffer, src=0)
