"""Independent float64 references of Gaussian splatting in NumPy, written from the papers' formulas.

One Gaussian after the other over all pixels, with explicit covariances, inverses and exponentials.
"""

import math

import numpy as np


def rotated(quaternion, vector):
    """q v q* of the unit quaternion, by Hamilton's product."""

    def product(a, b):
        scalar = a[0] * b[0] - a[1:] @ b[1:]
        return np.array([scalar, *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])

    unit = quaternion / np.linalg.norm(quaternion)
    conjugate = unit * [1, -1, -1, -1]
    return product(product(unit, np.array([0.0, *vector])), conjugate)[1:]


def projected(mean, quaternion, scale, camera):
    """Mean in pixels, covariance without the low-pass filter, and depth."""
    pose = camera.world_to_camera.double().numpy()
    turn = pose[:3, :3]
    x, y, z = turn @ mean + pose[:3, 3]
    rotation = np.stack([rotated(quaternion, axis) for axis in np.eye(3)], axis=1)
    covariance = rotation @ np.diag(np.asarray(scale) ** 2) @ rotation.T
    room_x, room_y = 0.3 * 0.5 * camera.width / camera.fx, 0.3 * 0.5 * camera.height / camera.fy
    right = (camera.width - camera.cx) / camera.fx + room_x
    down = (camera.height - camera.cy) / camera.fy + room_y
    tx = z * np.clip(x / z, -camera.cx / camera.fx - room_x, right)
    ty = z * np.clip(y / z, -camera.cy / camera.fy - room_y, down)
    jacobian = np.array(
        [[camera.fx / z, 0, -camera.fx * tx / z**2], [0, camera.fy / z, -camera.fy * ty / z**2]]
    )
    seen = jacobian @ turn @ covariance @ turn.T @ jacobian.T
    middle = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    return middle, seen, z


def splat(given, camera, background=None, antialiased=False):
    """Colour, opacity and expected depth of an image.

    Args:
        given: means, quaternions, scales, opacities, colours.
        camera: See `xplanes.baselines.gaussians.camera`.
        background: [C]
        antialiased: Mip-Splatting's compensation.
    """
    means, quaternions, scales, opacities, colours = (np.asarray(a, np.float64) for a in given)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    shape = (camera.height, camera.width)
    left, done = np.ones(shape), np.zeros(shape, bool)
    colour, opacity, depth = np.zeros((*shape, colours.shape[1])), np.zeros(shape), np.zeros(shape)
    pose = camera.world_to_camera.double().numpy()
    depths = means @ pose[2, :3] + pose[2, 3]
    for n in np.argsort(depths, kind="stable"):
        if done.all():
            break
        if not camera.near < depths[n] < camera.far:
            continue
        middle, seen, z = projected(means[n], quaternions[n], scales[n], camera)
        filtered = seen + 0.3 * np.eye(2)
        peak = opacities[n]
        if antialiased:
            peak *= math.sqrt(max(np.linalg.det(seen), 0) / np.linalg.det(filtered))
        (a, b), (_, c) = np.linalg.inv(filtered)
        dx, dy = x - middle[0], y - middle[1]
        alpha = np.minimum(
            peak * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy)), 0.999
        )
        drawn = (alpha >= 1 / 255) & ~done
        done |= drawn & (left * (1 - alpha) < 1e-4)
        weight = np.where(drawn & ~done, alpha * left, 0)
        colour += weight[..., None] * colours[n]
        opacity += weight
        depth += weight * z
        left = np.where(drawn & ~done, left * (1 - alpha), left)
    if background is not None:
        colour += left[..., None] * np.asarray(background, np.float64)
    return colour, opacity, depth / np.maximum(opacity, 1e-10)


def harmonic(degree, order, direction):
    """Real spherical harmonic with the Condon-Shortley phase, from Rodrigues' formula."""
    x, y, z = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    m = abs(order)
    power = np.polynomial.Polynomial([-1, 0, 1]) ** degree
    slope = power.deriv(degree + m) if degree + m else power
    legendre = (1 - z * z) ** (m / 2) * slope(z) / (2**degree * math.factorial(degree))
    legendre *= (-1) ** m
    norm = (
        (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m)
    )
    angle = m * math.atan2(y, x)
    turn = math.sqrt(2) * (math.cos(angle) if order > 0 else math.sin(angle)) if order else 1.0
    return math.sqrt(norm) * legendre * turn
