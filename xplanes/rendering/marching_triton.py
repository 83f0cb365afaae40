"""Triton kernels that place samples along rays on CUDA; the reference is in `marching`.

A program handles one ray, a block of positions at a time: first to count its samples, and again to
write them once the offsets of all rays are known. Both passes get the same numbers, since
fused multiply-add is disabled. Imported only when needed, since triton takes a while to load.
"""

import torch
import triton
import triton.language as tl

BLOCK = 64
"""Positions per block of a program: two per thread."""


@triton.jit
def within(value, size):
    """Index of the cell of a position, clamped to the grid; 0 for a NaN. int32"""
    value = tl.where(value > 0, value, 0.0)
    return tl.where(value < size - 1, value, size - 1.0).to(tl.int32)


@triton.jit
def slab(origin, direction):
    """Distances at which a ray enters and leaves -1 <= x <= 1."""
    inverse = 1.0 / direction
    first, second = (-1.0 - origin) * inverse, (1.0 - origin) * inverse
    low, high = tl.minimum(first, second), tl.maximum(first, second)
    # A ray within a face is inside this slab.
    unknown = (first != first) | (second != second)
    return tl.where(unknown, float("-inf"), low), tl.where(unknown, float("inf"), high)


@triton.jit
def load(vectors, ray):
    """The three numbers of a ray."""
    return (
        tl.load(vectors + 3 * ray),
        tl.load(vectors + 3 * ray + 1),
        tl.load(vectors + 3 * ray + 2),
    )


@triton.jit
def ray_box(origin, direction):
    """Distances at which a ray enters and leaves the cube; both are 0 if it misses."""
    x0, x1 = slab(origin[0], direction[0])
    y0, y1 = slab(origin[1], direction[1])
    z0, z1 = slab(origin[2], direction[2])
    near = tl.maximum(tl.maximum(tl.maximum(x0, y0), z0), 0.0)
    far = tl.minimum(tl.minimum(x1, y1), z1)
    whole = origin[0] + origin[1] + origin[2] + direction[0] + direction[1] + direction[2]
    hit = (far > near) & (tl.abs(far + whole) < float("inf"))
    return tl.where(hit, near, 0.0), tl.where(hit, far, 0.0)


@triton.jit
def index_of(origin, direction, distance, size):
    """Index of the cells of positions on a ray, along one axis."""
    return within((origin + distance * direction + 1) * (0.5 * size), size)


@triton.jit
def cells_of(origin, direction, distance, time_bin, inside, occupied, size, SKIP: tl.constexpr):
    """Cells of a block of positions on a ray, and whether samples are placed there."""
    x = index_of(origin[0], direction[0], distance, size)
    y = index_of(origin[1], direction[1], distance, size)
    z = index_of(origin[2], direction[2], distance, size)
    cell = ((time_bin * size + z) * size + y) * size + x
    wanted = inside
    if SKIP:
        wanted = wanted & (tl.load(occupied + cell, mask=wanted, other=0) != 0)
    return cell, wanted


@triton.jit
def not_hidden(least, cell, wanted, step, limit, depth, opaque, LIMITED: tl.constexpr):
    """Which samples of a block are not occluded, and the optical depth behind the block."""
    if LIMITED:
        depths = tl.load(least + cell, mask=wanted, other=0.0).to(tl.float64) * step
        depths = tl.where(depths < opaque, depths, opaque)
        depths = tl.where(wanted, depths, 0.0)
        before = depth + tl.cumsum(depths, 0) - depths
        kept = wanted & (before < limit)
        depth += tl.sum(depths, 0)
    else:
        kept = wanted
    return kept, depth


@triton.jit(do_not_specialize=["rays", "size", "bins", "room"])
def march(
    origins,
    directions,
    times,
    jitter,
    occupied,
    least,
    step,
    limit,
    counts,
    starts,
    ray_of,
    distances,
    cells,
    points,
    rays,
    size,
    bins,
    opaque,
    room,
    SKIP: tl.constexpr,
    LIMITED: tl.constexpr,
    FILL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Counts samples, or writes them if FILL; ``counts`` is [3, rays]."""
    ray = tl.program_id(0)
    origin, direction = load(origins, ray), load(directions, ray)
    near, far = ray_box(origin, direction)
    exact_step, limit = tl.load(step), tl.load(limit)
    spacing = exact_step.to(near.dtype)
    shift = tl.load(jitter + ray)
    time_bin = within(tl.load(times + ray) * bins, bins)
    candidates, found, kept = 0, 0, 0
    depth = tl.zeros([], tl.float64)
    place = tl.zeros([], tl.int64)
    last = tl.zeros([], tl.int64)
    if FILL:
        place = tl.load(starts + ray)
        last = tl.minimum(place + tl.load(counts + 2 * rays + ray), room)
    first = 0
    ahead = near + shift * spacing < far
    while ahead:
        n = first + tl.arange(0, BLOCK)
        distance = near + (n.to(near.dtype) + shift) * spacing
        inside = distance < far
        cell, wanted = cells_of(origin, direction, distance, time_bin, inside, occupied, size, SKIP)
        shown, depth = not_hidden(least, cell, wanted, exact_step, limit, depth, opaque, LIMITED)
        number = shown.to(tl.int32)
        if FILL:
            slot = place + tl.cumsum(number, 0) - 1
            here = shown & (slot < last)
            tl.store(ray_of + slot, tl.zeros_like(slot) + ray, mask=here)
            tl.store(distances + slot, distance, mask=here)
            tl.store(cells + slot, cell, mask=here)
            for axis in tl.static_range(3):
                point = origin[axis] + distance * direction[axis]
                tl.store(points + 3 * slot + axis, point, mask=here)
            place += tl.sum(number, 0)
            ahead = place < last
        else:
            candidates += tl.sum(inside.to(tl.int32), 0)
            found += tl.sum(wanted.to(tl.int32), 0)
            kept += tl.sum(number, 0)
            ahead = True
        first += BLOCK
        ahead = ahead & (near + (first + shift) * spacing < far)
    if not FILL:
        tl.store(counts + ray, candidates)
        tl.store(counts + rays + ray, found)
        tl.store(counts + 2 * rays + ray, kept)


def launch(rays, grid, spacing, counts, room, found=None):
    """Launches `march`: to count samples, or with ``found`` to write them.

    Args:
        rays: Origins, directions, times and jitter.
        grid: Occupied cells (None: all), least densities, resolution and time bins.
        spacing: Distance between positions and largest optical depth in front, float64 [] each.
        counts: Numbers of positions in the cube, in occupied cells, and unoccluded. int64 [3, R]
        room: Number of slots.
        found: Starts [R], and the outputs: ray, distances, cells, points [N, ...].
    """
    number = len(rays[0])
    occupied, least, size, bins, opaque, limited = grid
    unused = counts
    given = (*rays, unused if occupied is None else occupied, least, *spacing, counts)
    written = [unused] * 5 if found is None else found
    flags = {"SKIP": occupied is not None, "LIMITED": limited}
    if number:
        with torch.cuda.device_of(counts):
            march[(number,)](
                *given,
                *written,
                number,
                size,
                bins,
                opaque,
                room,
                **flags,
                FILL=found is not None,
                BLOCK=BLOCK,
                num_warps=1,
                enable_fp_fusion=False,
            )
