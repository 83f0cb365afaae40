"""Compiled loops over planes on the CPU; the references are in `lookup` and `regularisers`.

Indices and weights stay in registers: only planes, points and results are in memory. Imported only
when needed, since numba takes a second to load.
"""

# ruff: noqa: D103 (the callers document these loops)

import numpy as np
from numba import get_num_threads, prange

from xplanes.backend import njit


def tasks_a_plane(planes):
    """Tasks per plane, which share its rows: a power of 2 that gives every thread a task."""
    return 1 << ((get_num_threads() - 1) // planes).bit_length()


@njit(forceinline=True)
def space_taps(value, size):
    half = type(value)(0.5)
    position = value * type(value)(size) * half + (type(value)(size) * half - half)
    # A NaN or a huge value must not become an index; it still propagates through the weight.
    safe = position if position > -1 else type(value)(-1)
    safe = safe if safe < size else type(value)(size)
    floor = np.floor(safe)
    lower = np.int64(floor)
    fraction = position - floor
    first, second = type(value)(1) - fraction, fraction
    if lower < 0 or position >= size:
        first = type(value)(0)
    if lower + 1 > size - 1 or position < -1:
        second = type(value)(0)
    return max(min(lower, size - 1), 0), min(lower + 1, size - 1), first, second


@njit(forceinline=True)
def time_taps(value, size):
    position = value * type(value)(size - 1)
    safe = position if position > 0 else type(value)(0)
    safe = safe if safe < size - 1 else type(value)(size - 1)
    lower = max(min(np.int64(safe), size - 2), 0)
    # A NaN fails the comparisons above, but must appear in the result.
    fraction = safe - type(value)(lower) if position == position else position
    return lower, min(lower + 1, size - 1), type(value)(1) - fraction, fraction


@njit(forceinline=True)
def add(target, source, weight):
    for c in range(len(target)):
        target[c] += weight * source[c]


@njit(parallel=True)
def gather(space, time, points, times, rows, axes, features, factors):
    channels = space.shape[3]
    for n in prange(points.shape[0]):
        for plane in range(3):
            c0, c1, u0, u1 = space_taps(points[n, 0 if plane < 2 else 1], space.shape[2])
            r0, r1, v0, v1 = space_taps(points[n, 1 if plane < 1 else 2], space.shape[1])
            w00, w01, w10, w11 = v0 * u0, v0 * u1, v1 * u0, v1 * u1
            for c in range(channels):
                features[n, plane, c] = (
                    w00 * space[plane, r0, c0, c]
                    + w01 * space[plane, r0, c1, c]
                    + w10 * space[plane, r1, c0, c]
                    + w11 * space[plane, r1, c1, c]
                )
        if time.shape[0] == 0:
            continue
        r0, r1, v0, v1 = time_taps(times[n], time.shape[1])
        for plane in range(time.shape[0]):
            c0, c1, u0, u1 = space_taps(points[n, axes[plane]], time.shape[2])
            w00, w01, w10, w11 = v0 * u0, v0 * u1, v1 * u0, v1 * u1
            for c in range(channels):
                factors[n, plane, c] = (
                    w00 * time[plane, r0, c0, c]
                    + w01 * time[plane, r0, c1, c]
                    + w10 * time[plane, r1, c0, c]
                    + w11 * time[plane, r1, c1, c]
                )
        for row in range(3):
            a, b = rows[row, 0], rows[row, 1]
            for c in range(channels):
                features[n, row, c] += factors[n, a, c] * factors[n, b, c]


@njit(parallel=True)
def gather_onto(space, points, features):
    for n in prange(points.shape[0]):
        for plane in range(3):
            c0, c1, u0, u1 = space_taps(points[n, 0 if plane < 2 else 1], space.shape[2])
            r0, r1, v0, v1 = space_taps(points[n, 1 if plane < 1 else 2], space.shape[1])
            w00, w01, w10, w11 = v0 * u0, v0 * u1, v1 * u0, v1 * u1
            for c in range(space.shape[3]):
                features[n, plane, c] += (
                    w00 * space[plane, r0, c0, c]
                    + w01 * space[plane, r0, c1, c]
                    + w10 * space[plane, r1, c0, c]
                    + w11 * space[plane, r1, c1, c]
                )


def scatter_space(points, gradient, tasks, space):
    """Each task owns every n-th row of a plane, so that no two tasks write to the same texel.

    Each row adds the points in order, so that sums do not depend on the number of tasks.
    """
    if tasks == 1:  # Without the test for a row's owner, this is 10% faster.
        scatter_planes(points, gradient, space)
    else:
        scatter_rows(points, gradient, tasks, space)


@njit(parallel=True)
def scatter_planes(points, gradient, space):
    for plane in prange(3):
        for n in range(points.shape[0]):
            c0, c1, u0, u1 = space_taps(points[n, 0 if plane < 2 else 1], space.shape[2])
            r0, r1, v0, v1 = space_taps(points[n, 1 if plane < 1 else 2], space.shape[1])
            for r, v in ((r0, v0), (r1, v1)):
                for c, u in ((c0, u0), (c1, u1)):
                    add(space[plane, r, c], gradient[n, plane], v * u)


@njit(parallel=True)
def scatter_rows(points, gradient, tasks, space):
    for task in prange(3 * tasks):
        plane, own = task // tasks, task % tasks
        for n in range(points.shape[0]):
            c0, c1, u0, u1 = space_taps(points[n, 0 if plane < 2 else 1], space.shape[2])
            r0, r1, v0, v1 = space_taps(points[n, 1 if plane < 1 else 2], space.shape[1])
            for r, v in ((r0, v0), (r1, v1)):
                if r & (tasks - 1) == own:
                    for c, u in ((c0, u0), (c1, u1)):
                        add(space[plane, r, c], gradient[n, plane], v * u)


@njit(parallel=True)
def product_gradients(rows, gradient, factors, spread):
    for n in prange(gradient.shape[0]):
        spread[n] = 0
        for row in range(3):
            a, b = rows[row, 0], rows[row, 1]
            for c in range(gradient.shape[2]):
                spread[n, a, c] += gradient[n, row, c] * factors[n, b, c]
                spread[n, b, c] += gradient[n, row, c] * factors[n, a, c]


@njit(parallel=True)
def scatter_time(points, times, axes, gradient, tasks, time):
    """As `scatter_space`, for time planes."""
    for task in prange(time.shape[0] * tasks):
        plane, own = task // tasks, task % tasks
        for n in range(points.shape[0]):
            r0, r1, v0, v1 = time_taps(times[n], time.shape[1])
            c0, c1, u0, u1 = space_taps(points[n, axes[plane]], time.shape[2])
            for r, v in ((r0, v0), (r1, v1)):
                if r & (tasks - 1) == own:
                    for c, u in ((c0, u0), (c1, u1)):
                        add(time[plane, r, c], gradient[n, plane], v * u)


@njit(forceinline=True)
def add_differences(target, values, others, factor):
    for n in range(len(target)):
        target[n] += factor * (values[n] - others[n])


@njit(parallel=True)
def add_variation(planes, steps, rows, columns, gradient):
    """Add differences from neighbouring texels, times the factors ``rows`` and ``columns``.

    Texels of a row and their channels form one axis, on which neighbours are ``steps`` apart.
    """
    height = planes.shape[1]
    for task in prange(planes.shape[0] * height):
        number, row = task // height, task % height
        here, target = planes[number, row], gradient[number, row]
        if columns:
            add_differences(target[steps:], here[steps:], here[:-steps], columns)
            add_differences(target[:-steps], here[:-steps], here[steps:], columns)
        if rows and row > 0:
            add_differences(target, here, planes[number, row - 1], rows)
        if rows and row < height - 1:
            add_differences(target, here, planes[number, row + 1], rows)
