"""Independent float64 references in plain NumPy loops, written from the formulas alone.

Slow on purpose: nothing here shares code or tricks with what it checks.
"""

import math

import numpy as np

AXES = {"x": 0, "y": 1, "z": 2}

EQUATION_15 = {
    "six": (("xy", "xt", "yt"), ("xz", "xt", "zt"), ("yz", "yt", "zt")),
    "nine": (("xy", "xt", "yt"), ("xz", "xt'", "zt"), ("yz", "yt'", "zt'")),
    "three": (("xy",), ("xz",), ("yz",)),
}
"""Each space plane and the two time planes whose product is added to it."""


def tent(position, size):
    """Linear interpolation weights of the texels 0 .. size - 1 at a position between them."""
    return np.array([max(0.0, 1.0 - abs(position - i)) for i in range(size)])


def space_weights(coordinate, size):
    """Texels lie whole in [-1, 1]; beyond the border there is zero."""
    return tent((coordinate + 1) / 2 * size - 0.5, size)


def time_weights(time, size):
    """The first row is t = 0, the last t = 1; earlier and later times take those rows."""
    return tent(min(max(time, 0.0), 1.0) * (size - 1), size)


def plane_value(plane, name, point, time):
    """A plane [C, rows, columns], axis "a" of its name "ab" along the columns, at a point."""
    columns = space_weights(point[AXES[name[0]]], plane.shape[2])
    if name[1] == "t":
        rows = time_weights(time, plane.shape[1])
    else:
        rows = space_weights(point[AXES[name[1]]], plane.shape[1])
    value = np.zeros(plane.shape[0])
    for r in range(plane.shape[1]):
        for c in range(plane.shape[2]):
            value += rows[r] * columns[c] * plane[:, r, c]
    return value


def plane_features(planes, plane_set, points, times):
    """Eq. 15 at points [N, 3] and times [N] from planes by name. [N, 3, C]"""
    planes = {name: np.asarray(plane, dtype=np.float64) for name, plane in planes.items()}
    result = []
    for point, time in zip(np.asarray(points, float), np.asarray(times, float), strict=True):
        features = []
        for names in EQUATION_15[plane_set]:
            values = [plane_value(planes[name], name, point, time) for name in names]
            features.append(values[0] + (values[1] * values[2] if len(values) == 3 else 0))
        result.append(features)
    return np.array(result).reshape(len(points), 3, -1)


def ray_box(origin, direction, half=1.0):
    """Interval of distances in front of the origin that lies in the cube; (0, 0) for none."""
    near, far = 0.0, math.inf
    if not np.any(direction):
        return 0.0, 0.0
    for place, slope in zip(origin, direction, strict=True):
        if slope == 0:
            if abs(place) > half:
                return 0.0, 0.0
            continue
        ends = sorted(((-half - place) / slope, (half - place) / slope))
        near, far = max(near, ends[0]), min(far, ends[1])
    return (near, far) if far > near else (0.0, 0.0)


def march(origins, directions, times, jitter, occupied, density, *, step, skip, occlusion):
    """Samples kept on each ray, and (candidates, empty, occluded).

    ``occupied`` and ``density`` are [time bins, G, G, G] with axes z, y, x. A sample behind which
    the densities of the cells in front leave less light than ``occlusion`` is dropped.
    """
    bins, size = occupied.shape[:2]
    kept, candidates, empty, occluded = [], 0, 0, 0
    for r, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        near, far = ray_box(origin, direction)
        light, number = 1.0, 0
        time_bin = min(int(times[r] * bins), bins - 1)
        while near + (number + jitter[r]) * step < far:
            distance = near + (number + jitter[r]) * step
            number += 1
            candidates += 1
            point = origin + distance * direction
            x, y, z = (min(max(math.floor((p + 1) / 2 * size), 0), size - 1) for p in point)
            if skip and not occupied[time_bin, z, y, x]:
                empty += 1
            elif light <= occlusion:
                occluded += 1
            else:
                cell = ((time_bin * size + z) * size + y) * size + x
                kept.append((r, distance, cell, *point))
                light *= math.exp(-min(density[time_bin, z, y, x] * step, 700.0))
    return kept, (candidates, empty, occluded)


def composite(optical_depth, colour, distances, ray, rays):
    """Beer and Lambert ray by ray: sums of weight times (colour, 1, distance), and the weights."""
    total, weights = np.zeros((rays, 5)), np.zeros(len(ray))
    light = np.ones(rays)
    for n, r in enumerate(ray):
        left = light[r] * math.exp(-optical_depth[n])
        weights[n] = light[r] - left
        total[r] += weights[n] * np.array([*colour[n], 1.0, distances[n]])
        light[r] = left
    return total, weights


def composite_gradient(optical_depth, colour, distances, ray, rays, gradient):
    """Gradient of ``sum(total * gradient)`` by the product rule, weight by weight. [N], [N, 3]"""
    weights = composite(optical_depth, colour, distances, ray, rays)[1]
    d_depth, d_colour = np.zeros(len(ray)), np.zeros((len(ray), 3))
    for n, r in enumerate(ray):
        d_colour[n] = weights[n] * gradient[r, :3]
        for m, other in enumerate(ray):
            if other != r or m < n:
                continue
            value = np.dot([*colour[m], 1.0, distances[m]], gradient[r])
            # Behind: less light arrives. Here: what is left of the light is stopped instead.
            in_front = sum(optical_depth[k] for k in range(m) if ray[k] == r)
            left = math.exp(-in_front - optical_depth[m])
            d_depth[n] += value * (left if m == n else -weights[m])
    return d_depth, d_colour


def total_variation(planes, dims):
    """Sum over ``dims`` of the mean squared difference of neighbours in planes [P, H, W, C]."""
    total = 0.0
    for dim in dims:
        squares = []
        for index in np.ndindex(planes.shape):
            if index[dim] + 1 < planes.shape[dim]:
                neighbour = tuple(i + (axis == dim) for axis, i in enumerate(index))
                squares.append((planes[neighbour] - planes[index]) ** 2)
        total += sum(squares) / len(squares) if squares else 0.0
    return total


def time_smoothness(planes):
    """Mean squared bend along the rows of planes [P, T, H, C]."""
    squares = [
        (planes[p, t - 1, h, c] - 2 * planes[p, t, h, c] + planes[p, t + 1, h, c]) ** 2
        for p, t, h, c in np.ndindex(planes.shape)
        if 0 < t < planes.shape[1] - 1
    ]
    return sum(squares) / len(squares) if squares else 0.0


def project(point, pose, focal, height, width):
    """Pixel (row, column) that a world point falls into, and whether the camera sees it."""
    camera = np.linalg.inv(pose) @ np.append(point, 1.0)
    if camera[2] >= 0:
        return 0, 0, False
    column = math.floor(focal * camera[0] / -camera[2] + width / 2)
    row = math.floor(-focal * camera[1] / -camera[2] + height / 2)
    return row, column, 0 <= row < height and 0 <= column < width


def visual_hull(alpha, poses, focal, points):
    """Which points show foreground in every view that sees them: [V, H, W], ..., [N, 3] -> [N]"""
    held = []
    for point in points:
        seen = [
            project(point, pose, focal, *mask.shape)
            for mask, pose in zip(alpha, poses, strict=True)
        ]
        held.append(
            all(
                mask[row, column] > 0
                for mask, (row, column, ok) in zip(alpha, seen, strict=True)
                if ok
            )
        )
    return np.array(held)
