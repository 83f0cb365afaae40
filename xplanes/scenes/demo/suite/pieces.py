"""What the scenes of the suite are put together from."""

import math
from collections.abc import Iterator, Sequence

from xplanes.scenes.demo.assembly import WORLD, Joint, Part, Vector
from xplanes.scenes.demo.geometry import Capsule, Ellipsoid, Surface
from xplanes.scenes.demo.motions import Motion

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
    """Joints that slide along x, y and z, then turn, then scale; the last has the name.

    Args:
        name: Name for the parts to be carried.
        position: Place from which it slides.
        rotation: Angles about x, y and z in degrees.
        parent: Joint that carries all of it.
        x: Way along x; y and z likewise.
        y: Way along y.
        z: Way along z.
        turn: Degrees about ``axis``.
        axis: Axis of the turn.
        size: Factor of the size.
    """
    joints: list[Joint] = []

    def add(suffix: str, **changes) -> None:
        place = (position, rotation) if not joints else (ORIGIN, ORIGIN)
        joints.append(Joint(f"{name} {suffix}", parent, *place, **changes))

    for key, motion in (("x", x), ("y", y), ("z", z)):
        if motion is not None:
            add(key, kind="slide", axis=AXES[key], motion=motion)
            parent = joints[-1].name
    if turn is not None:
        add("turn", kind="hinge", axis=axis, motion=turn)
        parent = joints[-1].name
    if size is not None:
        add("size", kind="scale", motion=size)
        parent = joints[-1].name
    place = (position, rotation) if not joints else (ORIGIN, ORIGIN)
    return [*joints, Joint(name, parent, *place)]


def rod(start: Vector, stop: Vector, radius: float, surface: Surface, joint: str = WORLD) -> Part:
    """A rod with round ends between two points."""
    way = [b - a for a, b in zip(start, stop, strict=True)]
    length = math.hypot(*way)
    x, y, z = ((a + b) / 2 for a, b in zip(start, stop, strict=True))
    # Tilted about y, then turned about z.
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, way[2] / length))))
    turn = math.degrees(math.atan2(way[1], way[0]))
    return Part(Capsule(radius, length / 2), surface, joint, (x, y, z), (0.0, tilt, turn))


def chain(
    points: Sequence[Vector], radius: float, surface: Surface, joint: str = WORLD
) -> list[Part]:
    """Rods from each point to the next."""
    pairs = zip(points[:-1], points[1:], strict=True)
    return [rod(start, stop, radius, surface, joint) for start, stop in pairs]


def around(count: int, radius: float, height: float = 0.0, start: float = 0.0) -> list[Vector]:
    """Points evenly spaced on a level circle around the z axis, the first at ``start`` degrees."""
    angles = [math.radians(start) + 2 * math.pi * i / count for i in range(count)]
    return [(radius * math.cos(a), radius * math.sin(a), height) for a in angles]


def numbered(count: int, start: float = 0.0) -> Iterator[tuple[int, float]]:
    """Numbers with the directions of `around` in degrees."""
    return ((i, start + 360.0 * i / count) for i in range(count))
