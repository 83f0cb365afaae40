"""Scores of views: rendered, compared with the true images, and averaged."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from lightning import Trainer
from torch import Tensor, distributed

from xplanes.fields.base import Representation
from xplanes.metrics import mean, psnr, ssim
from xplanes.rendering.base import Renderer, leave_empty
from xplanes.scenes.datamodule import whole_view
from xplanes.scenes.frame import Frame
from xplanes.scenes.matte import SOLID
from xplanes.scenes.views import Views

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
    """The scores of all processes in the order of the views; each process scores every n-th view.

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
