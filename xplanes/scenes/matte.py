"""The silhouette of an image: its visible alpha, without the noise of soft mattes."""

import numpy as np
from torch import Tensor

SOLID = 128
"""Alpha, out of 255, from which a pixel counts as foreground."""

VISIBLE = 20
"""Alpha, out of 255, from which a pixel is visible: far above the noise of mattes, but far below
one half, so that hair, glass and thin edges are kept."""

FAINT = 6
"""Threshold for an image with hardly any opaque pixels, whose content may be faint."""

OPAQUE, OPAQUE_SHARE = 64, 1e-3
"""Alpha of opaque content; an image with a smaller share of such pixels counts as faint."""

NOISE, SMALLER = 0.01, 5
"""A region is noise if its extent is below this share of the image's longer side, and the largest
region is at least this many times as large. Long wires and a single small object are thus kept."""


def silhouette_of(alpha: Tensor) -> Tensor:
    """The pixels of an image that belong to its silhouette.

    These are the connected regions of visible alpha, except for small ones, which are noise.
    Antialiased and soft edges end where alpha falls below `VISIBLE`.

    Args:
        alpha: Opacity, from 0 to 255. uint8 [h, w]

    Returns:
        bool [h, w]
    """
    opaque = int((alpha >= OPAQUE).sum())
    visible = alpha >= (VISIBLE if opaque >= OPAQUE_SHARE * alpha.numel() else FAINT)
    if visible.any() and not visible.all():
        _remove_noise(visible.numpy())
    return visible


def _remove_noise(mask: np.ndarray) -> None:
    """Clear regions far smaller than the image and the largest region. bool [h, w]"""
    height, width = mask.shape
    # Rows are padded by two pixels, so that runs of adjacent rows do not have adjacent indices.
    pitch = width + 2
    padded = np.zeros((height, pitch), np.int8)
    padded[:, 1:-1] = mask
    change = np.diff(padded.ravel())
    first, end = (change == 1).nonzero()[0], (change == -1).nonzero()[0]
    region = _regions(first, end, pitch)
    count = len(first)
    low = np.full((2, count), max(height, width))
    high = np.zeros((2, count), np.int64)
    row = first // pitch
    for axis, (start, stop) in enumerate([(row, row + 1), (first % pitch, end - pitch * row)]):
        np.minimum.at(low[axis], region, start)
        np.maximum.at(high[axis], region, stop)
    extent = (high - low).max(axis=0)
    limit = min(max(1, round(NOISE * max(height, width))), int(extent.max()) // SMALLER)
    small = extent[region] <= limit
    first, end, row = first[small], end[small], row[small]
    for offset in range(limit):
        inside = first + offset < end
        mask[row[inside], first[inside] % pitch + offset] = False


def _regions(first: np.ndarray, end: np.ndarray, pitch: int) -> np.ndarray:
    """Label the connected region of each run of pixels (8-connected).

    Args:
        first: Index of each run's first pixel, ascending, in rows of ``pitch`` pixels. [N]
        end: Index after its last pixel. [N]
        pitch: Pixels per row; the last two are never in a run.

    Returns:
        int64 [N]
    """
    region = np.arange(len(first))
    # The runs that touch a run from the row below are consecutive.
    begin = np.searchsorted(end, first + pitch)
    touched = np.searchsorted(first, end + pitch, side="right") - begin
    above = region.repeat(touched)
    below = np.arange(len(above)) + (begin - (touched.cumsum() - touched)).repeat(touched)
    while (region[above] != region[below]).any():
        least = np.minimum(region[above], region[below])
        for side in (above, below):
            np.minimum.at(region, region[side], least)
        region = region[region]
    return region
