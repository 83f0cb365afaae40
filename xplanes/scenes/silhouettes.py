"""Foreground pixels (silhouettes, or changes in images of fixed cameras), and the visual hull."""

import math
from collections.abc import Iterable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.scenes.cameras import ball_extent, project
from xplanes.scenes.views import Views

WINDOW = 0.06
"""Window in time, as a share of the views, in which silhouettes are intersected as if static."""

SAME_COLOUR = 4
"""Largest difference, out of 255, between pixels of one colour."""

LEAST_FRAMES = 3
"""Least number of a camera's images for which their median shows the static content."""

LEAST_CAMERAS = 2
"""Least number of cameras that can locate motion in space."""

HALF = 2
"""Side in pixels of the squares that are compared to locate motion in space."""

MARGIN = 1
"""Squares around a point that count as near it, since poses are not exact."""

POINTS = 2**18
"""Points that are projected together."""

CHANGE = 20
"""Least difference from the median, out of 255 in any channel, of a changed pixel."""

MOST_VIEWS = 5
"""Most views in the window: more would cut off moving content and carve away little else."""


def foreground(views: Views, margins: Sequence[int]) -> Tensor:
    """Pixels near the silhouettes. bool [V, H, W]

    Args:
        views: Images; their padding is never foreground.
        margins: Distance in pixels for each image. [V]
    """
    near = torch.zeros(views.images.shape[:3], dtype=torch.bool)
    for index, reach in enumerate(margins):
        shown = views.silhouette(index)
        near[index, : shown.shape[0], : shown.shape[1]] = widened(shown, reach)
    return near


def textureless(views: Views, margins: Sequence[int]) -> Tensor:
    """Opaque pixels in a neighbourhood of one colour: walls and floors without texture.

    Args:
        views: Images in memory.
        margins: Size of the neighbourhood in pixels, for each image. [V]

    Returns:
        bool [V, H, W]
    """
    found = torch.zeros(views.images.shape[:3], dtype=torch.bool)
    for index, reach in enumerate(margins):
        image = views.image(index)
        height, width = image.shape[0] // reach * reach, image.shape[1] // reach * reach
        blocks = image[:height, :width].view(height // reach, reach, width // reach, reach, 4)
        # Maximum over each block and its eight neighbours.
        most = F.max_pool2d(blocks.amax(dim=(1, 3)).permute(2, 0, 1).float(), 3, 1, 1)
        least = -F.max_pool2d(-blocks.amin(dim=(1, 3)).permute(2, 0, 1).float(), 3, 1, 1)
        even = ((most - least).amax(dim=0) <= SAME_COLOUR) & (least[3] == 255)
        found[index, :height, :width] = enlarged(even, reach, (height, width))
    return found


def enlarged(mask: Tensor, factor: int, size: Sequence[int]) -> Tensor:
    """A mask enlarged by pixel replication and cropped to a size. bool [h, w] -> bool [H, W]"""
    mask = mask.repeat_interleave(factor, 0).repeat_interleave(factor, 1)
    return mask[: size[0], : size[1]]


def count_in_squares(mask: Tensor, side: int) -> Tensor:
    """Number of mask pixels in each square of an image.

    Args:
        mask: Pixels. bool [h, w]
        side: Rows and columns of a square.

    Returns:
        int64 [h / side, w / side], rounded up
    """
    height, width = mask.shape
    padded = F.pad(mask, (0, -width % side, 0, -height % side))
    return padded.view(-(-height // side), side, -(-width // side), side).sum(dim=(1, 3))


def widened(mask: Tensor, reach: int) -> Tensor:
    """The mask, dilated by ``reach`` pixels with a square. bool [H, W]"""
    for axis in (0, 1):
        size, places = mask.shape[axis], torch.arange(mask.shape[axis])
        # Differences of cumulative sums cost the same whatever the reach.
        sums = F.pad(mask.cumsum(axis, dtype=torch.int32), (0, 0, 1, 0) if axis == 0 else (1, 0))
        ends = (places + reach + 1).clamp(max=size), (places - reach).clamp(min=0)
        last, first = (sums.index_select(axis, at) for at in ends)
        mask = last > first
    return mask


def may_hold(views: Views, points: Tensor, *, radius: float) -> Tensor:
    """For each view, which points may be occupied at its time, judged by its silhouette alone.

    Points outside a view's image may be occupied, and so may all points if it has no alpha.

    Args:
        views: Images with alpha.
        points: World points. [N, 3]
        radius: Radius around each point that counts as part of it, in world units.

    Returns:
        Whether the point may be occupied. bool [V, N]
    """
    inside = torch.ones(len(views), len(points), dtype=torch.bool)
    for index in range(len(views)):
        seen, box = _footprints(views, index, points, radius)
        if seen.any():
            inside[index, seen] = _meets(views.silhouette(index), box)
    return inside


def _footprints(
    views: Views, index: int, points: Tensor, radius: float
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Points inside an image, and the squares of pixels around them that `_meets` takes.

    Returns:
        Whether each point is inside, bool [N]; first row and column, and end row and column. [K]
    """
    intrinsics, pose = views.intrinsics, views.camera_to_world[index]
    height, width = views.size(index)
    focal, lens = intrinsics.focal[index], intrinsics.lens(index)
    centre = intrinsics.centre[index]
    column, row, seen = project(pose, points, focal=focal, centre=centre, lenses=lens)
    column, row = column.floor(), row.floor()
    seen = seen & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    stretch = 1.0 if intrinsics.sights is None else intrinsics.sights[index].stretch
    margin = ball_extent(pose, points, radius, focal=focal, lenses=lens, stretch=stretch)
    seen &= margin < math.inf
    reach = margin[seen].ceil().clamp(max=max(height, width)).long()
    row, column = row[seen].long(), column[seen].long()
    top, left = (row - reach).clamp(min=0), (column - reach).clamp(min=0)
    end, right = (row + reach + 1).clamp(max=height), (column + reach + 1).clamp(max=width)
    return seen, (top, left, end, right)


def _meets(mask: Tensor, box: Iterable[Tensor]) -> Tensor:
    """Whether each square of pixels meets the mask, from a summed-area table. bool [K]"""
    sums = F.pad(mask.cumsum(0, dtype=torch.int32).cumsum(1), (1, 0, 1, 0))
    top, left, end, right = box
    return sums[end, right] - sums[top, right] - sums[end, left] + sums[top, left] > 0


def join_in_time(inside: Tensor, times: Tensor) -> Tensor:
    """The visual hull over short time windows, from the silhouettes of single views.

    A point is occupied at a view's time only if all views of some window around that time allow it.
    The window is short (`WINDOW`), so that slow motion stays inside the hull; fast content may lose
    its edges. If all views have the same time, the hull is exact.

    Args:
        inside: Result of `may_hold`. bool [V, N]
        times: Times of the views. [V]

    Returns:
        For each view's time and point, whether the point may be occupied. bool [V, N]
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
    """Pixels of fixed cameras near pixels that differ from the median over time.

    Args:
        views: Opaque images in memory.
        margins: Margin around changed pixels, in pixels, for each image. [V]

    Returns:
        bool [V, H, W]; None if a camera moves or has few images, or nothing changes.

    Source: the idea of DyNeRF's importance sampling (Li et al., CVPR 2022, Section 4.3).
    """
    cameras = _cameras(views)
    if any(len(frames) < LEAST_FRAMES for frames in cameras):
        return None
    found = torch.zeros(views.images.shape[:3], dtype=torch.bool)
    for frames in cameras:
        images = torch.stack([views.image(index)[..., :3].permute(2, 0, 1) for index in frames])
        for index, changed in zip(frames, _changed(images), strict=True):
            height, width = changed.shape
            found[index, :height, :width] = widened(changed, margins[index])
    return found if found.any() else None


def moving(
    views: Views, points: Tensor, *, radius: float, bins: Tensor, count: int
) -> Tensor | None:
    """Points around which all fixed cameras that see them, at least two, show a change.

    Points that a static object hides from one camera are not found. Cameras that move or have few
    images are left out. Images are compared at half their size.

    Args:
        views: Opaque images in memory.
        points: World points. [N, 3]
        radius: As for `may_hold`.
        bins: Time bin of each view. int64 [V]
        count: Number of bins. A bin shows the changes of all images in it; if it has none, of those
            in the nearest bins before and after that have any.

    Returns:
        For each bin, which points may belong to moving content, bool [count, N]; None if there are
        fewer than two fixed cameras.
    """
    cameras = [frames for frames in _cameras(views) if len(frames) >= LEAST_FRAMES]
    if len(cameras) < LEAST_CAMERAS:
        return None
    found = torch.ones(count, len(points), dtype=torch.bool)
    seen_by = torch.zeros(count, len(points), dtype=torch.int16)
    for frames in cameras:
        shown, changed = _halved_changes(views, frames)
        there = bins[torch.tensor(frames)]
        covers = [_images_of_bin(there, place) for place in range(count)]
        for start in range(0, len(points), POINTS):
            inside, box = _footprints(views, frames[0], points[start : start + POINTS], radius)
            inside = inside.nonzero()[:, 0] + start
            squares = torch.stack(_in_halved(box, changed.shape[1:]))
            for place, cover in enumerate(covers):
                left = found[place, inside]
                if shown is not None:
                    left[left.clone()] = _meets(shown[cover].any(dim=0), squares[:, left])
                seen = inside[left]
                found[place, seen] = _meets(changed[cover].any(dim=0), squares[:, left])
                seen_by[place, seen] += 1
    return found & (seen_by >= LEAST_CAMERAS)


def _in_halved(box: Sequence[Tensor], size: Sequence[int]) -> list[Tensor]:
    """Squares of pixels in an image of half the size, wider by `MARGIN` on each side."""
    top, left, end, right = (torch.div(edge, HALF, rounding_mode="floor") for edge in box)
    (height, width), more = size, MARGIN + 1  # The last square may be cut off.
    first = ((top - MARGIN).clamp(min=0), (left - MARGIN).clamp(min=0))
    return [*first, (end + more).clamp(max=height), (right + more).clamp(max=width)]


def _images_of_bin(bins: Tensor, place: int) -> Tensor:
    """A camera's images in a time bin, or in the nearest bins if it has none. bool [F]"""
    if (inside := bins == place).any():
        return inside
    before, after = bins[bins < place], bins[bins > place]
    near = [*before.sort().values[-1:], *after.sort().values[:1]]
    return torch.isin(bins, torch.stack(near))


def _halved_changes(views: Views, frames: list[int]) -> tuple[Tensor | None, Tensor]:
    """Squares of four pixels that are shown, and those that differ from their median over time.

    Averages are compared: they are less noisy and still show lines of one pixel.

    Returns:
        bool [F, h / 2, w / 2] each, rounded up; the first is None if all pixels are shown.
    """
    # Averages are less noisy and still show lines of one pixel.
    images = []
    for index in frames:
        image = views.image(index)[..., :3].permute(2, 0, 1).contiguous().float()
        images.append(F.avg_pool2d(image, HALF, ceil_mode=True, count_include_pad=False).byte())
    changed = torch.stack(_changed(torch.stack(images)))
    masks = [views.shown(index) for index in frames]
    if all(mask is None for mask in masks):
        return None, changed
    shown = torch.ones_like(changed)
    for whole, mask in zip(shown, masks, strict=True):
        if mask is not None:
            whole.copy_(F.max_pool2d((~mask).float()[None], HALF, ceil_mode=True)[0] == 0)
    return shown, changed & shown


def _changed(images: Tensor) -> list[Tensor]:
    """Pixels of a camera's images that differ from their median. uint8 [F, 3, h, w] -> [h, w]"""
    median = images.median(dim=0).values.short()
    return [(image.short() - median).abs().amax(dim=0) >= CHANGE for image in images]


def _cameras(views: Views) -> list[list[int]]:
    """The images of each camera, identified by pose and intrinsics."""
    intrinsics = views.intrinsics
    numbers = [views.camera_to_world.flatten(1).double(), intrinsics.focal, intrinsics.centre]
    rows = torch.cat([*numbers, intrinsics.size.double()], dim=1)
    _, camera = rows.unique(dim=0, return_inverse=True)
    return [(camera == number).nonzero()[:, 0].tolist() for number in range(int(camera.max()) + 1)]
