"""Helpers to build the scenes of the suite."""

import math
from collections.abc import Iterator, Sequence

from xplanes.synthetic.demo.assembly import WORLD, Joint, Kind, Part, Vector
from xplanes.synthetic.demo.geometry import Capsule, Ellipsoid, Surface
from xplanes.synthetic.demo.motions import Motion

ORIGIN: Vector = (0.0, 0.0, 0.0)
AXES: dict[str, Vector] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def ball(radius: float) -> Ellipsoid:
    """A ball."""
    return Ellipsoid((radius, radius, radius))


def moving(
    name: str,
    position: Vector = ORIGIN,
    rotation: Vector = ORIGIN,
    *,
    parent: str = WORLD,
    x: Motion | None = None,
    y: Motion | None = None,
    z: Motion | None = None,
    turn: Motion | None = None,
    axis: Vector = AXES["z"],
    size: Motion | None = None,
) -> list[Joint]:
    """A chain of joints that translates, rotates and scales; the last one is called ``name``.

    Args:
        name: Name of the last joint.
        position: Origin in the parent's frame.
        rotation: Angles about x, y and z, in degrees.
        parent: Parent joint.
        x: Translation along x over time; y and z likewise.
        y: Translation along y.
        z: Translation along z.
        turn: Rotation about ``axis`` over time, in degrees.
        axis: Axis of the rotation.
        size: Scale factor over time.
    """
    joints: list[Joint] = []
    place = position, rotation
    steps: tuple[tuple[str, Kind, Vector, Motion | None], ...] = (
        ("x", "slide", AXES["x"], x),
        ("y", "slide", AXES["y"], y),
        ("z", "slide", AXES["z"], z),
        ("turn", "hinge", axis, turn),
        ("size", "scale", AXES["z"], size),
    )
    for suffix, kind, along, motion in steps:
        if motion is not None:
            joints.append(Joint(f"{name} {suffix}", parent, *place, kind, along, motion))
            parent, place = joints[-1].name, (ORIGIN, ORIGIN)
    return [*joints, Joint(name, parent, *place)]


def rod(start: Vector, stop: Vector, radius: float, surface: Surface, joint: str = WORLD) -> Part:
    """A capsule between two points."""
    way = [b - a for a, b in zip(start, stop, strict=True)]
    length = math.hypot(*way)
    x, y, z = ((a + b) / 2 for a, b in zip(start, stop, strict=True))
    # Rotated about y, then about z.
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, way[2] / length))))
    turn = math.degrees(math.atan2(way[1], way[0]))
    return Part(Capsule(radius, length / 2), surface, joint, (x, y, z), (0.0, tilt, turn))


def chain(
    points: Sequence[Vector], radius: float, surface: Surface, joint: str = WORLD
) -> list[Part]:
    """Capsules along a polyline."""
    pairs = zip(points[:-1], points[1:], strict=True)
    return [rod(start, stop, radius, surface, joint) for start, stop in pairs]


def around(count: int, radius: float, height: float = 0.0, start: float = 0.0) -> list[Vector]:
    """Points with even spacing on a horizontal circle around z, from ``start`` degrees on."""
    angles = [math.radians(start) + 2 * math.pi * i / count for i in range(count)]
    return [(radius * math.cos(a), radius * math.sin(a), height) for a in angles]


def numbered(count: int, start: float = 0.0) -> Iterator[tuple[int, float]]:
    """Indices and azimuths in degrees of the points of `around`."""
    return ((i, start + 360.0 * i / count) for i in range(count))
