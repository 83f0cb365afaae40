"""Scores of views, and the curve of them over training."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from xplanes.files import read_rows, write_rows
from xplanes.metrics import psnr, ssim
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.box import Field
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view.

    Attributes:
        file: Name of the true image.
        time: Its time, from 0 to 1.
        psnr: In dB.
        ssim: Structural similarity.
    """

    file: str
    time: float
    psnr: float
    ssim: float


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
    field: Field,
    renderer: RayRenderer,
    frame: Frame,
    views: Views,
    index: int,
    background: Tensor,
) -> dict[str, Tensor]:
    """Render one view whole: ``colour`` [H, W, 3], ``opacity`` and ``depth`` [H, W], on the CPU."""
    device = renderer.device
    origins, directions = (ray.to(device) for ray in frame.rays(*views.image_rays(index)))
    time = float(views.times[index])
    image = renderer.image(field, origins, directions, time, background.to(device))
    shape = (views.height, views.width)
    return {name: value.cpu().view(*shape, *value.shape[1:]) for name, value in image.items()}


def score_view(
    field: Field,
    renderer: RayRenderer,
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
    )
    return score, ViewImages(truth, colour, image["depth"].float(), image["opacity"].float())


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
