"""Independent float64 references of the baselines in plain loops, written from the formulas."""

import bisect
import math

import numpy as np

from tests.oracles import tent

AXES = "xyzt"


def product_features(planes, channels, points, times):
    """Products of planes by scale, planes being [(name, array [C, rows, columns])]. [N, S C]"""
    scales = sum(name == "xy" for name, _ in planes)
    per_scale = len(planes) // scales
    result = []
    for point, time in zip(points, times, strict=True):
        place = dict(zip(AXES, [*point, 2 * time - 1], strict=True))
        features = []
        for scale in range(scales):
            product = np.ones(channels)
            for name, plane in planes[scale * per_scale : (scale + 1) * per_scale]:
                value = np.zeros(channels)
                columns, rows = (
                    tent(min(max((place[axis] + 1) / 2, 0), 1) * (size - 1), size)
                    for axis, size in zip(name, plane.shape[:0:-1], strict=True)
                )
                for r in range(plane.shape[1]):
                    for c in range(plane.shape[2]):
                        value += rows[r] * columns[c] * plane[:, r, c]
                product = product * value
            features.append(product)
        result.append(np.concatenate(features))
    return np.array(result)


def weights(densities, lengths):
    """Share of the light that each sample of one ray sends."""
    light, found = 1.0, []
    for density, length in zip(densities, lengths, strict=True):
        alpha = 1 - math.exp(-density * length)
        found.append(light * alpha)
        light *= 1 - alpha
    return found


def resample(edges, mass, places, padding):
    """Where the running integral of padded masses passes each of ``places``, for one ray."""
    padded = [value + padding for value in mass]
    total = sum(padded)
    running = [0.0]
    for value in padded:
        running.append(running[-1] + value / total)
    found = []
    for place in places:
        bin_ = min(max(bisect.bisect_right(running, place) - 1, 0), len(mass) - 1)
        share = (place - running[bin_]) / (running[bin_ + 1] - running[bin_])
        found.append(edges[bin_] + min(max(share, 0), 1) * (edges[bin_ + 1] - edges[bin_]))
    return found


def covering(edges, coarse_edges, mass):
    """For each bin of one ray the mass of all coarse bins that share more than a point with it."""
    found = []
    for start, end in zip(edges, edges[1:], strict=False):
        total = 0.0
        for a, b, value in zip(coarse_edges, coarse_edges[1:], mass, strict=False):
            if a < end and b > start:
                total += value
        found.append(total)
    return found


def histogram(fine_edges, fine, levels):
    """The histogram term, levels being [(edges [R, P + 1], masses [R, P])]."""
    total = 0.0
    for coarse_edges, coarse in levels:
        terms = []
        for r in range(len(fine)):
            bound = covering(fine_edges[r], coarse_edges[r], coarse[r])
            terms += [
                max(0.0, w - b) ** 2 / (w + 1e-7) for w, b in zip(fine[r], bound, strict=True)
            ]
        total += sum(terms) / len(terms)
    return total


def mean_square_difference(plane, axis):
    """Mean over all pairs of neighbours along an axis of [C, rows, columns]."""
    squares = []
    for index in np.ndindex(plane.shape):
        if index[axis] + 1 < plane.shape[axis]:
            after = tuple(i + (a == axis) for a, i in enumerate(index))
            squares.append((plane[after] - plane[index]) ** 2)
    return sum(squares) / len(squares)


def coded_variation(planes):
    """Both axes, times 2; space planes once more."""
    total = 0.0
    for name, plane in planes:
        both = 2 * (mean_square_difference(plane, 1) + mean_square_difference(plane, 2))
        total += both if "t" in name else 2 * both
    return total


def corrected_variation(planes):
    """Mean over planes; along space alone."""
    total = 0.0
    for name, plane in planes:
        columns = mean_square_difference(plane, 2)
        if "t" in name:
            total += columns
        else:
            total += (mean_square_difference(plane, 1) + columns) / 2
    return total / len(planes)


def bend(planes):
    """Mean squared second differences along time, summed over the planes that have time."""
    total = 0.0
    for name, plane in planes:
        if "t" in name:
            squares = [
                (plane[c, r, x] - 2 * plane[c, r + 1, x] + plane[c, r + 2, x]) ** 2
                for c, r, x in np.ndindex(plane.shape)
                if r + 2 < plane.shape[1]
            ]
            total += sum(squares) / len(squares)
    return total


def distance_from_one(planes):
    """Mean distance from 1, summed over the planes that have time."""
    total = 0.0
    for name, plane in planes:
        if "t" in name:
            total += sum(abs(1 - value) for value in plane.flat) / plane.size
    return total


def learning_steps(every, warmup, steps):
    """Steps in which density fields learn, by counting as the schedule is told."""
    since, found = 0, []
    for step in range(steps):
        gap = max(1.0, min(every, every * step / warmup))
        if step < 10 or since > gap:
            found.append(step)
            since = 0
        since += 1
    return found


def trilinear(grid, box, point):
    """A grid [C, X, Y, Z] read at every cell, every second and every fourth. [3 C]"""
    found = []
    for step in (1, 2, 4):
        coarse = grid[:, ::step, ::step, ::step]
        weights = []
        for axis in range(3):
            size = coarse.shape[axis + 1]
            place = (point[axis] - box[0, axis]) / (box[1, axis] - box[0, axis])
            weights.append(tent(place * (size - 1), size))
        value = np.zeros(grid.shape[0])
        for x, y, z in np.ndindex(coarse.shape[1:]):
            value += weights[0][x] * weights[1][y] * weights[2][z] * coarse[:, x, y, z]
        found.append(value)
    return np.concatenate(found)


def plane_value(plane, columns, rows):
    """A plane [H, W, C] between its texels' centres, the border's value beyond."""
    across, down = (
        tent(min(max((place + 1) / 2, 0), 1) * (size - 1), size)
        for place, size in ((columns, plane.shape[1]), (rows, plane.shape[0]))
    )
    return np.einsum("r,c,rck->k", down, across, plane)


def surface_ray(distances, changes, lengths, sharpness, inside):
    """Opacities and weights of the sections of one ray, by NeuS' Eq. 13."""

    def logistic(value):
        return 1 / (1 + math.exp(-value * sharpness))

    opacities, light, weights = [], 1.0, []
    for d, c, length, ok in zip(distances, changes, lengths, inside, strict=True):
        before, after = logistic(d - c * length / 2), logistic(d + c * length / 2)
        opacity = min(max((before - after + 1e-5) / (before + 1e-5), 0), 1) * ok
        opacities.append(opacity)
        weights.append(light * opacity)
        light *= 1 - opacity + 1e-7
    return opacities, weights
