"""Compiled loops over rays on the CPU; the references are in `marching` and `compositing`.

Imported only when needed, since numba takes a second to load.
"""

# ruff: noqa: D103 (the callers document these loops)

import numpy as np
from numba import prange

from xplanes.backend import njit


@njit(exact=True, forceinline=True)
def cell(place, size):
    return min(max(np.int64(place), 0), size - 1)


@njit(exact=True, forceinline=True)
def cell_to_sample(r, distance, start, slope, bins, occupied, size, skip):
    """Index of the cell of ray r at a distance; -1 if no sample is placed there."""
    x = cell(start[r, 0] + distance * slope[r, 0], size)
    y = cell(start[r, 1] + distance * slope[r, 1], size)
    z = cell(start[r, 2] + distance * slope[r, 2], size)
    index = ((bins[r] * size + z) * size + y) * size + x
    if skip and not occupied[index]:
        index = -1
    return index


@njit(exact=True, parallel=True)
def count_samples(grid_rays, step, chosen, far, least, limit, counts):
    """Numbers of candidates, samples in occupied cells, and unoccluded samples of each ray.

    ``grid_rays``: origin and direction of each ray in units of cells [R, 3], its time bin, entry
    distance and jitter [R]. ``chosen``: which cells are occupied, their number along a side, and
    whether empty ones are skipped.
    """
    start, slope, bins, near, jitter = grid_rays
    occupied, size, skip = chosen
    for r in prange(len(near)):
        candidates, found, visible = 0, 0, 0
        depth = 0.0
        distance = near[r] + jitter[r] * step
        while distance < far[r]:
            candidates += 1
            index = cell_to_sample(r, distance, start, slope, bins, occupied, size, skip)
            if index >= 0:
                found += 1
                if depth < limit:
                    visible += 1
                    depth += least[index] * step
            distance = near[r] + (candidates + jitter[r]) * step
        counts[0, r], counts[1, r], counts[2, r] = candidates, found, visible


@njit(exact=True, parallel=True)
def fill_samples(field_rays, grid_rays, step, chosen, places):
    """Place the samples that were counted; ``grid_rays`` and ``chosen`` as in `count_samples`."""
    origins, directions = field_rays
    start, slope, bins, near, jitter = grid_rays
    occupied, size, skip = chosen
    starts, counts, ray, distances, cells, points = places
    for r in prange(len(near)):
        place = starts[r]
        end = place + counts[r]
        candidate = 0
        while place < end:
            distance = near[r] + (candidate + jitter[r]) * step
            candidate += 1
            index = cell_to_sample(r, distance, start, slope, bins, occupied, size, skip)
            if index >= 0:
                ray[place], distances[place], cells[place] = r, distance, index
                for axis in range(3):
                    points[place, axis] = origins[r, axis] + distance * directions[r, axis]
                place += 1


@njit(exact=True)
def observe_cells(cells, observed, allowed, kept, density, least, occupied, decay, trust, empty):
    """Update cells from densities: from the maximum per cell, and ``least`` from the minimum."""
    highest, lowest = np.empty_like(observed), np.empty_like(observed)
    for n in range(len(cells)):
        cell = cells[n]
        highest[n] = max(density[cell] * decay, observed[n]) if allowed[cell] else 0
        raised = least[cell] + trust * (observed[n] - least[cell])
        lowest[n] = min(observed[n], raised)
    for n in range(len(cells)):
        density[cells[n]], least[cells[n]] = highest[n], lowest[n]
    for n in range(len(cells)):
        cell = cells[n]
        density[cell] = max(density[cell], highest[n])
        least[cell] = min(least[cell], lowest[n])
    for n in range(len(cells)):
        occupied[cells[n]] = density[cells[n]] > empty or kept[cells[n]]


@njit(parallel=True)
def composite(optical_depth, colour, distances, starts, opaque, weights, total):
    """Weights of the samples, and colour, opacity and depth of the rays."""
    rays = len(starts)
    for r in prange(rays):
        end = starts[r + 1] if r + 1 < rays else len(optical_depth)
        before = 0.0
        red, green, blue, opacity, far = 0.0, 0.0, 0.0, 0.0, 0.0
        for n in range(starts[r], end):
            depth = max(min(np.float64(optical_depth[n]), opaque), 0.0)
            if np.isnan(optical_depth[n]):
                depth = np.nan
            weight = np.exp(-before) * -np.expm1(-depth)
            before += depth
            weights[n] = weight
            red += weight * colour[n, 0]
            green += weight * colour[n, 1]
            blue += weight * colour[n, 2]
            far += weight * distances[n]
            opacity += weight
        total[r, 0], total[r, 1], total[r, 2] = red, green, blue
        total[r, 3], total[r, 4] = opacity, far


@njit(exact=True, parallel=True)
def take_samples(rays, first, starts, points, distances, taken):
    """Gather the next samples of some rays contiguously."""
    ray_taken, points_taken, distances_taken = taken
    for i in prange(len(rays)):
        end = starts[i + 1] if i + 1 < len(rays) else len(ray_taken)
        for n in range(starts[i], end):
            source = first[rays[i]] + n - starts[i]
            ray_taken[n], distances_taken[n] = rays[i], distances[source]
            for axis in range(3):
                points_taken[n, axis] = points[source, axis]


@njit(parallel=True)
def composite_on(optical_depth, colour, distances, rays, starts, opaque, limit, before, total):
    """Continue `composite` on rays with their next samples, up to a limit of optical depth."""
    for i in prange(len(rays)):
        r = rays[i]
        end = starts[i + 1] if i + 1 < len(rays) else len(optical_depth)
        passed, opacity, far = before[r], total[r, 3], total[r, 4]
        red, green, blue = total[r, 0], total[r, 1], total[r, 2]
        for n in range(starts[i], end):
            if passed >= limit:
                break
            depth = max(min(np.float64(optical_depth[n]), opaque), 0.0)
            if np.isnan(optical_depth[n]):
                depth = np.nan
            weight = np.exp(-passed) * -np.expm1(-depth)
            passed += depth
            red += weight * colour[n, 0]
            green += weight * colour[n, 1]
            blue += weight * colour[n, 2]
            far += weight * distances[n]
            opacity += weight
        before[r], total[r, 3], total[r, 4] = passed, opacity, far
        total[r, 0], total[r, 1], total[r, 2] = red, green, blue


@njit(parallel=True)
def composite_backward(
    optical_depth, colour, distances, starts, opaque, weights, gradient, d_depth, d_colour
):
    """Gradients of `composite` in one pass from back to front along each ray."""
    rays = len(starts)
    for r in prange(rays):
        end = starts[r + 1] if r + 1 < rays else len(optical_depth)
        before = 0.0
        for n in range(starts[r], end):
            before += max(min(np.float64(optical_depth[n]), opaque), 0.0)
        behind = 0.0
        for n in range(end - 1, starts[r] - 1, -1):
            value = (
                gradient[r, 0] * colour[n, 0]
                + gradient[r, 1] * colour[n, 1]
                + gradient[r, 2] * colour[n, 2]
                + gradient[r, 3]
                + gradient[r, 4] * distances[n]
            )
            # Gain of sample n as its depth grows, minus the loss of all samples behind it.
            d_depth[n] = np.exp(-before) * value - behind
            if optical_depth[n] < 0 or optical_depth[n] > opaque:
                d_depth[n] = 0
            before -= max(min(np.float64(optical_depth[n]), opaque), 0.0)
            behind += weights[n] * value
            for c in range(3):
                d_colour[n, c] = weights[n] * gradient[r, c]
