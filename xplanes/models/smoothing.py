"""Coarse structure first: smoothed gradients of planes, as far as images stay recognisable.

Before few cameras, a background can explain each image by content of its own, at a wrong depth. Of
what is smooth, all images show the same large shapes, which fit together only at the right depth;
details then follow them. The idea is that of frequency annealing (FreeNeRF, 2023).
"""

from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.scenes.frame import Frame, pixels_across
from xplanes.scenes.views import Views

UNITS = 64
"""Blur radii are tried in units of this fraction of the cube's side."""

RADII = (1, 2, 4, 8, 16)
"""Blur radii that are tried, in `UNITS`; between them, variances are interpolated."""

RECOGNISABLE = 0.27
"""Share of the images' variance that a blur must leave."""

TRIED = 12
"""Number of views that are blurred."""

FAR = 10.0
"""Distance of cameras, in half sides of the cube, above which they are not taken to see the same
surroundings."""


def smoothed(planes: Tensor, radius: int) -> Tensor:
    """Planes after two box filters along both axes. [P, H, W, C]

    Args:
        planes: Planes, or their gradient.
        radius: Texels on either side of a box's centre.
    """
    rows, columns = (_filter(size, radius).to(planes) for size in planes.shape[1:3])
    return columns @ (rows @ planes.flatten(2)).view_as(planes)


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
        image = views.composite(index, torch.zeros(3))[None]
        size = [max(1, round(length / unit)) for length in image.shape[1:3]]
        small = F.interpolate(image.permute(0, 3, 1, 2), size, mode="area").permute(0, 2, 3, 1)
        variances = torch.stack([_variance(smoothed(small, radius)) for radius in RADII])
        if variance := float(_variance(image)):
            kept.append(variances / variance)
    if not kept:
        return 0.0
    shares = torch.stack(kept).mean(dim=0)
    octave = np.interp(-RECOGNISABLE, (-shares).numpy(), np.log2(RADII), left=-np.inf)
    return float(2**octave) / UNITS


def _variance(image: Tensor) -> Tensor:
    """Variance of an image over its pixels, summed over channels. [1, H, W, 3] -> []"""
    return image.var(dim=(1, 2), correction=0).sum()


@lru_cache(maxsize=64)
def _filter(size: int, radius: int) -> Tensor:
    """Two box filters of a line, cut off at its ends and normalised, as a matrix. [size, size]"""
    places = torch.arange(size)
    box = ((places[:, None] - places).abs() <= radius).double()
    box /= box.sum(dim=1, keepdim=True)
    return box @ box
