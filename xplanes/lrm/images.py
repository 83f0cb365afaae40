"""Preprocessing: from RGBA images to the input of each model."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.errors import LRMError
from xplanes.lrm.canonical import OPENLRM_VIEW, TRIPOSR_VIEW
from xplanes.lrm.config import Architecture

FOREGROUND_RATIO = 0.85
"""Share of the image side that the object fills in TripoSR's preprocessing."""


@dataclass(frozen=True)
class Crop:
    """A square crop of an image; pixels outside the image are transparent.

    Attributes:
        top: Row of the crop's first pixel; negative above the image.
        left: Column of the crop's first pixel; negative left of the image.
        side: Side of the crop in pixels.
        kept: Top, left, bottom and right (exclusive) of the part that is copied; all when None.
    """

    top: int
    left: int
    side: int
    kept: tuple[int, int, int, int] | None = None

    def apply(self, rgba: Tensor) -> Tensor:
        """Apply the crop; pixels outside the image are transparent black.

        Args:
            rgba: Images, alpha last. [N, 4, H, W]

        Returns:
            Cropped images. [N, 4, side, side]
        """
        check_rgba(rgba)
        height, width = rgba.shape[-2:]
        top, left, bottom, right = self.kept or (0, 0, height, width)
        top, bottom = max(top, self.top, 0), min(bottom, self.top + self.side, height)
        left, right = max(left, self.left, 0), min(right, self.left + self.side, width)
        result = rgba.new_zeros(*rgba.shape[:2], self.side, self.side)
        if top < bottom and left < right:
            rows = slice(top - self.top, bottom - self.top)
            columns = slice(left - self.left, right - self.left)
            result[..., rows, columns] = rgba[..., top:bottom, left:right]
        return result


def square_crop(height: int, width: int, zoom: float = 1.0) -> Crop:
    """The smallest centred square around an image, its side divided by ``zoom``.

    Margins are whole pixels and equal on opposite sides, so that the centre is preserved.
    """
    side = max(height, width)
    side += 2 * round(0.5 * side * (1 / zoom - 1))
    return Crop((height - side) // 2, (width - side) // 2, side)


def foreground_crop(alpha: Tensor) -> Crop:
    """The square in which the opaque part fills `FOREGROUND_RATIO` of the side.

    As in TripoSR, the last row and column of the opaque part are lost. For a video, pass the
    maximum of alpha over time, so that all frames share one crop.

    Args:
        alpha: Opacity. [H, W]

    Raises:
        LRMError: If nothing, or only one row or column, is opaque.

    Source: TripoSR.
    """
    rows, columns = (alpha > 0).nonzero().unbind(1)
    if not len(rows) or rows.min() == rows.max() or columns.min() == columns.max():
        raise LRMError("the image is empty: its alpha channel has no object to crop to")
    top, bottom = int(rows.min()), int(rows.max())
    left, right = int(columns.min()), int(columns.max())
    tight = max(bottom - top, right - left)
    side = int(tight / FOREGROUND_RATIO)
    margin = (side - tight) // 2
    return Crop(
        top - (tight - (bottom - top)) // 2 - margin,
        left - (tight - (right - left)) // 2 - margin,
        side,
        (top, left, bottom, right),
    )


def composite_on(rgba: Tensor, background: float) -> Tensor:
    """Composite images (uint8 or in [0, 1]) on grey. [N, 4, H, W] -> [N, 3, H, W]"""
    check_rgba(rgba)
    rgba = rgba.float() / 255 if rgba.dtype == torch.uint8 else rgba
    colour, alpha = rgba[:, :3], rgba[:, 3:]
    return colour * alpha + (1 - alpha) * background


def prepare(rgba: Tensor, architecture: Architecture, size: int) -> Tensor:
    """Preprocess images as in a model's published code, without cropping.

    Args:
        rgba: Images, alpha last; uint8, or in [0, 1]. [N, 4, H, W]
        architecture: Family of the model.
        size: Side of the result in pixels.

    Returns:
        RGB from 0 to 1. [N, 3, size, size]

    Source: OpenLRM 1.1; TripoSR.
    """
    if architecture == "triposr":
        colour = composite_on(rgba, TRIPOSR_VIEW.background)
        # TripoSR truncates the composite to 8 bits.
        return resize_triposr((colour * 255).floor() / 255, size)
    return resize_openlrm(composite_on(rgba, OPENLRM_VIEW.background), size)


def resize_openlrm(images: Tensor, size: int) -> Tensor:
    """Resize to a square as OpenLRM does. 0 to 1, [N, 3, H, W] -> [N, 3, size, size]"""
    resized = F.interpolate(images, size=(size, size), mode="bicubic", align_corners=True)
    return resized.clamp(0, 1)


def resize_triposr(images: Tensor, size: int) -> Tensor:
    """Resize to a square as TripoSR does. [N, 3, H, W] -> [N, 3, size, size]"""
    if images.shape[-2:] == (size, size):
        return images
    return F.interpolate(images, size=(size, size), mode="bilinear", antialias=True)


def check_rgba(rgba: Tensor) -> None:
    """Check that a tensor is a batch of RGBA images.

    Raises:
        LRMError: Naming the shape.
    """
    if rgba.ndim != 4 or rgba.shape[1] != 4:
        raise LRMError(f"images have the shape {list(rgba.shape)}: must be [N, 4, H, W]")
