"""The occupancy grid of a field that already shows something."""

import torch
from torch import Tensor

from xplanes.rendering.box import Field
from xplanes.rendering.marching import Samples, march
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views

SOLID = 128
"""Alpha from which a pixel must show something."""

RAYS = 65536
"""Rays that march together: all pixels of a large picture would fill the memory."""


def fill(
    grid: OccupancyGrid,
    field: Field,
    views: Views,
    frame: Frame,
    *,
    step: float,
    generator: torch.Generator,
) -> None:
    """Keep the cells in which a field shows something, and those that must hold what it misses.

    A foreground pixel whose ray meets no cell that is left shows that something is missing: the
    cells along that ray stay as they were.

    Args:
        grid: Changed in place; cells that are empty already stay so.
        field: From points [N, 3] and times [N] to colour [N, 3] and density [N].
        views: Training views.
        frame: The field's frame.
        step: Distance between samples along rays.
        generator: Source of randomness.
    """
    occupied, density = grid.occupied.clone(), grid.density.clone()
    grid.sweep(field, generator)
    kept = grid.occupied.clone()
    missing = torch.zeros_like(kept)
    for index in range(len(views)):
        solid = (views.image(index)[..., 3] >= SOLID).flatten()
        origins, directions = (ray[solid] for ray in views.image_rays(index))
        origins, directions = frame.rays(origins, directions)
        origins, directions = origins.to(kept.device), directions.to(kept.device)
        time = views.times[index].to(kept.device)
        for some, there in zip(origins.split(RAYS), directions.split(RAYS), strict=True):
            met = torch.zeros(len(some), dtype=torch.bool, device=kept.device)
            met[_samples(grid, some, there, time, step).ray] = True
            grid.occupied.copy_(occupied)
            missing[_samples(grid, some[~met], there[~met], time, step).cells] = True
            grid.occupied.copy_(kept)
    missing &= ~kept
    grid.density[missing] = density[missing]
    grid.occupied |= missing


def _samples(
    grid: OccupancyGrid, origins: Tensor, directions: Tensor, time: Tensor, step: float
) -> Samples:
    times = time.expand(len(origins))
    return march(origins, directions, times, torch.full_like(times, 0.5), grid, step=step)
