"""Pixels that show something: silhouettes, changes before fixed cameras; and cells shown empty."""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.scenes.cameras import ball_extent, project
from xplanes.scenes.views import Views

WINDOW = 0.06
"""Share of the time span over which content counts as static when silhouettes are intersected."""

SAME_COLOUR = 4
"""Steps of 255 by which pixels of one colour differ at most."""

LEAST_FRAMES = 3
"""Images that a camera must have taken for their median to show what is static."""

CHANGE = 20
"""Least difference from the median, of 255 in any channel, of a pixel that has changed."""

MOST_VIEWS = 5
"""Most views in such a span: more would cut into moving content and empty little else."""


def foreground(views: Views, margin: int | Sequence[int]) -> Tensor:
    """Pixels of the silhouettes, or within ``margin`` pixels of such. bool [V, H, W]

    Args:
        views: Images; none of their padding is foreground.
        margin: The same for all images, or one for each.
    """
    near = torch.zeros(views.images.shape[:3], dtype=torch.bool)
    margins = [margin] * len(views) if isinstance(margin, int) else margin
    for index, reach in enumerate(margins):
        shown = views.silhouette(index)
        near[index, : shown.shape[0], : shown.shape[1]] = widened(shown, reach)
    return near


def plain(views: Views, margins: Sequence[int]) -> Tensor:
    """Opaque pixels in surroundings of one colour: walls and floors without texture.

    Args:
        views: Images in memory.
        margins: Size of these surroundings in pixels, for each image. [V]

    Returns:
        bool [V, H, W]
    """
    found = torch.zeros(views.images.shape[:3], dtype=torch.bool)
    for index, reach in enumerate(margins):
        image = views.image(index)
        height, width = image.shape[0] // reach * reach, image.shape[1] // reach * reach
        blocks = image[:height, :width].view(height // reach, reach, width // reach, reach, 4)
        # Of each block and the eight around it; blocks at the rim have fewer.
        most = F.max_pool2d(blocks.amax(dim=(1, 3)).permute(2, 0, 1).float(), 3, 1, 1)
        least = -F.max_pool2d(-blocks.amin(dim=(1, 3)).permute(2, 0, 1).float(), 3, 1, 1)
        even = ((most - least).amax(dim=0) <= SAME_COLOUR) & (least[3] == 255)
        even = even.repeat_interleave(reach, 0).repeat_interleave(reach, 1)
        found[index, :height, :width] = even
    return found


def count_in_squares(mask: Tensor, side: int) -> Tensor:
    """How many pixels a mask holds in each square of an image.

    Args:
        mask: Pixels. bool [h, w]
        side: Rows and columns of a square.

    Returns:
        Their numbers. int64 [h / side, w / side], rounded up
    """
    height, width = mask.shape
    padded = F.pad(mask, (0, -width % side, 0, -height % side))
    return padded.view(-(-height // side), side, -(-width // side), side).sum(dim=(1, 3))


def widened(mask: Tensor, reach: int) -> Tensor:
    """Pixels within a square of ``reach`` pixels around those of a mask. bool [H, W]"""
    side = 2 * reach + 1
    # Rows, then columns: the square's pixels number many more.
    rows = F.max_pool2d(mask.float()[None], (side, 1), stride=1, padding=(reach, 0))
    return F.max_pool2d(rows, (1, side), stride=1, padding=(0, reach))[0] > 0


def may_hold(views: Views, points: Tensor, *, radius: float) -> Tensor:
    """Which points may hold something at each view's time, as far as that view alone can tell.

    Points out of a view's sight are not ruled out by it, and images without alpha rule out nothing.

    Args:
        views: Images with alpha.
        points: World points. [N, 3]
        radius: Distance around each point that counts as the point, in world units.

    Returns:
        Whether something may be there. bool [V, N]
    """
    inside = torch.ones(len(views), len(points), dtype=torch.bool)
    intrinsics = views.intrinsics
    for index, pose in enumerate(views.camera_to_world):
        height, width = views.size(index)
        focal, lens = intrinsics.focal[index], intrinsics.lens(index)
        centre = intrinsics.centre[index]
        column, row, seen = project(pose, points, focal=focal, centre=centre, lenses=lens)
        column, row = column.floor(), row.floor()
        seen = seen & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        stretch = 1.0 if intrinsics.sights is None else intrinsics.sights[index].stretch
        margin = ball_extent(pose, points, radius, focal=focal, lenses=lens, stretch=stretch)
        seen &= margin < math.inf
        if not seen.any():
            continue
        # The silhouette's pixels in the square around each point, from sums over rectangles.
        sums = F.pad(views.silhouette(index).cumsum(0, dtype=torch.int32).cumsum(1), (1, 0, 1, 0))
        reach = margin[seen].ceil().clamp(max=max(height, width)).long()
        row, column = row[seen].long(), column[seen].long()
        top, left = (row - reach).clamp(min=0), (column - reach).clamp(min=0)
        end, right = (row + reach + 1).clamp(max=height), (column + reach + 1).clamp(max=width)
        held = sums[end, right] - sums[top, right] - sums[end, left] + sums[top, left]
        inside[index, seen] = held > 0
    return inside


def join_in_time(inside: Tensor, times: Tensor) -> Tensor:
    """The visual hull over short spans of time, from what each view alone can tell.

    A point holds something at a view's time only if every view of some span of time around it
    allows that. The span is short (`WINDOW`), so that slow motion stays inside the hull; what moves
    fast can lose its edges. Where all views have one time all must agree, and nothing is lost.

    Args:
        inside: Outcome of `may_hold`. bool [V, N]
        times: Times of the views. [V]

    Returns:
        For each view's time and point, whether something may be there. bool [V, N]
    """
    span = max(1, min(MOST_VIEWS, round(WINDOW * len(times))))
    if bool((times == times[0]).all()):
        span = len(times)
    order = times.argsort(stable=True)
    runs = inside[order].unfold(0, span, 1).all(dim=-1)
    held = torch.zeros_like(inside)
    for shift in range(span):
        held[shift : shift + len(runs)] |= runs
    result = torch.empty_like(held)
    result[order] = held
    return result


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
