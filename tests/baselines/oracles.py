"""Independent float64 references of the baselines in NumPy, written from the formulas."""

from itertools import pairwise

import numpy as np

from tests.oracles import tent

AXES = "xyzt"


def plane_value(plane, columns, rows):
    """A plane [H, W, C] between its texels' centres, the border's value beyond."""
    across, down = (
        tent(min(max((place + 1) / 2, 0), 1) * (size - 1), size)
        for place, size in ((columns, plane.shape[1]), (rows, plane.shape[0]))
    )
    return np.einsum("r,c,rck->k", down, across, plane)


def product_features(planes, points, times):
    """Products of planes by scale, planes being [(name, array [C, rows, columns])]. [N, S C]"""
    scales = sum(name == "xy" for name, _ in planes)
    result = []
    for point, time in zip(points, times, strict=True):
        place = dict(zip(AXES, [*point, 2 * time - 1], strict=True))
        values = [
            plane_value(plane.transpose(1, 2, 0), place[name[0]], place[name[1]])
            for name, plane in planes
        ]
        by_scale = np.reshape(values, (scales, len(planes) // scales, -1))
        result.append(by_scale.prod(axis=1).ravel())
    return np.array(result)


def trilinear(grid, box, point):
    """A grid [C, X, Y, Z] read at every cell, every second and every fourth. [3 C]"""
    found = []
    for step in (1, 2, 4):
        coarse = grid[:, ::step, ::step, ::step]
        places = (point - box[0]) / (box[1] - box[0])
        weights = [
            tent(place * (size - 1), size)
            for place, size in zip(places, coarse.shape[1:], strict=True)
        ]
        found.append(np.einsum("x,y,z,cxyz->c", *weights, coarse))
    return np.concatenate(found)


def weights(opacities, spare=0.0):
    """Share of the light that each of a ray's sections sends. [R, S]"""
    left = np.cumprod(1 - opacities + spare, axis=1)
    return opacities * np.concatenate([np.ones((len(left), 1)), left[:, :-1]], axis=1)


def section_opacities(distances, changes, lengths, sharpness):
    """Opacities of the sections of rays, by NeuS' Eq. 13. [R, S]"""
    before, after = (
        1 / (1 + np.exp(-sharpness * (distances + side * changes * lengths / 2)))
        for side in (-1, 1)
    )
    return np.clip((before - after + 1e-5) / (before + 1e-5), 0, 1)


def resample(edges, mass, places, padding):
    """Where the running integral of padded masses passes each of ``places``, for one ray."""
    running = np.cumsum([0, *(mass + padding)])
    return np.interp(places, running / running[-1], edges)


def covering(edges, coarse_edges, mass):
    """For each bin of one ray the mass of all coarse bins that share more than a point with it."""
    starts, ends = coarse_edges[:-1], coarse_edges[1:]
    return np.array([mass[(starts < end) & (ends > start)].sum() for start, end in pairwise(edges)])


def histogram(fine_edges, fine, levels):
    """The histogram term, levels being [(edges [R, P + 1], masses [R, P])]."""
    total = 0.0
    for coarse_edges, coarse in levels:
        rays = zip(fine_edges, coarse_edges, coarse, strict=True)
        bounds = np.array([covering(*ray) for ray in rays])
        total += np.mean(np.maximum(0, fine - bounds) ** 2 / (fine + 1e-7))
    return total


def roughness(plane, axis):
    """Mean squared difference of neighbours along an axis of [C, rows, columns]."""
    return np.mean(np.diff(plane, axis=axis) ** 2)


def coded_variation(planes):
    """Both axes, times 2; space planes once more."""
    return sum(
        (2 if "t" in name else 4) * (roughness(plane, 1) + roughness(plane, 2))
        for name, plane in planes
    )


def corrected_variation(planes):
    """Mean over planes; along space alone."""
    return np.mean(
        [
            np.mean([roughness(plane, axis) for axis in ((2,) if "t" in name else (1, 2))])
            for name, plane in planes
        ]
    )


def bend(planes):
    """Mean squared second differences along time, summed over the planes that have time."""
    return sum(np.mean(np.diff(plane, 2, axis=1) ** 2) for name, plane in planes if "t" in name)


def distance_from_one(planes):
    """Mean distance from 1, summed over the planes that have time."""
    return sum(np.mean(np.abs(1 - plane)) for name, plane in planes if "t" in name)


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
