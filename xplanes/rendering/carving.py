"""Pruning of the occupancy grid by silhouettes."""

import torch
from torch import Tensor

from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.scenes.frame import Frame
from xplanes.scenes.silhouettes import join_in_time, may_hold
from xplanes.scenes.views import Views

CHUNK = 2**17
"""Points that are projected together, for up to 512 views; fewer for more views."""


def carve(grid: OccupancyGrid, views: Views, frame: Frame, *, exact: bool = True) -> None:
    """Empty the cells that lie outside the silhouettes of the training views.

    A cell that a view shows to be empty at its own time is excluded permanently. A cell that only
    views of neighbouring times show to be empty is presumed empty: objects may have moved in
    between, so that occupied cells may grow into it.

    Args:
        grid: Changed in place.
        views: Training views; without alpha nothing is emptied.
        frame: The field's frame.
        exact: Whether the poses are right. If not, no cell is excluded permanently.
    """
    if views.is_opaque:
        return
    size, bins = grid.resolution, grid.time_bins
    covers = _views_of_bins(views.times, bins)
    axis = (torch.arange(size) + 0.5) * (2 / size) - 1
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).flip(-1)
    world = frame.to_world(points.reshape(-1, 3))
    radius = 3**0.5 / size / frame.scale
    allowed = torch.empty(bins, size**3, dtype=torch.bool)
    likely = torch.empty_like(allowed)
    chunk = min(CHUNK, max(1, 512 * CHUNK // len(views)))
    for start in range(0, size**3, chunk):
        part = slice(start, start + chunk)
        alone = may_hold(views, world[part], radius=radius)
        joined = join_in_time(alone, views.times)
        for index, cover in enumerate(covers):
            likely[index, part] = joined[cover].any(dim=0)
            allowed[index, part] = (joined if views.is_static else alone)[cover].any(dim=0)
    if exact:
        grid.allow(allowed)
    grid.presume(likely)


def _views_of_bins(times: Tensor, bins: int) -> list[Tensor]:
    """Views used for each time bin: those inside it and the nearest one on either side."""
    order = times.argsort(stable=True)
    ordered = times[order].contiguous()
    covers = []
    for index in range(bins):
        edges = torch.tensor([index / bins, (index + 1) / bins])
        first, last = torch.searchsorted(ordered, edges).tolist()
        before = ordered[max(first - 1, 0)]
        after = ordered[min(last, len(ordered) - 1)]
        covers.append(order[(ordered >= before) & (ordered <= after)])
    return covers
