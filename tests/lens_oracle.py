"""Lenses by the formulas of OpenCV's and COLMAP's manuals, in plain Python, one ray at a time."""

import math


def distort(model, x, y, k):
    """A point of the plane, tan(theta) or theta from its middle, as the lens moves it."""
    k = dict.fromkeys("k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4 omega".split(), 0.0) | k
    r = math.hypot(x, y)
    if model == "fov":
        if r == 0:
            return 0.0, 0.0
        distorted = math.atan(2 * r * math.tan(k["omega"] / 2)) / k["omega"]
        return x * distorted / r, y * distorted / r
    if model in ("fisheye", "polynomial"):
        factor = 1 + k["k1"] * r**2 + k["k2"] * r**4 + k["k3"] * r**6 + k["k4"] * r**8
    else:
        factor = (1 + k["k1"] * r**2 + k["k2"] * r**4 + k["k3"] * r**6) / (
            1 + k["k4"] * r**2 + k["k5"] * r**4 + k["k6"] * r**6
        )
    shift_x = 2 * k["p1"] * x * y + k["p2"] * (r**2 + 2 * x**2) + k["s1"] * r**2 + k["s2"] * r**4
    shift_y = k["p1"] * (r**2 + 2 * y**2) + 2 * k["p2"] * x * y + k["s3"] * r**2 + k["s4"] * r**4
    return x * factor + shift_x, y * factor + shift_y


def pixel(model, point, k, focal, centre, skew=0.0):
    """Pixel coordinates of a point along OpenGL axes."""
    right, down, depth = point[0], -point[1], -point[2]
    aside = math.hypot(right, down)
    if model == "fisheye":
        theta = math.atan2(aside, depth)
        scale = theta / aside if aside else 1 / depth
    else:
        scale = 1 / depth
    x, y = distort(model, right * scale, down * scale, k)
    return focal[0] * x + skew * y + centre[0], focal[1] * y + centre[1]


def direction(model, target, k, focal, centre, skew=0.0, widest=math.pi):
    """The unit direction seen at a pixel, by bisection for the angle and a search for the side.

    Bisection halves the angle from the axis at which the lens reaches the pixel's distance from the
    principal point; turning the side corrects for the terms that are not radial.
    """
    y = (target[1] - centre[1]) / focal[1]
    x = (target[0] - centre[0] - skew * y) / focal[0]
    goal, side = math.hypot(x, y), math.atan2(y, x)
    turn = side
    for _ in range(60):

        def plane(theta, turn=turn):
            radius = theta if model == "fisheye" else math.tan(theta)
            return distort(model, radius * math.cos(turn), radius * math.sin(turn), k)

        low, high = 0.0, widest if model == "fisheye" else min(widest, math.pi / 2 - 1e-3)
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (low, middle) if math.hypot(*plane(middle)) > goal else (middle, high)
        found = plane(low)
        error = math.remainder(math.atan2(found[1], found[0]) - side, 2 * math.pi)
        turn -= error
        if abs(error) < 1e-15:
            break
    return (math.sin(low) * math.cos(turn), -math.sin(low) * math.sin(turn), -math.cos(low))
