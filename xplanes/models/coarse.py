"""Coarse structure first: smooth gradients of planes, as far as the images stay recognisable.

Before few cameras, a background can explain each image by content of its own, at a wrong depth. Of
what is smooth, all images show the same large shapes, which fit together only at the right depth;
details then follow them. The idea is that of frequency annealing (FreeNeRF, 2023).
"""

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.metrics import mean
from xplanes.scenes.frame import Frame, pixels_across
from xplanes.scenes.views import Views

UNITS = 64
"""Blur radii are tried in units of this fraction of the cube's side."""

RADII = (1, 2, 4, 8, 16)
"""Blur radii, in `UNITS`."""

RECOGNISABLE = 0.18
"""Share of the images' variance that a blur must leave."""

TRIED = 12
"""Number of views that are blurred."""

FAR = 10.0
"""Distance of cameras, in half sides of the cube, above which they are not taken to see the same
surroundings."""


def smooth(gradient: Tensor, radius: int) -> None:
    """Smooth a gradient of planes along both axes in place, by two box filters. [P, H, W, C]

    Args:
        gradient: The gradient.
        radius: Texels on either side of a box's centre.
    """
    if radius < 1:
        return
    rows, columns = (_filter(size, radius).to(gradient) for size in gradient.shape[1:3])
    down = torch.matmul(rows, gradient.flatten(2)).view_as(gradient)
    torch.matmul(columns, down, out=gradient)


def coherence(views: Views, frame: Frame) -> float:
    """Largest radius of a blur that leaves the images recognisable, as a share of the cube's side.

    0 if there is none, or if the cameras are so far from the cube that each sees surroundings of
    its own.

    Args:
        views: Training views.
        frame: The field's frame.
    """
    away = (views.camera_to_world[:, :3, 3] - frame.centre).norm(dim=-1) * frame.scale
    if away.median() > FAR:
        return 0.0
    unit = pixels_across(views, frame) / UNITS
    kept = []
    for index in range(0, len(views), max(1, len(views) // TRIED)):
        image = views.composite(index, torch.zeros(3)).permute(2, 0, 1)[None].double()
        size = [max(1, round(length / unit)) for length in image.shape[2:]]
        small = F.interpolate(image, size, mode="area").permute(0, 2, 3, 1)
        variance = _variance(image.permute(0, 2, 3, 1))
        if not variance:
            continue
        shares = []
        for radius in RADII:
            blurred = small.clone()
            smooth(blurred, radius)
            shares.append(_variance(blurred) / variance)
        kept.append(shares)
    means = [mean(shares) for shares in zip(*kept, strict=True)]
    found = [r for r, share in zip(RADII, means, strict=False) if share >= RECOGNISABLE]
    return max(found, default=0) / UNITS


def _variance(image: Tensor) -> float:
    """Variance of an image over its pixels, summed over channels. [1, H, W, 3]"""
    return float(image.var(dim=(1, 2), correction=0).sum())


@lru_cache(maxsize=64)
def _filter(size: int, radius: int) -> Tensor:
    """Two box filters of a line, cut off at its ends and normalised, as a matrix. [size, size]"""
    places = torch.arange(size)
    box = ((places[:, None] - places).abs() <= radius).double()
    box /= box.sum(dim=1, keepdim=True)
    return box @ box
