"""Placement of samples along rays in occupied cells."""

import functools
import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from xplanes.backend import compiled, cpu_loops, gpu_kernels, proven, waves
from xplanes.rendering.box import ray_box
from xplanes.rendering.compositing import OPAQUE
from xplanes.rendering.occupancy import OccupancyGrid

OUTSIDE = 3.0
"""Coordinate of unused slots, outside the planes: nothing is read or added there."""

TRIAL_STEP = 0.07
"""Distance between samples in the kernel's trial."""


class Rays(NamedTuple):
    """Rays through the cube of a field.

    Attributes:
        origins: Ray origins in the field's frame. [R, 3]
        directions: Unit directions. [R, 3]
        times: Time of each ray, from 0 to 1. [R]
        jitter: Offset of each ray's samples within their steps, from 0 to 1. [R]
    """

    origins: Tensor
    directions: Tensor
    times: Tensor
    jitter: Tensor


@dataclass(frozen=True)
class Samples:
    """Samples that reach the field; those of a ray are contiguous, from front to back.

    Attributes:
        ray: Ray of each sample, ascending. [N]
        starts: Index of each ray's first sample. [R]
        points: Positions in the field's frame. [N, 3]
        distances: Distance from the ray's origin. [N]
        cells: Cell of the occupancy grid. [N]
        candidates: Number of samples in the box before any were dropped.
        empty: Samples dropped because their cell is empty.
        occluded: Samples dropped because an opaque surface lies in front.
        live: Whether each slot holds a sample; None unless the number of slots is fixed. [N]
        number: Number of slots that hold a sample; None if ``live`` is. []
        shown: Whether each ray's samples fit the slots; None if ``live`` is. bool [R]

    If the number of slots is fixed, the counts are tensors. Unused slots come last, with points
    outside the cube.
    """

    ray: Tensor
    starts: Tensor
    points: Tensor
    distances: Tensor
    cells: Tensor
    candidates: int | Tensor
    empty: int | Tensor
    occluded: int | Tensor
    live: Tensor | None = None
    number: Tensor | None = None
    shown: Tensor | None = None

    def __len__(self) -> int:
        return len(self.ray)

    @property
    def count(self) -> int | Tensor:
        """Number of samples; a tensor if it is not known on the host."""
        return len(self.ray) if self.number is None else self.number


def march(
    rays: Rays,
    grid: OccupancyGrid,
    *,
    step: float,
    skip_empty: bool = True,
    occlusion: float = 0.0,
    room: int | None = None,
) -> Samples:
    """Place samples at equal steps through the cube [-1, 1]^3 and keep the useful ones.

    Args:
        rays: The rays.
        grid: The occupancy grid.
        step: Distance between samples.
        skip_empty: Whether samples in empty cells are dropped.
        occlusion: Samples are dropped where the transmittance, by the grid's least densities, is
            below this; 0 keeps all.
        room: Fixed number of slots for samples on devices other than the CPU, so that the host need
            not wait for their number. Rays that do not fit are left out, with all later ones. None
            allocates as many as needed.

    Returns:
        The samples that remain.
    """
    limit = -math.log(occlusion) if occlusion > 0 else math.inf
    origins = rays.origins
    occupied = grid.occupied if skip_empty else None
    if cpu_loops(origins):
        return _march_cpu(rays, grid, step=step, occupied=occupied, limit=limit)
    if gpu_kernels(origins) and _kernels_hold(origins.device, origins.dtype):
        return march_gpu(rays, grid, step=step, occupied=occupied, limit=limit, room=room)
    if origins.device.type == "cpu":
        room = None
    return march_reference(rays, grid, step=step, occupied=occupied, limit=limit, room=room)


def march_reference(
    rays: Rays,
    grid: OccupancyGrid,
    *,
    step: float,
    occupied: Tensor | None,
    limit: float,
    room: int | None = None,
) -> Samples:
    """Reference implementation of `march`, in whole-tensor operations.

    With a fixed number of slots, nothing waits for the device: each slot finds its sample by a
    binary search in the cumulative number of samples.
    """
    origins, directions, times, jitter = rays
    near, far = ray_box(origins, directions)
    count, steps = len(near), math.ceil(2 * math.sqrt(3) / step) + 1
    if room is None and count:
        steps = int(((far - near).max() / step).ceil()) + 1
    offset = torch.arange(steps, device=near.device, dtype=near.dtype) + jitter[:, None]
    distances = near[:, None] + offset * step
    half = 0.5 * grid.resolution
    cells = grid.bins(times)[:, None]
    for axis in (2, 1, 0):
        place = distances * directions[:, axis, None]
        place = place.add_(origins[:, axis, None]).add_(1).mul_(half)
        cells = cells * grid.resolution + place.long().clamp_(0, grid.resolution - 1)
    inside = distances < far[:, None]
    met = inside if occupied is None else inside & occupied[cells]
    kept = met
    if math.isfinite(limit):
        depth = grid.least[cells].double().mul_(step).clamp_max_(OPAQUE).mul_(met)
        kept = met & (depth.cumsum(1).sub_(depth) < limit)
    numbers, live, total, shown = kept.sum(dim=1), None, None, None
    candidates, found = inside.sum(), met.sum()
    if room is None:
        starts = numbers.cumsum(0) - numbers
        candidates, found, left = torch.stack([candidates, found, numbers.sum()]).tolist()
        place = kept.flatten().nonzero()[:, 0]
    else:
        running = kept.flatten().cumsum(0)
        ends = running.view(count, steps)[:, -1]
        left, shown = running[-1], ends <= room
        total = (ends * shown).amax()
        slot = torch.arange(room, device=near.device)
        starts, live = torch.minimum(ends - numbers, total), slot < total
        place = torch.searchsorted(running, slot + 1).clamp_max_(count * steps - 1)
    ray = torch.div(place, steps, rounding_mode="floor")
    distances = distances.flatten()[place]
    points = torch.addcmul(origins[ray], directions[ray], distances[:, None])
    if live is not None:
        ray, distances = torch.where(live, ray, count - 1), torch.where(live, distances, 0)
        points = torch.where(live[:, None], points, OUTSIDE)
    return Samples(
        ray=ray,
        starts=starts,
        points=points,
        distances=distances,
        cells=cells.flatten()[place],
        candidates=candidates,
        empty=candidates - found,
        occluded=found - left,
        live=live,
        number=total,
        shown=shown,
    )


def march_gpu(
    rays: Rays,
    grid: OccupancyGrid,
    *,
    step: float,
    occupied: Tensor | None,
    limit: float,
    room: int | None,
) -> Samples:
    """`march_reference` as a Triton kernel.

    The kernel runs twice: to count the samples of each ray, and to write them.
    """
    gpu = importlib.import_module("xplanes.rendering.marching_triton")
    origins = rays.origins
    count, device = len(origins), origins.device
    given = [tensor.contiguous() for tensor in rays]
    limited = math.isfinite(limit)
    cells_of = (occupied, grid.least, grid.resolution, grid.time_bins, OPAQUE, limited)
    spacing = [torch.full((), n, dtype=torch.float64, device=device) for n in (step, limit)]
    counts = torch.zeros(3, count, dtype=torch.int64, device=device)
    gpu.launch(given, cells_of, spacing, counts, 0)
    ends = counts[2].cumsum(0)
    tally = counts.sum(dim=1)
    if room is None:
        candidates, found, places = tally.tolist()
        starts, live, total, shown = ends - counts[2], None, None, None
    else:
        places, shown = room, ends <= room
        total = (ends * shown).amax() if count else ends.sum()
        starts, live = torch.minimum(ends - counts[2], total), torch.arange(room, device=device)
        live = live < total
        candidates, found, _ = tally
    ray = torch.full((places,), max(count - 1, 0), dtype=torch.int64, device=device)
    distances, points = origins.new_zeros(places), origins.new_full((places, 3), OUTSIDE)
    cells = torch.zeros(places, dtype=torch.int64, device=device)
    kept = counts if shown is None else counts * shown
    gpu.launch(given, cells_of, spacing, kept, places, (starts, ray, distances, cells, points))
    return Samples(
        ray=ray,
        starts=starts,
        points=points,
        distances=distances,
        cells=cells,
        candidates=candidates,
        empty=candidates - found,
        occluded=found - tally[2] if room is not None else found - places,
        live=live,
        number=total,
        shown=shown,
    )


@functools.cache
def _kernels_hold(device: torch.device, dtype: torch.dtype) -> bool:
    """Whether the kernel passes its trial on rays that enter, start inside and miss the cube."""

    def attempt(function: Callable[..., Samples], precision: torch.dtype) -> list[Tensor]:
        grid = OccupancyGrid(6, 3, step=TRIAL_STEP).to(device)
        grid.least.copy_(20 * waves(device, len(grid.least)).abs())
        origins = 2 * waves(device, 50, 3)
        ahead = 0.9 * waves(device, 57, 3)[7:] - origins
        directions = torch.nn.functional.normalize(ahead, dim=-1)
        times, jitter = (numbers.clone() for numbers in waves(device, 2, 50).abs())
        rays = Rays(*(t.to(precision) for t in (origins, directions, times, jitter)))
        occupied = waves(device, len(grid.least)) > 0
        found = function(rays, grid, step=TRIAL_STEP, occupied=occupied, limit=3.0, room=400)
        assert found.live is not None
        here = found.live
        numbers = [found.candidates, found.empty, found.occluded, found.count]
        return [
            *(torch.as_tensor(n, dtype=precision, device=device) for n in numbers),
            found.starts.to(precision),
            *(t[here].to(precision) for t in (found.ray, found.distances, found.cells)),
            found.points[here],
        ]

    return proven(f"marching ({dtype})", device, attempt, march_gpu, march_reference, dtype)


def _march_cpu(
    rays: Rays, grid: OccupancyGrid, *, step: float, occupied: Tensor | None, limit: float
) -> Samples:
    cpu = compiled("xplanes.rendering.rays_numba")
    near, far = ray_box(rays.origins, rays.directions)
    half = 0.5 * grid.resolution
    origins, directions = rays.origins.contiguous(), rays.directions.contiguous()
    field_rays = (origins.numpy(), directions.numpy())
    grid_rays = ((origins + 1) * half, directions * half, grid.bins(rays.times), near, rays.jitter)
    grid_rays = tuple(t.contiguous().numpy() for t in grid_rays)
    wanted = (grid.occupied if occupied is None else occupied).numpy()
    chosen = (wanted, grid.resolution, occupied is not None)
    counts = torch.empty(3, len(near), dtype=torch.int64)
    least = grid.least.numpy()
    cpu.count_samples(grid_rays, step, chosen, far.numpy(), least, limit, counts.numpy())
    candidates, found, kept = counts.sum(dim=1).tolist()
    starts = counts[2].cumsum(0) - counts[2]
    ray, cells = torch.empty(2, kept, dtype=torch.int64)
    distances, points = origins.new_empty(kept), origins.new_empty(kept, 3)
    places = (starts, counts[2], ray, distances, cells, points)
    cpu.fill_samples(field_rays, grid_rays, step, chosen, tuple(t.numpy() for t in places))
    return Samples(
        ray, starts, points, distances, cells, candidates, candidates - found, found - kept
    )
