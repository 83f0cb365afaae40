"""What changes in the images of fixed cameras."""

from collections.abc import Sequence

import torch
from torch import Tensor

from xplanes.scenes.silhouettes import widened
from xplanes.scenes.views import Views

LEAST_FRAMES = 3
"""Images that a camera must have taken for their median to show what is static."""

CHANGE = 20
"""Difference from the median, of 255 in any channel, from which a pixel has changed."""


def changing(views: Views, margins: Sequence[int]) -> Tensor | None:
    """Pixels of fixed cameras that differ from the median over time, or lie near such.

    Args:
        views: Opaque images in memory.
        margins: Pixels around those that differ, for each image. [V]

    Returns:
        None where some camera moves or has few images, or nothing changes. bool [V, H, W]

    Source: the idea of DyNeRF's importance sampling (Li et al., CVPR 2022, Section 4.3).
    """
    cameras = _cameras(views)
    if any(len(frames) < LEAST_FRAMES for frames in cameras):
        return None
    found = torch.zeros(views.images.shape[:3], dtype=torch.bool)
    for frames in cameras:
        images = torch.stack([views.image(index)[..., :3] for index in frames])
        median = images.median(dim=0).values.short()
        for index, image in zip(frames, images, strict=True):
            changed = (image.short() - median).abs().amax(dim=-1) >= CHANGE
            found[index, : len(image), : image.shape[1]] = widened(changed, margins[index])
    return found if found.any() else None


def _cameras(views: Views) -> list[list[int]]:
    """The images of each camera pose with the same intrinsics."""
    intrinsics = views.intrinsics
    numbers = [views.camera_to_world.flatten(1).double(), intrinsics.focal, intrinsics.centre]
    rows = torch.cat([*numbers, intrinsics.size.double()], dim=1)
    _, camera = rows.unique(dim=0, return_inverse=True)
    return [(camera == number).nonzero()[:, 0].tolist() for number in range(int(camera.max()) + 1)]
