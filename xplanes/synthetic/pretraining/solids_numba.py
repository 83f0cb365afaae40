"""Compiled loops that render solids and test points; `Solids.posed` is the readable twin.

Imported only when needed, since numba takes a second to load.
"""

# ruff: noqa: D103 (the callers document these loops)

import math

import numpy as np

from xplanes.backend import njit

INF = math.inf
INWARD = 0.998
TRACE = 96


@njit(exact=True, forceinline=True)
def ball(ox, oy, oz, dx, dy, dz, radius):
    along = ox * dx + oy * dy + oz * dz
    fx, fy, fz = ox - along * dx, oy - along * dy, oz - along * dz
    spare = radius * radius - (fx * fx + fy * fy + fz * fz)
    if spare < 0:
        return INF, -INF
    reach = math.sqrt(spare)
    return -along - reach, -along + reach


@njit(exact=True, forceinline=True)
def slab(origin, direction, half):
    inverse = 1 / (direction if abs(direction) > 1e-12 else 1e-12)
    reach = half * abs(inverse)
    return -origin * inverse - reach, -origin * inverse + reach


@njit(exact=True)
def cylinder(ox, oy, oz, dx, dy, dz, radius, half):
    near, far = slab(oz, dz, half)
    square = dx * dx + dy * dy
    if square < 1e-12:
        if ox * ox + oy * oy > radius * radius:
            return INF, -INF
        return near, far
    along = (ox * dx + oy * dy) / square
    fx, fy = ox - along * dx, oy - along * dy
    spare = radius * radius - fx * fx - fy * fy
    if spare < 0:
        return INF, -INF
    reach = math.sqrt(spare / square)
    near, far = max(near, -along - reach), min(far, -along + reach)
    if near > far:
        return INF, -INF
    return near, far


@njit(exact=True)
def distance(kind, a, b, c, x, y, z):
    """Signed distance of a point to a solid, in its own coordinates."""
    if kind == 1:
        scaled = max(math.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2), 1e-6)
        slope = math.sqrt((x / (a * a)) ** 2 + (y / (b * b)) ** 2 + (z / (c * c)) ** 2)
        return scaled * (scaled - 1) / max(slope, 1e-6 / min(a, b, c))
    if kind == 3:
        z -= min(max(z, -b), b)
        return math.sqrt(x * x + y * y + z * z) - a
    if kind == 4:
        return math.hypot(math.hypot(x, y) - a, z) - b
    if kind == 0:
        u, v, w = abs(x) - a, abs(y) - b, abs(z) - c
    else:
        u, v, w = math.hypot(x, y) - a, abs(z) - b, -INF
    out = math.sqrt(max(u, 0.0) ** 2 + max(v, 0.0) ** 2 + max(w, 0.0) ** 2)
    return out + min(max(u, v, w), 0.0)


@njit(exact=True)
def hit(kind, a, b, c, ox, oy, oz, dx, dy, dz):
    """Distance at which a ray from outside enters a solid, in its own coordinates."""
    near, far = INF, -INF
    if kind == 0:
        n0, f0 = slab(ox, dx, a)
        n1, f1 = slab(oy, dy, b)
        n2, f2 = slab(oz, dz, c)
        near, far = max(n0, n1, n2), min(f0, f1, f2)
    elif kind == 1:
        sx, sy, sz = dx / a, dy / b, dz / c
        length = math.sqrt(sx * sx + sy * sy + sz * sz)
        near, far = ball(ox / a, oy / b, oz / c, sx / length, sy / length, sz / length, 1.0)
        near, far = near / length, far / length
    elif kind == 2:
        near, far = cylinder(ox, oy, oz, dx, dy, dz, a, b)
    elif kind == 3:
        near, far = cylinder(ox, oy, oz, dx, dy, dz, a, b)
        n1, f1 = ball(ox, oy, oz - b, dx, dy, dz, a)
        n2, f2 = ball(ox, oy, oz + b, dx, dy, dz, a)
        near, far = min(near, n1, n2), max(far, f1, f2)
    else:
        start, stop = cylinder(ox, oy, oz, dx, dy, dz, a + b, b)
        t = max(start, 0.0)
        for _ in range(TRACE):
            if t > stop:
                return INF
            gap = distance(kind, a, b, c, ox + t * dx, oy + t * dy, oz + t * dz)
            if gap < 1e-6:
                return t
            t += gap
        return INF
    if near > far or far <= 0:
        return INF
    return near if near > 0 else far


@njit(exact=True)
def normal(kind, a, b, c, x, y, z):
    """Outward unit normal at a point on a solid, in its own coordinates."""
    if kind == 0:
        u, v, w = abs(x) - a, abs(y) - b, abs(z) - c
        if u >= v and u >= w:
            return math.copysign(1.0, x), 0.0, 0.0
        if v >= w:
            return 0.0, math.copysign(1.0, y), 0.0
        return 0.0, 0.0, math.copysign(1.0, z)
    if kind == 2 and abs(z) - b > math.hypot(x, y) - a:
        return 0.0, 0.0, math.copysign(1.0, z)
    if kind == 1:
        x, y, z = x / (a * a), y / (b * b), z / (c * c)
    elif kind == 2:
        z = 0.0
    elif kind == 3:
        z -= min(max(z, -b), b)
    else:
        flat = max(math.hypot(x, y), 1e-12)
        x, y = x - a * x / flat, y - a * y / flat
    length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return x / length, y / length, z / length


@njit(exact=True, forceinline=True)
def turned(r, x, y, z):
    """A vector in the coordinates of a part with this rotation."""
    return (
        x * r[0, 0] + y * r[1, 0] + z * r[2, 0],
        x * r[0, 1] + y * r[1, 1] + z * r[2, 1],
        x * r[0, 2] + y * r[1, 2] + z * r[2, 2],
    )


@njit(exact=True, forceinline=True)
def toned(paint, tone):
    return (
        min(max(paint[0] * tone, 0.0), 1.0),
        min(max(paint[1] * tone, 0.0), 1.0),
        min(max(paint[2] * tone, 0.0), 1.0),
    )


@njit(exact=True, forceinline=True)
def cell(value, width):
    return math.floor(value * (INWARD / width))


@njit(exact=True)
def paint(pattern, paints, n, x, y, z):
    """Colour of a pattern at a point, in the part's coordinates."""
    index = 0
    if pattern == 0:
        tone = 1.0
        if n[0] != 0:
            f = 2 * math.pi / n[1]
            u, v, w = x * f, y * f, z * f
            waves = math.sin(u + 0.9 * math.sin(0.7 * v)) * math.cos(v + 0.9 * math.sin(0.6 * w))
            waves += 0.6 * math.sin(1.7 * w + 0.8 * u) * math.cos(1.3 * v - 0.5 * u)
            tone += n[0] * waves
        return toned(paints[0], tone)
    if pattern == 1:
        value = x if n[0] == 0 else (y if n[0] == 1 else z)
        index = int(cell(value, n[1]) % n[2])
    elif pattern == 2:
        index = int((cell(x, n[0]) + cell(y, n[1]) + cell(z, n[2])) % n[3])
    elif pattern == 4:
        turn = math.atan2(y, x) / (2 * math.pi) + 0.5
        index = int(math.floor(turn * n[0]) % n[1])
    else:
        x, y, z = x * INWARD, y * INWARD, z * INWARD
        row = math.floor(z / n[1])
        along = (x + y) / n[0] + 0.5 * (row % 2)
        column = math.floor(along)
        if (along - column) * n[0] < n[2] or z - row * n[1] < n[2]:
            return paints[1, 0], paints[1, 1], paints[1, 2]
        noise = math.sin(row * 12.9898 + column * 78.233) * 437.585
        return toned(paints[0], 1 + 0.2 * (noise - math.trunc(noise)))
    return paints[index, 0], paints[index, 1], paints[index, 2]


@njit(exact=True)
def first(parts, ox, oy, oz, dx, dy, dz, any_hit):
    """Distance to the first part on a ray and its index; any hit part if ``any_hit``."""
    kinds, sizes, rotations, centres, reach = parts[:5]
    best, found = INF, -1
    for p in range(len(kinds)):
        cx, cy, cz = ox - centres[p, 0], oy - centres[p, 1], oz - centres[p, 2]
        along = -(cx * dx + cy * dy + cz * dz)
        radius = reach[p]
        if along < -radius or along - radius > best:
            continue
        if cx * cx + cy * cy + cz * cz - along * along > radius * radius * 1.0001 + 1e-9:
            continue
        x, y, z = turned(rotations[p], cx, cy, cz)
        u, v, w = turned(rotations[p], dx, dy, dz)
        t = hit(kinds[p], sizes[p, 0], sizes[p, 1], sizes[p, 2], x, y, z, u, v, w)
        if t < best:
            best, found = t, p
            if any_hit:
                break
    return best, found


@njit(exact=True)
def shade(parts, p, x, y, z, result):
    """Normal (0 to 2) and shaded colour (3 to 5) of part p at a point on its surface."""
    kinds, sizes, rotations, centres, _, patterns, paints, numbers, light = parts
    r = rotations[p]
    u, v, w = turned(r, x - centres[p, 0], y - centres[p, 1], z - centres[p, 2])
    a, b, c = normal(kinds[p], sizes[p, 0], sizes[p, 1], sizes[p, 2], u, v, w)
    nx = r[0, 0] * a + r[0, 1] * b + r[0, 2] * c
    ny = r[1, 0] * a + r[1, 1] * b + r[1, 2] * c
    nz = r[2, 0] * a + r[2, 1] * b + r[2, 2] * c
    red, green, blue = paint(patterns[p], paints[p], numbers[p], u, v, w)
    length = math.sqrt(light[0] * light[0] + light[1] * light[1] + light[2] * light[2])
    sx, sy, sz = light[0] / length, light[1] / length, light[2] / length
    facing = max(nx * sx + ny * sy + nz * sz, 0.0) * light[3]
    if facing > 0 and light[6] > 0:
        away = 1e-3
        sun = first(parts, x + away * nx, y + away * ny, z + away * nz, sx, sy, sz, True)
        if sun[1] >= 0:
            facing *= 1 - light[6]
    strength = facing + light[5] + light[4] * (0.5 + 0.5 * nz)
    result[0], result[1], result[2] = nx, ny, nz
    result[3] = min(red * strength, 1.0)
    result[4] = min(green * strength, 1.0)
    result[5] = min(blue * strength, 1.0)


@njit(exact=True)
def cast(parts, origins, directions, distances, owners, seen):
    """First surface on each ray: its distance, part, normal and colour."""
    for i in range(len(origins)):
        o, d = origins[i], directions[i]
        t, p = first(parts, o[0], o[1], o[2], d[0], d[1], d[2], False)
        distances[i], owners[i] = t, p
        if p >= 0:
            shade(parts, p, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2], seen[i])


@njit(exact=True)
def inside(parts, points, result):
    """Which points lie inside any part."""
    kinds, sizes, rotations, centres, reach = parts[:5]
    for i in range(len(points)):
        for p in range(len(kinds)):
            x, y = points[i, 0] - centres[p, 0], points[i, 1] - centres[p, 1]
            z = points[i, 2] - centres[p, 2]
            if x * x + y * y + z * z > reach[p] * reach[p]:
                continue
            u, v, w = turned(rotations[p], x, y, z)
            if distance(kinds[p], sizes[p, 0], sizes[p, 1], sizes[p, 2], u, v, w) < 0:
                result[i] = True
                break


@njit(exact=True)
def render(parts, rectangles, pose, focal, samples, colour, alpha, depth):
    """An image on white, its opacity, and the depth of each pixel's first sample."""
    kinds, sizes, rotations, centres = parts[:4]
    side = len(colour) * samples
    nearest, owner = np.full((side, side), INF), np.full((side, side), -1)
    turn = np.empty((3, 3))
    for p in range(len(kinds)):
        r = rotations[p]
        x, y, z = pose[0, 3] - centres[p, 0], pose[1, 3] - centres[p, 1], pose[2, 3] - centres[p, 2]
        ox, oy, oz = turned(r, x, y, z)
        for j in range(3):
            turn[0, j], turn[1, j], turn[2, j] = turned(r, pose[0, j], pose[1, j], pose[2, j])
        a, b, c = sizes[p, 0], sizes[p, 1], sizes[p, 2]
        for i in range(rectangles[p, 0], rectangles[p, 1]):
            up = (0.5 - (i + 0.5) / side) / focal
            for j in range(rectangles[p, 2], rectangles[p, 3]):
                right = ((j + 0.5) / side - 0.5) / focal
                n = 1 / math.sqrt(right * right + up * up + 1)
                dx = (turn[0, 0] * right + turn[0, 1] * up - turn[0, 2]) * n
                dy = (turn[1, 0] * right + turn[1, 1] * up - turn[1, 2]) * n
                dz = (turn[2, 0] * right + turn[2, 1] * up - turn[2, 2]) * n
                t = hit(kinds[p], a, b, c, ox, oy, oz, dx, dy, dz)
                if t < nearest[i, j]:
                    nearest[i, j], owner[i, j] = t, p
    seen, share = np.empty(6), 1.0 / (samples * samples)
    colour[:], alpha[:] = 1.0, 0.0
    for i in range(side):
        up = (0.5 - (i + 0.5) / side) / focal
        for j in range(side):
            row, column, t = i // samples, j // samples, nearest[i, j]
            if i % samples == 0 and j % samples == 0:
                depth[row, column] = t
            if owner[i, j] < 0:
                continue
            right = ((j + 0.5) / side - 0.5) / focal
            n = t / math.sqrt(right * right + up * up + 1)
            x = pose[0, 3] + (pose[0, 0] * right + pose[0, 1] * up - pose[0, 2]) * n
            y = pose[1, 3] + (pose[1, 0] * right + pose[1, 1] * up - pose[1, 2]) * n
            z = pose[2, 3] + (pose[2, 0] * right + pose[2, 1] * up - pose[2, 2]) * n
            shade(parts, owner[i, j], x, y, z, seen)
            alpha[row, column] += share
            for k in range(3):
                colour[row, column, k] += (seen[3 + k] - 1) * share
