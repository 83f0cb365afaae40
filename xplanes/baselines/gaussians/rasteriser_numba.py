"""Compiled loops that project and blend Gaussians on the CPU; `reference` holds the readable twin.

Gaussians are projected in float64 and blended in float32. Tiles are independent, and their
contributions to the gradient of a Gaussian are summed in a fixed order: results are deterministic
and do not depend on the number of threads. This module is imported only when needed, since numba
takes a second to load.
"""

import numpy as np
from numba import prange

from xplanes.backend import njit
from xplanes.baselines.gaussians.reference import (
    LEAST_ALPHA,
    LEAST_QUATERNION,
    LEAST_TRANSMITTANCE,
    LOW_PASS,
    MOST_ALPHA,
)

TILE_WIDTH, TILE_HEIGHT = 16, 32
"""Size of a tile in pixels. A row fills one or more vector registers."""

PIXELS = TILE_WIDTH * TILE_HEIGHT

GROUP = 4
"""Features blended per pass: colour and depth. More features need further passes."""

GEOMETRY = 9
"""Values per Gaussian besides its features: mean, whitening and opacity; the square of its reach in
standard deviations, and its reach along x and y in pixels."""

MOMENTS = 6
"""Sums over pixels from which the gradients of mean, whitening and opacity are computed."""

HALVED = np.sqrt(0.5 / np.log(2.0))
"""Scales an offset in standard deviations so that 2^-(u^2 + v^2) is the Gaussian."""

SLACK = 1.001
"""Factor on the reach of a Gaussian, as a margin for float32 rounding."""

# Planes of a tile's buffer: pixel centres, transmittance for the next Gaussian (0 once blending has
# stopped), final transmittance, the member before which blending stopped, and opacity and features
# or their gradients. They share one array, so that the compiler can rule out aliasing, which would
# prevent vectorisation.
X, Y, LIGHT, LEFT, STOP, OPACITY, F0, F1, F2, F3 = range(10)
BEHIND = LIGHT
PLANES = 10
AT = tuple(np.uint64(plane * PIXELS) for plane in range(PLANES))
"""Offsets of the planes; unsigned, since numba would check for negative indices."""

f32 = np.float32


@njit()
def _view(means, n, camera):
    """Mean in camera coordinates."""
    x, y, z = np.float64(means[n, 0]), np.float64(means[n, 1]), np.float64(means[n, 2])
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[3],
        camera[4] * x + camera[5] * y + camera[6] * z + camera[7],
        camera[8] * x + camera[9] * y + camera[10] * z + camera[11],
    )


@njit()
def _unit(quaternions, n):
    """Normalised quaternion (shorter if its length is near 0), and its divisor."""
    w, x = np.float64(quaternions[n, 0]), np.float64(quaternions[n, 1])
    y, z = np.float64(quaternions[n, 2]), np.float64(quaternions[n, 3])
    length = max(np.sqrt(w * w + x * x + y * y + z * z), LEAST_QUATERNION)
    return w / length, x / length, y / length, z / length, length


@njit()
def _axes(camera, w, x, y, z, axes):
    """The Gaussian's axes in camera coordinates, as columns. [3, 3]"""
    for row in range(3):
        a, b, c = camera[4 * row], camera[4 * row + 1], camera[4 * row + 2]
        axes[row, 0] = (
            a * (1 - 2 * (y * y + z * z)) + b * 2 * (x * y + w * z) + c * 2 * (x * z - w * y)
        )
        axes[row, 1] = (
            a * 2 * (x * y - w * z) + b * (1 - 2 * (x * x + z * z)) + c * 2 * (y * z + w * x)
        )
        axes[row, 2] = (
            a * 2 * (x * z + w * y) + b * 2 * (y * z - w * x) + c * (1 - 2 * (x * x + y * y))
        )


@njit()
def _covariance(root):
    """Entries and determinant of root root^T + LOW_PASS, and the determinant's root without it."""
    cx = root[0, 1] * root[1, 2] - root[0, 2] * root[1, 1]
    cy = root[0, 2] * root[1, 0] - root[0, 0] * root[1, 2]
    cz = root[0, 0] * root[1, 1] - root[0, 1] * root[1, 0]
    area = np.sqrt(cx * cx + cy * cy + cz * cz)
    xx, xy, yy = 0.0, 0.0, 0.0
    for j in range(3):
        xx += root[0, j] * root[0, j]
        xy += root[0, j] * root[1, j]
        yy += root[1, j] * root[1, j]
    determinant = area * area + LOW_PASS * (xx + yy) + LOW_PASS * LOW_PASS
    return xx + LOW_PASS, xy, yy + LOW_PASS, determinant, area, cx, cy, cz


@njit(parallel=True)
def project(
    means,
    quaternions,
    scales,
    opacities,
    camera,
    near,
    far,
    antialiased,
    width,
    height,
    projected,
    whitening,
    depths,
    peaks,
    radii,
):
    """Fill the last five; ``camera`` holds the pose's rows, fx, fy, cx, cy and `slant`. [20]"""
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    for n in prange(len(means)):
        radii[n] = 0
        projected[n, 0], projected[n, 1], depths[n], peaks[n] = 0, 0, 1, 0
        whitening[n, 0], whitening[n, 1], whitening[n, 2] = 1, 0, 1
        x, y, z = _view(means, n, camera)
        if not (near < z < far):
            continue
        axes, root = np.empty((3, 3)), np.empty((2, 3))
        w, i, j, k, _ = _unit(quaternions, n)
        _axes(camera, w, i, j, k, axes)
        slant_x = min(max(x / z, camera[16]), camera[17])
        slant_y = min(max(y / z, camera[18]), camera[19])
        for axis in range(3):
            scale = np.float64(scales[n, axis])
            root[0, axis] = fx / z * (axes[0, axis] - slant_x * axes[2, axis]) * scale
            root[1, axis] = fy / z * (axes[1, axis] - slant_y * axes[2, axis]) * scale
        xx, xy, yy, determinant, area, _, _, _ = _covariance(root)
        first = f32(np.sqrt(yy / determinant))
        shear = f32(-np.sqrt(yy / determinant) * xy / yy)
        last = f32(1 / np.sqrt(yy))
        right, down = f32(fx * x / z + cx), f32(fy * y / z + cy)
        finite = np.isfinite(right) and np.isfinite(down) and np.isfinite(shear)
        if not (finite and first > 0 and last > 0):
            continue
        peak = np.float64(opacities[n])
        if antialiased:
            peak *= area / np.sqrt(determinant)
        projected[n, 0], projected[n, 1], depths[n], peaks[n] = right, down, z, peak
        whitening[n, 0], whitening[n, 1], whitening[n, 2] = first, shear, last
        if peaks[n] < LEAST_ALPHA:
            continue
        reach = np.sqrt(2 * np.log(max(peak / LEAST_ALPHA, 1.0)))
        extent_x, extent_y = reach * np.sqrt(xx), reach * np.sqrt(yy)
        if (
            right + extent_x > 0
            and right - extent_x < width
            and down + extent_y > 0
            and down - extent_y < height
        ):
            half = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
            radii[n] = np.int64(min(np.ceil(3 * np.sqrt(half)), 1e9))


@njit(parallel=True)
def project_backward(
    means,
    quaternions,
    scales,
    opacities,
    camera,
    antialiased,
    radii,
    d_projected,
    d_whitening,
    d_depths,
    d_peaks,
    d_means,
    d_quaternions,
    d_scales,
    d_opacities,
):
    """Gradients of `project`, from those of its outputs."""
    fx, fy = camera[12], camera[13]
    for n in prange(len(means)):
        for axis in range(3):
            d_means[n, axis], d_scales[n, axis] = 0, 0
        for axis in range(4):
            d_quaternions[n, axis] = 0
        d_opacities[n] = 0
        if radii[n] == 0:
            continue
        x, y, z = _view(means, n, camera)
        axes, root, splat = np.empty((3, 3)), np.empty((2, 3)), np.empty((2, 3))
        w, i, j, k, length = _unit(quaternions, n)
        _axes(camera, w, i, j, k, axes)
        slant_x = min(max(x / z, camera[16]), camera[17])
        slant_y = min(max(y / z, camera[18]), camera[19])
        for axis in range(3):
            splat[0, axis] = fx / z * (axes[0, axis] - slant_x * axes[2, axis])
            splat[1, axis] = fy / z * (axes[1, axis] - slant_y * axes[2, axis])
            root[0, axis] = splat[0, axis] * np.float64(scales[n, axis])
            root[1, axis] = splat[1, axis] * np.float64(scales[n, axis])
        xx, xy, yy, determinant, area, cx, cy, cz = _covariance(root)

        # W to the covariance: `spread` is the variance of x given y, `shear` its regression slope.
        spread, shear = determinant / yy, xy / yy
        first = 1 / np.sqrt(spread)
        d_shear = -first * d_whitening[n, 1]
        d_spread = -0.5 * first**3 * (d_whitening[n, 0] - shear * d_whitening[n, 1])
        d_xx = d_spread
        d_xy = d_shear / yy - 2 * shear * d_spread
        d_yy = shear * shear * d_spread - d_shear * shear / yy - 0.5 * d_whitening[n, 2] / yy**1.5
        d_area = 0.0
        d_opacities[n] = d_peaks[n]
        if antialiased:
            compensation = area / np.sqrt(determinant)
            d_opacities[n] = d_peaks[n] * compensation
            d_compensation = d_peaks[n] * np.float64(opacities[n])
            d_area = d_compensation / np.sqrt(determinant)
            d_determinant = -0.5 * d_compensation * compensation / determinant
            d_xx += d_determinant * yy
            d_yy += d_determinant * xx
            d_xy -= 2 * d_determinant * xy
        if area > 0:
            cx, cy, cz = cx / area, cy / area, cz / area

        # Covariance to its root, then to scales, axes and perspective.
        normal = (cx, cy, cz)
        d_axes = np.empty((3, 3))
        d_x, d_y, d_z, d_slant_x, d_slant_y = 0.0, 0.0, np.float64(d_depths[n]), 0.0, 0.0
        for axis in range(3):
            after, before = (axis + 1) % 3, (axis + 2) % 3
            d_first = 2 * d_xx * root[0, axis] + d_xy * root[1, axis]
            d_second = 2 * d_yy * root[1, axis] + d_xy * root[0, axis]
            d_first += d_area * (root[1, after] * normal[before] - root[1, before] * normal[after])
            d_second += d_area * (normal[after] * root[0, before] - normal[before] * root[0, after])
            d_scales[n, axis] = d_first * splat[0, axis] + d_second * splat[1, axis]
            d_first *= np.float64(scales[n, axis])
            d_second *= np.float64(scales[n, axis])
            d_axes[0, axis] = fx / z * d_first
            d_axes[1, axis] = fy / z * d_second
            d_axes[2, axis] = -fx / z * slant_x * d_first - fy / z * slant_y * d_second
            d_slant_x -= fx / z * axes[2, axis] * d_first
            d_slant_y -= fy / z * axes[2, axis] * d_second
            d_z -= (splat[0, axis] * d_first + splat[1, axis] * d_second) / z
        if slant_x == x / z:
            d_x += d_slant_x / z
            d_z -= d_slant_x * x / (z * z)
        if slant_y == y / z:
            d_y += d_slant_y / z
            d_z -= d_slant_y * y / (z * z)
        d_x += fx / z * d_projected[n, 0]
        d_y += fy / z * d_projected[n, 1]
        d_z -= (fx * x * d_projected[n, 0] + fy * y * d_projected[n, 1]) / (z * z)
        for axis in range(3):
            d_means[n, axis] = camera[axis] * d_x + camera[4 + axis] * d_y + camera[8 + axis] * d_z

        # Axes to the quaternion.
        turn = np.empty((3, 3))
        for row in range(3):
            for column in range(3):
                turn[row, column] = (
                    camera[row] * d_axes[0, column]
                    + camera[4 + row] * d_axes[1, column]
                    + camera[8 + row] * d_axes[2, column]
                )
        d_w = 2 * (
            i * (turn[2, 1] - turn[1, 2])
            + j * (turn[0, 2] - turn[2, 0])
            + k * (turn[1, 0] - turn[0, 1])
        )
        d_i = 2 * (
            w * (turn[2, 1] - turn[1, 2])
            + j * (turn[0, 1] + turn[1, 0])
            + k * (turn[0, 2] + turn[2, 0])
            - 2 * i * (turn[1, 1] + turn[2, 2])
        )
        d_j = 2 * (
            w * (turn[0, 2] - turn[2, 0])
            + i * (turn[0, 1] + turn[1, 0])
            + k * (turn[1, 2] + turn[2, 1])
            - 2 * j * (turn[0, 0] + turn[2, 2])
        )
        d_k = 2 * (
            w * (turn[1, 0] - turn[0, 1])
            + i * (turn[0, 2] + turn[2, 0])
            + j * (turn[1, 2] + turn[2, 1])
            - 2 * k * (turn[0, 0] + turn[1, 1])
        )
        along = 0.0
        if length > LEAST_QUATERNION:
            along = w * d_w + i * d_i + j * d_j + k * d_k
        d_quaternions[n, 0] = (d_w - along * w) / length
        d_quaternions[n, 1] = (d_i - along * i) / length
        d_quaternions[n, 2] = (d_j - along * j) / length
        d_quaternions[n, 3] = (d_k - along * k) / length


@njit(exact=True)
def depth_order(depths, radii):
    """Indices of the Gaussians that are drawn, by depth; a stable radix sort. int64 [M]"""
    count = 0
    for n in range(len(depths)):
        count += radii[n] > 0
    bits = depths.view(np.uint32)  # Positive floats sort like their bits.
    keys, order = np.empty(count, np.uint32), np.empty(count, np.int64)
    position = 0
    for n in range(len(depths)):
        if radii[n] > 0:
            keys[position], order[position] = bits[n], n
            position += 1
    next_keys, next_order = np.empty_like(keys), np.empty_like(order)
    for shift in (0, 11, 22):
        starts = np.zeros(2049, np.int64)
        for n in range(count):
            starts[((keys[n] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for digit in range(2048):
            starts[digit + 1] += starts[digit]
        for n in range(count):
            digit = (keys[n] >> np.uint32(shift)) & np.uint32(2047)
            next_keys[starts[digit]], next_order[starts[digit]] = keys[n], order[n]
            starts[digit] += 1
        keys, next_keys = next_keys, keys
        order, next_order = next_order, order
    return order


@njit(parallel=True)
def gather(order, projected, whitening, peaks, features, geometry, gathered):
    """Collect the values for blending, in the order of depth."""
    for m in prange(len(order)):
        n = order[m]
        geometry[m, 0], geometry[m, 1] = projected[n, 0], projected[n, 1]
        for entry in range(3):
            geometry[m, 2 + entry] = HALVED * whitening[n, entry]
        geometry[m, 5] = peaks[n]
        squared = SLACK * np.log2(max(np.float64(peaks[n]) / LEAST_ALPHA, 1.0)) + 1e-6
        deviation_y = 1 / (HALVED * whitening[n, 2])
        deviation_x = np.hypot(1 / HALVED, whitening[n, 1] * deviation_y) / whitening[n, 0]
        geometry[m, 6] = squared
        geometry[m, 7] = np.sqrt(squared) * deviation_x + 1e-3
        geometry[m, 8] = np.sqrt(squared) * deviation_y + 1e-3
        for channel in range(gathered.shape[1]):
            gathered[m, channel] = features[n, channel] if channel < features.shape[1] else f32(0)


@njit(exact=True)
def _span(low, high, size, count):
    """Half-open range of cells with pixel centres between two coordinates."""
    first = np.floor(np.ceil(low - 0.5) / size)
    last = np.floor(np.floor(high - 0.5) / size) + 1
    return np.int64(min(max(first, 0.0), count)), np.int64(min(max(last, 0.0), count))


@njit(exact=True)
def _edge(g, low, high):
    """Largest x of an ellipse between two values of y, relative to its mean."""
    shear = -np.float64(g[3]) / g[2]
    # The ellipse is widest at one y, and narrower towards others.
    widest = shear * g[8] * g[8] / g[7]
    if low <= widest <= high:
        return np.float64(g[7])
    y = low if widest < low else high
    return shear * y + np.sqrt(max(g[6] - (g[4] * y) ** 2, 0.0)) / g[2]


@njit(exact=True)
def _columns(g, row, columns):
    """Range of tiles in one row of tiles that a Gaussian reaches."""
    low = max(row * TILE_HEIGHT + 0.5 - g[1], -g[8])
    high = min((row + 1) * TILE_HEIGHT - 0.5 - g[1], g[8])
    left, right = -_edge(g, -high, -low), _edge(g, low, high)
    return _span(g[0] + left - 1e-3, g[0] + right + 1e-3, TILE_WIDTH, columns)


@njit(exact=True, parallel=True)
def count_tiles(geometry, columns, rows, counts):
    """Number of tiles that each Gaussian reaches."""
    for m in prange(len(geometry)):
        g = geometry[m]
        first, last = _span(g[1] - g[8], g[1] + g[8], TILE_HEIGHT, rows)
        total = 0
        for row in range(first, last):
            left, right = _columns(g, row, columns)
            total += max(right - left, 0)
        counts[m] = total


@njit(exact=True, parallel=True)
def list_tiles(geometry, columns, rows, starts, tiles, owners):
    """List the tiles of each Gaussian, one Gaussian after the other."""
    for m in prange(len(geometry)):
        g = geometry[m]
        first, last = _span(g[1] - g[8], g[1] + g[8], TILE_HEIGHT, rows)
        slot = starts[m]
        for row in range(first, last):
            left, right = _columns(g, row, columns)
            for column in range(left, right):
                tiles[slot], owners[slot] = row * columns + column, m
                slot += 1


@njit(exact=True)
def bin_tiles(tiles, count):
    """Slots by tile, in the order of depth, and offset of each tile's slots. [P], [count + 1]"""
    starts = np.zeros(count + 1, np.int64)
    for tile in tiles:
        starts[tile + 1] += 1
    for tile in range(count):
        starts[tile + 1] += starts[tile]
    position = starts.copy()
    members = np.empty(len(tiles), np.int32)
    for slot in range(len(tiles)):
        members[position[tiles[slot]]] = slot
        position[tiles[slot]] += 1
    return members, starts


@njit(exact=True)
def _power(x):
    """2^x for x <= 0; the polynomial has an error below 2e-9 in [-1/2, 1/2]."""
    x = max(x, f32(-100))
    whole = np.floor(x + f32(0.5))
    part = x - whole
    value = f32(1.5345812e-4)
    value = value * part + f32(1.3399931e-3)
    value = value * part + f32(9.6184890e-3)
    value = value * part + f32(5.5503288e-2)
    value = value * part + f32(2.4022647e-1)
    value = value * part + f32(6.9314721e-1)
    value = value * part + f32(1)
    return value * np.int32((np.int32(whole) + 127) << 23).view(np.float32)


@njit(exact=True)
def _alpha(u, v, peak):
    """Alpha before its limits; the rounding is equal in the forward and backward pass."""
    return peak * _power(-(u * u + v * v))


@njit(exact=True)
def _offset(flat, i, mean_x, mean_y, first, shear, last):
    """Whitened offset of a pixel from a mean, and its offset along y in pixels."""
    y = flat[i + AT[Y]] - mean_y
    return first * (flat[i + AT[X]] - mean_x) + shear * y, last * y, y


@njit(exact=True)
def _rows(geometry, m, top):
    """Range of pixels of the tile's rows that a Gaussian reaches."""
    middle, extent = geometry[m, 1] - top, geometry[m, 8]
    first, last = _span(middle - extent, middle + extent, 1, TILE_HEIGHT)
    return np.uint64(first * TILE_WIDTH), np.uint64(last * TILE_WIDTH)


@njit(exact=True)
def _scattered(step, count):
    """Tile of a step, in an order that balances the load of threads with consecutive steps."""
    stride = np.int64(0.618 * count) + 1
    while True:
        a, b = stride, count
        while b:
            a, b = b, a % b
        if a == 1:
            return (step * stride) % count
        stride += 1


@njit(exact=True)
def _open(buffer, tile, columns):
    """Initialise the buffer of a tile, and return the tile's corner."""
    top, left = tile // columns * TILE_HEIGHT, tile % columns * TILE_WIDTH
    buffer[:] = 0
    buffer[LIGHT], buffer[LEFT], buffer[STOP] = 1, 1, np.inf
    for i in range(PIXELS):
        buffer[X, i] = f32(left + i % TILE_WIDTH) + f32(0.5)
        buffer[Y, i] = f32(top + i // TILE_WIDTH) + f32(0.5)
    return top, left


@njit()
def _blend_one(flat, begin, end, member, geometry, features, m, group):
    mean_x, mean_y, peak = geometry[m, 0], geometry[m, 1], geometry[m, 5]
    first, shear, last = geometry[m, 2], geometry[m, 3], geometry[m, 4]
    f0, f1 = features[m, group], features[m, group + 1]
    f2, f3 = features[m, group + 2], features[m, group + 3]
    for i in range(begin, end):
        u, v, _ = _offset(flat, i, mean_x, mean_y, first, shear, last)
        alpha = min(_alpha(u, v, peak), f32(MOST_ALPHA))
        alpha = alpha if alpha >= f32(LEAST_ALPHA) else f32(0)
        light = flat[i + AT[LIGHT]]
        after = light * (f32(1) - alpha)
        done = after < f32(LEAST_TRANSMITTANCE)
        weight = f32(0) if done else alpha * light
        flat[i + AT[STOP]] = min(flat[i + AT[STOP]], member) if done else flat[i + AT[STOP]]
        flat[i + AT[LEFT]] = flat[i + AT[LEFT]] if done else after
        flat[i + AT[LIGHT]] = f32(0) if done else after
        flat[i + AT[OPACITY]] += weight
        flat[i + AT[F0]] += weight * f0
        flat[i + AT[F1]] += weight * f1
        flat[i + AT[F2]] += weight * f2
        flat[i + AT[F3]] += weight * f3


@njit(parallel=True)
def blend(geometry, features, owners, members, starts, columns, image, opacity, state):
    """Blend features; ``state`` stores final transmittance and STOP for `blend_backward`."""
    height, width, channels = image.shape
    count = len(starts) - 1
    for step in prange(count):
        tile = _scattered(step, count)
        buffer = np.empty((PLANES, PIXELS), f32)
        flat = buffer.reshape(-1)
        for group in range(0, channels, GROUP):
            top, left = _open(buffer, tile, columns)
            for position in range(starts[tile], starts[tile + 1]):
                m = owners[members[position]]
                begin, end = _rows(geometry, m, top)
                member = f32(position - starts[tile])
                _blend_one(flat, begin, end, member, geometry, features, m, group)
                if (position - starts[tile]) % 32 == 31:
                    brightest = f32(0)
                    for i in range(PIXELS):
                        brightest = max(brightest, buffer[LIGHT, i])
                    if brightest == 0:
                        break
            for row in range(min(TILE_HEIGHT, height - top)):
                for column in range(min(TILE_WIDTH, width - left)):
                    i = row * TILE_WIDTH + column
                    for channel in range(GROUP):
                        image[top + row, left + column, group + channel] = buffer[F0 + channel, i]
                    opacity[top + row, left + column] = buffer[OPACITY, i]
        for i in range(PIXELS):
            state[tile, 0, i], state[tile, 1, i] = buffer[LEFT, i], buffer[STOP, i]


# Vectorised sums, whose order is fixed at compile time.
@njit(fastmath={"contract", "reassoc"})
def _blend_one_backward(flat, begin, end, member, geometry, features, m, group, sums):
    """Add to ``sums``: moments of alpha times its gradient, and gradients of features."""
    mean_x, mean_y, peak = geometry[m, 0], geometry[m, 1], geometry[m, 5]
    first, shear, last = geometry[m, 2], geometry[m, 3], geometry[m, 4]
    f0, f1 = features[m, group], features[m, group + 1]
    f2, f3 = features[m, group + 2], features[m, group + 3]
    s, su, suu, suy, sy, syy = f32(0), f32(0), f32(0), f32(0), f32(0), f32(0)
    d0, d1, d2, d3 = f32(0), f32(0), f32(0), f32(0)
    for i in range(begin, end):
        u, v, y = _offset(flat, i, mean_x, mean_y, first, shear, last)
        whole = _alpha(u, v, peak)
        alpha = min(whole, f32(MOST_ALPHA))
        seen = alpha >= f32(LEAST_ALPHA) and member < flat[i + AT[STOP]]
        alpha = alpha if seen else f32(0)
        more = f32(1) / (f32(1) - alpha)
        light = flat[i + AT[LEFT]] * more
        weight = alpha * light
        g0, g1 = flat[i + AT[F0]], flat[i + AT[F1]]
        g2, g3 = flat[i + AT[F2]], flat[i + AT[F3]]
        value = f0 * g0 + f1 * g1 + f2 * g2 + f3 * g3
        # Gain from a higher alpha of this Gaussian, minus the loss of those behind it.
        slope = alpha * (light * value - more * flat[i + AT[BEHIND]])
        slope = slope if whole <= f32(MOST_ALPHA) else f32(0)
        flat[i + AT[LEFT]] = light
        flat[i + AT[BEHIND]] += weight * value
        s += slope
        su += slope * u
        suu += slope * u * u
        suy += slope * u * y
        sy += slope * y
        syy += slope * y * y
        d0 += weight * g0
        d1 += weight * g1
        d2 += weight * g2
        d3 += weight * g3
    sums[0] += s
    sums[1] += su
    sums[2] += suu
    sums[3] += suy
    sums[4] += sy
    sums[5] += syy
    sums[6], sums[7], sums[8], sums[9] = d0, d1, d2, d3


@njit(parallel=True)
def blend_backward(
    geometry, features, owners, members, starts, columns, state, d_image, d_opacity, partial
):
    """Contribution of each tile to the gradients of its Gaussians. [P, MOMENTS + channels]"""
    height, width, channels = d_image.shape
    count = len(starts) - 1
    for step in prange(count):
        tile = _scattered(step, count)
        buffer, sums = np.empty((PLANES, PIXELS), f32), np.empty(MOMENTS + GROUP, f32)
        for position in range(starts[tile], starts[tile + 1]):
            for entry in range(MOMENTS):
                partial[members[position], entry] = 0
        flat = buffer.reshape(-1)
        for group in range(0, channels, GROUP):
            top, left = _open(buffer, tile, columns)
            last = f32(0)
            for i in range(PIXELS):
                buffer[LEFT, i], buffer[STOP, i] = state[tile, 0, i], state[tile, 1, i]
                buffer[BEHIND, i] = 0
                last = max(last, buffer[STOP, i])
            for row in range(min(TILE_HEIGHT, height - top)):
                for column in range(min(TILE_WIDTH, width - left)):
                    i = row * TILE_WIDTH + column
                    for channel in range(GROUP):
                        buffer[F0 + channel, i] = d_image[top + row, left + column, group + channel]
                    if group == 0:
                        # The background's share of the gradient of opacity.
                        left_over = d_opacity[top + row, left + column] * buffer[LEFT, i]
                        buffer[BEHIND, i] = -left_over
            for position in range(starts[tile + 1] - 1, starts[tile] - 1, -1):
                slot = members[position]
                m = owners[slot]
                member = f32(position - starts[tile])
                for entry in range(MOMENTS):
                    sums[entry] = partial[slot, entry]
                for entry in range(GROUP):
                    sums[MOMENTS + entry] = 0
                if member < last:
                    begin, end = _rows(geometry, m, top)
                    _blend_one_backward(
                        flat, begin, end, member, geometry, features, m, group, sums
                    )
                for entry in range(MOMENTS):
                    partial[slot, entry] = sums[entry]
                for entry in range(GROUP):
                    partial[slot, MOMENTS + group + entry] = sums[MOMENTS + entry]


@njit(parallel=True)
def scatter(order, geometry, slots, partial, d_projected, d_whitening, d_peaks, d_features):
    """Sum the gradients over tiles. Those of Gaussians that are not drawn are unchanged."""
    for m in prange(len(order)):
        n = order[m]
        total = np.zeros(partial.shape[1])
        for slot in range(slots[m], slots[m + 1]):
            for entry in range(partial.shape[1]):
                total[entry] += partial[slot, entry]
        s, su, suu, suy, sy, syy = total[0], total[1], total[2], total[3], total[4], total[5]
        # u and v were scaled by HALVED: alpha is 2^-(u^2 + v^2), with `rate` in its derivative.
        rate = 2 * np.log(2.0)
        first, shear, last = geometry[m, 2], geometry[m, 3], geometry[m, 4]
        d_projected[n, 0] = rate * first * su
        d_projected[n, 1] = rate * (shear * su + last * last * sy)
        d_whitening[n, 0] = -rate * HALVED * (suu - shear * suy) / first
        d_whitening[n, 1] = -rate * HALVED * suy
        d_whitening[n, 2] = -rate * HALVED * last * syy
        d_peaks[n] = s / geometry[m, 5]
        for channel in range(d_features.shape[1]):
            d_features[n, channel] = total[MOMENTS + channel]
