"""Triton kernels for reading planes on CUDA; the reference implementation is in `lookup`.

A program handles a block of points and up to 128 channels. The channels of a texel are contiguous,
so that reads are coalesced. Indices, weights and factors stay in registers; the backward pass
interpolates the factors again, which is faster than reading saved ones. Imported only when needed,
since triton takes a while to load.
"""

# ruff: noqa: D103 (the callers in lookup.py document these kernels)

import torch
import triton
import triton.language as tl

WIDE_TILE, NARROW_TILE = 512, 128
"""Points times channels of a program: four numbers per thread if they can be moved as one, else
one. With more, the backward pass runs out of registers."""

WIDEST = 128
"""Maximum number of channels per program; the second axis of the grid covers all channels."""

SIZES = ["count", "size", "timesteps", "width"]
"""Arguments for which triton compiles no variants, so that one trial covers all resolutions."""

OUTSIDE = tl.constexpr(3.0)
"""Coordinate of the points that pad the last block: outside all planes, where weights are zero and
nothing is read or written."""


@triton.jit
def space_taps(value, size):
    """Two neighbouring texels and their weights."""
    position = value * (size * 0.5) + (size * 0.5 - 0.5)
    # A NaN or a huge value must not become an index; it still propagates through the weight.
    safe = tl.where(position > -1, position, -1.0)
    safe = tl.where(safe < size, safe, size)
    floor = tl.floor(safe)
    lower = floor.to(tl.int32)
    fraction = position - floor
    first = tl.where((lower < 0) | (position >= size), 0.0, 1 - fraction)
    second = tl.where((lower + 1 >= size) | (position < -1), 0.0, fraction)
    inside = tl.maximum(tl.minimum(lower, size - 1), 0)
    return inside, tl.minimum(lower + 1, size - 1), first, second


@triton.jit
def time_taps(value, size):
    """Two neighbouring rows and their weights; times outside [0, 1] use the first or last row."""
    position = value * (size - 1)
    safe = tl.where(position > 0, position, 0.0)
    safe = tl.where(safe < size - 1, safe, size - 1)
    lower = tl.maximum(tl.minimum(safe.to(tl.int32), size - 2), 0)
    # A NaN fails the comparisons above, but must appear in the result.
    fraction = tl.where(position == position, safe - lower, position)
    return lower, tl.minimum(lower + 1, size - 1), 1 - fraction, fraction


@triton.jit
def corner(first_row, width, row, column, LINE: tl.constexpr, SIDE: tl.constexpr):
    """Texel and weight of one of the four corners."""
    return (first_row + row[LINE]) * width + column[SIDE], row[2 + LINE] * column[2 + SIDE]


@triton.jit
def reach(texel, weight, channel, CHANNELS: tl.constexpr):
    """Offsets and mask of a texel's channels. [points, channels]"""
    # A plane may have more than 2^31 numbers, though never that many texels.
    offset = texel.to(tl.int64)[:, None] * CHANNELS + channel[None, :]
    return offset, (weight != 0)[:, None] & (channel < CHANNELS)[None, :]


@triton.jit
def read(planes, first_row, width, row, column, channel, CHANNELS: tl.constexpr):
    """Bilinear interpolation in a plane. [points, channels]"""
    value = tl.zeros([row[2].shape[0], channel.shape[0]], row[2].dtype)
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            texel, weight = corner(first_row, width, row, column, i, j)
            offset, mask = reach(texel, weight, channel, CHANNELS)
            found = tl.load(planes + offset, mask=mask, other=0.0)
            value += weight[:, None] * found.to(weight.dtype)
    return value


@triton.jit
def spread(planes, first_row, width, row, column, source, channel, CHANNELS: tl.constexpr):
    """Adds the gradient of `read` to that of the plane."""
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            texel, weight = corner(first_row, width, row, column, i, j)
            offset, mask = reach(texel, weight, channel, CHANNELS)
            tl.atomic_add(planes + offset, weight[:, None] * source, mask=mask, sem="relaxed")


@triton.jit
def coordinates(points, n, count):
    """x, y and z of a block of points."""
    live = n < count
    x = tl.load(points + 3 * n, mask=live, other=OUTSIDE)
    y = tl.load(points + 3 * n + 1, mask=live, other=OUTSIDE)
    z = tl.load(points + 3 * n + 2, mask=live, other=OUTSIDE)
    return x, y, z


@triton.jit
def read_factors(
    time, timesteps, width, line, places, channel, AXES: tl.constexpr, CHANNELS: tl.constexpr
):
    """Interpolated values of all time planes."""
    found = ()
    for plane in tl.static_range(len(AXES)):
        value = read(time, plane * timesteps, width, line, places[AXES[plane]], channel, CHANNELS)
        found = found + (value,)  # noqa: RUF005 (triton unpacks nothing)
    return found


@triton.jit(do_not_specialize=SIZES)
def forward(
    space,
    time,
    points,
    times,
    features,
    count,
    size,
    timesteps,
    width,
    ROWS: tl.constexpr,
    AXES: tl.constexpr,
    CHANNELS: tl.constexpr,
    POINTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    n = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    channel = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    x, y, z = coordinates(points, n, count)
    column, row, depth = space_taps(x, size), space_taps(y, size), space_taps(z, size)
    xy = read(space, 0, size, row, column, channel, CHANNELS)
    xz = read(space, size, size, depth, column, channel, CHANNELS)
    yz = read(space, 2 * size, size, depth, row, channel, CHANNELS)
    if len(AXES) > 0:
        line = time_taps(tl.load(times + n, mask=n < count, other=0.0), timesteps)
        places = space_taps(x, width), space_taps(y, width), space_taps(z, width)
        factor = read_factors(time, timesteps, width, line, places, channel, AXES, CHANNELS)
        xy += factor[ROWS[0][0]] * factor[ROWS[0][1]]
        xz += factor[ROWS[1][0]] * factor[ROWS[1][1]]
        yz += factor[ROWS[2][0]] * factor[ROWS[2][1]]
    offset = n[:, None] * (3 * CHANNELS) + channel[None, :]
    mask = (n < count)[:, None] & (channel < CHANNELS)[None, :]
    tl.store(features + offset, xy, mask=mask)
    tl.store(features + offset + CHANNELS, xz, mask=mask)
    tl.store(features + offset + 2 * CHANNELS, yz, mask=mask)


@triton.jit
def upstream_of(gradient, n, count, channel, ROW: tl.constexpr, CHANNELS: tl.constexpr):
    """Gradient of one of the three features. [points, channels]"""
    offset = n[:, None] * (3 * CHANNELS) + (ROW * CHANNELS + channel[None, :])
    mask = (n < count)[:, None] & (channel < CHANNELS)[None, :]
    return tl.load(gradient + offset, mask=mask, other=0.0)


@triton.jit(do_not_specialize=SIZES)
def backward_by_row(
    time,
    points,
    times,
    gradient,
    space_gradient,
    time_gradient,
    count,
    size,
    timesteps,
    width,
    ROWS: tl.constexpr,
    AXES: tl.constexpr,
    SPACE: tl.constexpr,
    CHANNELS: tl.constexpr,
    POINTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    # Six time planes in one program would not fit the registers. No two rows share a time plane, so
    # that each program handles one row, along the third axis of the grid.
    n = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    channel = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    x, y, z = coordinates(points, n, count)
    line = time_taps(tl.load(times + n, mask=n < count, other=0.0), timesteps)
    for r in tl.static_range(3):
        if tl.program_id(2) == r:
            a, b = (x, y, z)[AXES[ROWS[r][0]]], (x, y, z)[AXES[ROWS[r][1]]]
            source = upstream_of(gradient, n, count, channel, r, CHANNELS)
            if SPACE:
                column, row = space_taps(a, size), space_taps(b, size)
                spread(space_gradient, r * size, size, row, column, source, channel, CHANNELS)
            across, down = space_taps(a, width), space_taps(b, width)
            start, end = ROWS[r][0] * timesteps, ROWS[r][1] * timesteps
            first = read(time, start, width, line, across, channel, CHANNELS)
            second = read(time, end, width, line, down, channel, CHANNELS)
            spread(time_gradient, start, width, line, across, source * second, channel, CHANNELS)
            spread(time_gradient, end, width, line, down, source * first, channel, CHANNELS)


@triton.jit(do_not_specialize=SIZES)
def backward(
    time,
    points,
    times,
    gradient,
    space_gradient,
    time_gradient,
    count,
    size,
    timesteps,
    width,
    ROWS: tl.constexpr,
    AXES: tl.constexpr,
    SPACE: tl.constexpr,
    CHANNELS: tl.constexpr,
    POINTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    n = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    channel = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    x, y, z = coordinates(points, n, count)
    xy = upstream_of(gradient, n, count, channel, 0, CHANNELS)
    xz = upstream_of(gradient, n, count, channel, 1, CHANNELS)
    yz = upstream_of(gradient, n, count, channel, 2, CHANNELS)
    upstream = xy, xz, yz
    if SPACE:
        column, row, depth = space_taps(x, size), space_taps(y, size), space_taps(z, size)
        spread(space_gradient, 0, size, row, column, xy, channel, CHANNELS)
        spread(space_gradient, size, size, depth, column, xz, channel, CHANNELS)
        spread(space_gradient, 2 * size, size, depth, row, yz, channel, CHANNELS)
    if len(AXES) > 0:
        line = time_taps(tl.load(times + n, mask=n < count, other=0.0), timesteps)
        places = space_taps(x, width), space_taps(y, width), space_taps(z, width)
        factor = read_factors(time, timesteps, width, line, places, channel, AXES, CHANNELS)
        for plane in tl.static_range(len(AXES)):
            # A plane that two rows share is written once, with the sum of both gradients.
            source = tl.zeros_like(xy)
            for r in tl.static_range(3):
                if ROWS[r][0] == plane:
                    source += upstream[r] * factor[ROWS[r][1]]
                if ROWS[r][1] == plane:
                    source += upstream[r] * factor[ROWS[r][0]]
            place = places[AXES[plane]]
            first = plane * timesteps
            spread(time_gradient, first, width, line, place, source, channel, CHANNELS)


def tiles(count: int, channels: int) -> tuple[tuple[int, int], dict[str, int]]:
    """Grid and block sizes for a number of points and channels."""
    block = min(triton.next_power_of_2(channels), WIDEST)
    tile = NARROW_TILE if channels % 4 else WIDE_TILE
    points = max(tile // block, 1)
    grid = triton.cdiv(count, points), triton.cdiv(channels, block)
    return grid, {"CHANNELS": channels, "POINTS": points, "BLOCK": block}


def gather(space, time, points, times, rows, axes, features):
    """Launches `forward`; ``features`` [N, 3, C] are written."""
    grid, blocks = tiles(len(points), space.shape[3])
    sizes = (len(points), space.shape[1], *(time.shape[1:3] if axes else (1, 1)))
    # A kernel without time planes still needs a pointer.
    tensors = space, time if axes else space, points, times, features
    with torch.cuda.device_of(space):
        forward[grid](*tensors, *sizes, ROWS=rows, AXES=axes, **blocks)


def scatter(size, time, points, times, rows, axes, gradient, space_gradient, time_gradient):
    """Launches `backward` or `backward_by_row`, which add to the gradients that are not None."""
    grid, blocks = tiles(len(points), gradient.shape[2])
    moving = axes if time_gradient is not None else ()
    by_row = len(moving) == 2 * len(rows)
    sizes = (len(points), size, *(time.shape[1:3] if moving else (1, 1)))
    unused = gradient
    tensors = (
        time if moving else unused,
        points,
        times,
        gradient,
        unused if space_gradient is None else space_gradient,
        time_gradient if moving else unused,
    )
    flags = {"ROWS": rows, "AXES": moving, "SPACE": space_gradient is not None}
    with torch.cuda.device_of(gradient):
        if by_row and moving:
            backward_by_row[*grid, len(rows)](*tensors, *sizes, **flags, **blocks)
        else:
            backward[grid](*tensors, *sizes, **flags, **blocks)
