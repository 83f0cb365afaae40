"""Pruning of the occupancy grid before training: by silhouettes, and by an initialised field."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.rendering.box import Field
from xplanes.rendering.marching import Rays, Samples, march
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.scenes.frame import Frame
from xplanes.scenes.matte import SOLID
from xplanes.scenes.silhouettes import enlarged, join_in_time, may_hold, moving
from xplanes.scenes.views import Views

MOST_KEPT = 0.2
"""Largest share of the cells that are kept because something moves there."""

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
    world, radius = _balls(grid, frame)
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


def keep_moving(grid: OccupancyGrid, views: Views, frame: Frame) -> None:
    """Keep the cells occupied in which all fixed cameras that see them show a change.

    Thin parts that move are learnt late, and their cells seem empty until then.

    Args:
        grid: Changed in place, unless a larger share of its cells than `MOST_KEPT` would be kept:
            then the light changes, or the images are noisy.
        views: Training views; not used if images have silhouettes or are in files, or all views
            show one timestep.
        frame: The field's frame.
    """
    if views.is_stored or views.is_static or not views.is_opaque:
        return
    bins = grid.bins(views.times)
    world, radius = _balls(grid, frame)
    found = moving(views, world, radius=radius, bins=bins, count=grid.time_bins)
    if found is not None and found.float().mean() <= MOST_KEPT:
        grid.keep(found)


def _balls(grid: OccupancyGrid, frame: Frame) -> tuple[Tensor, float]:
    """Centres of the cells in the world, [G^3, 3], and the radius of the balls around them."""
    size = grid.resolution
    axis = (torch.arange(size) + 0.5) * (2 / size) - 1
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).flip(-1)
    return frame.to_world(points.reshape(-1, 3)), 3**0.5 / size / frame.scale


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


RAYS = 65536
"""Rays that are marched together: all pixels of a large image would fill the memory."""


def fill(
    grid: OccupancyGrid,
    field: Field,
    views: Views,
    frame: Frame,
    *,
    step: float,
    generator: torch.Generator,
) -> None:
    """Keep cells where the field has density, or where the images show that density is missing.

    If the ray of a foreground pixel meets no remaining cell, density is missing along this ray, and
    all of its cells are restored. One foreground pixel is tested in each image square, which is at
    most as wide as a cell; all of them are tested where neighbouring squares differ.

    Args:
        grid: Changed in place; empty cells stay empty.
        field: Maps points [N, 3] and times [N] to colour [N, 3] and density [N].
        views: Training views.
        frame: The field's frame.
        step: Distance between samples along rays.
        generator: Source of randomness.
    """
    occupied, density = grid.occupied.clone(), grid.density.clone()
    grid.sweep(field, generator)
    kept = grid.occupied.clone()
    missing = torch.zeros_like(kept)

    def test(index: int, pixels: Tensor) -> Tensor:
        """Whether the rays of pixels [K, 2] meet a remaining cell; marks missing cells. bool [K]"""
        chosen, (rows, columns) = torch.full_like(pixels[:, 0], index), pixels.float().unbind(dim=1)
        rays = frame.rays(*views.pixel_rays(chosen, rows, columns))
        time = views.times[index].to(kept.device)
        found = [torch.zeros(0, dtype=torch.bool)]
        for origins, directions in zip(*(part.split(RAYS) for part in rays), strict=True):
            some, there = origins.to(kept.device), directions.to(kept.device)
            met = torch.zeros(len(some), dtype=torch.bool, device=kept.device)
            met[_samples(grid, some, there, time, step).ray] = True
            grid.occupied.copy_(occupied)
            missing[_samples(grid, some[~met], there[~met], time, step).cells] = True
            grid.occupied.copy_(kept)
            found.append(met.cpu())
        return torch.cat(found)

    for index in range(len(views)):
        solid = views.image(index)[..., 3] >= SOLID
        side = pixels_of_a_cell(views, index, frame, grid.resolution)
        pixels = one_of_each_square(solid, side)
        met = test(index, pixels)
        if side > 1:
            squares = torch.zeros([-(-length // side) for length in solid.shape])
            squares[tuple((pixels // side).T)] = 2 - met.float()
            test(index, (solid & enlarged(differing(squares), side, solid.shape)).nonzero())
    missing &= ~kept
    grid.density[missing] = density[missing]
    grid.occupied |= missing


def pixels_of_a_cell(views: Views, index: int, frame: Frame, resolution: int) -> int:
    """Pixels along the side of a grid cell in image ``index``, for the smallest projected cell."""
    away = (views.camera_to_world[index, :3, 3].double() - frame.centre.double()).norm()
    corner = float(away) + math.sqrt(3) / frame.scale  # Distance of the cube's farthest corner.
    focal = float(views.intrinsics.focal[index].min())
    return max(1, int(focal * 2 / resolution / frame.scale / corner))


def one_of_each_square(mask: Tensor, side: int) -> Tensor:
    """One pixel of the mask in each square that contains any.

    Args:
        mask: Pixels to choose from. bool [H, W]
        side: Pixels along a square's side.

    Returns:
        Rows and columns. int64 [K, 2]
    """
    height, width = mask.shape
    padded = F.pad(mask, (0, -width % side, 0, -height % side))
    squares = padded.unflatten(1, (-1, side)).unflatten(0, (-1, side)).transpose(1, 2).flatten(2)
    found, place = squares.byte().max(dim=2)
    square = found.nonzero()
    place = place[tuple(square.T)]
    return side * square + torch.stack([place // side, place % side], dim=1)


def differing(values: Tensor) -> Tensor:
    """Pixels that are above 0 and differ from one of their neighbours. bool [H, W]"""
    most, least = (F.max_pool2d(sign * values[None], 3, 1, 1)[0] * sign for sign in (1, -1))
    return (values > 0) & (most != least)


def _samples(
    grid: OccupancyGrid, origins: Tensor, directions: Tensor, time: Tensor, step: float
) -> Samples:
    times = time.expand(len(origins))
    rays = Rays(origins, directions, times, torch.full_like(times, 0.5))
    return march(rays, grid, step=step)
