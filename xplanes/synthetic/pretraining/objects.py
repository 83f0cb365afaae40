"""Procedural objects, one for each seed."""

import colorsys
import math

import numpy as np
from numpy.typing import NDArray

from xplanes.synthetic.pretraining.solids import (
    BOX,
    BRICKS,
    CAPSULE,
    CHECKER,
    CYLINDER,
    ELLIPSOID,
    PLAIN,
    SECTORS,
    STRIPES,
    TORUS,
    Array,
    Solids,
)

Vector = tuple[float, float, float]
Pattern = tuple[int, tuple[Vector, Vector, Vector], tuple[float, ...]]
"""Kind, three colours, and parameters as listed in `solids`."""

ORIGIN: Vector = (0.0, 0.0, 0.0)


def place(position: Vector = ORIGIN, turn: Vector = ORIGIN, scale: float = 1.0) -> Array:
    """A similarity: scale, rotations about x, y and z in degrees, translation. [4, 4]"""
    (a, b, c), frame = (math.radians(angle) for angle in turn), np.eye(4)
    sa, ca, sb, cb, sc, cc = (f(v) for v in (a, b, c) for f in (math.sin, math.cos))
    frame[:3, :3] = [
        [cc * cb * scale, (cc * sb * sa - sc * ca) * scale, (cc * sb * ca + sc * sa) * scale],
        [sc * cb * scale, (sc * sb * sa + cc * ca) * scale, (sc * sb * ca - cc * sa) * scale],
        [-sb * scale, cb * sa * scale, cb * ca * scale],
    ]
    frame[:3, 3] = position
    return frame


class Builder:
    """Collects the parts of one object.

    Args:
        random: Source of all random choices.
    """

    def __init__(self, random: np.random.Generator) -> None:
        self.random = random
        self._kinds: list[int] = []
        self._sizes: list[Vector] = []
        self._frames: list[Array] = []
        self._patterns: list[Pattern] = []

    def add(self, frame: Array, kind: int, size: tuple[float, ...], pattern: Pattern) -> None:
        """Add a part; its size is in units of the frame."""
        self._kinds.append(kind)
        self._sizes.append((*size, *(1.0,) * (3 - len(size))))  # type: ignore[arg-type]
        self._frames.append(frame)
        self._patterns.append(pattern)

    def solids(self, light: NDArray) -> Solids:
        """All parts so far."""
        frames = np.stack(self._frames)
        scales = np.linalg.norm(frames[:, :3, 0], axis=-1)
        numbers = [(*n, *(0.0,) * (4 - len(n))) for _, _, n in self._patterns]
        return Solids(
            np.array(self._kinds),
            np.array(self._sizes, dtype=np.float64) * scales[:, None],
            np.ascontiguousarray(frames[:, :3, :3] / scales[:, None, None]),
            np.ascontiguousarray(frames[:, :3, 3]),
            np.array([kind for kind, _, _ in self._patterns]),
            np.array([paints for _, paints, _ in self._patterns], dtype=np.float64),
            np.array(numbers, dtype=np.float64),
            np.asarray(light, dtype=np.float64),
        )

    def uniform(self, low: float, high: float) -> float:
        """A uniform random number in [low, high)."""
        return float(self.random.uniform(low, high))

    def count(self, low: int, high: int) -> int:
        """A random integer in [low, high]."""
        return int(self.random.integers(low, high + 1))

    def chance(self, share: float) -> bool:
        """True with this probability."""
        return bool(self.random.random() < share)

    def paint(self) -> Vector:
        """A colour: strong, natural, or close to grey."""
        taste, hue = self.random.random(), self.random.random()
        if taste < 0.5:
            saturation, value = self.uniform(0.4, 1), self.uniform(0.55, 1)
        elif taste < 0.75:
            hue, saturation, value = 0.4 * hue, self.uniform(0.15, 0.65), self.uniform(0.4, 1)
        else:
            saturation, value = self.uniform(0, 0.12), self.uniform(0.15, 1)
        return colorsys.hsv_to_rgb(hue, saturation, value)

    def pattern(self, size: float, plain: float = 0.6) -> Pattern:
        """A pattern for a part of this size; plain with the probability ``plain``."""
        paints = (self.paint(), self.paint(), self.paint())
        if self.chance(plain):
            mottle = self.uniform(0.02, 0.15) if self.chance(0.3) else 0.0
            return PLAIN, paints, (mottle, self.uniform(0.1, 0.6))
        kind, cell = self.count(STRIPES, SECTORS), size * self.uniform(0.2, 0.7)
        if kind == STRIPES:
            return kind, paints, (float(self.count(0, 2)), cell, float(self.count(2, 3)))
        if kind == CHECKER:
            return kind, paints, (cell, cell, cell, float(self.count(2, 3)))
        if kind == BRICKS:
            return kind, paints, (cell, 0.4 * cell, 0.07 * cell)
        return kind, paints, (float(self.count(2, 8) * 2), float(self.count(2, 3)))

    def plain(self) -> Pattern:
        """One colour."""
        return PLAIN, (self.paint(), ORIGIN, ORIGIN), (0.0, 1.0)


def lump(b: Builder, frame: Array, size: float, turned: bool = True) -> None:
    """A random solid at the origin of the frame."""
    angles = (b.uniform(0, 360), b.uniform(0, 360), b.uniform(0, 360))
    frame = frame @ place(turn=angles if turned else (0.0, 0.0, angles[2]))
    kind = b.count(BOX, TORUS)
    if kind in (BOX, ELLIPSOID):
        if b.chance(0.3):
            extent = (size, size, size)
        else:
            extent = tuple(size * b.uniform(0.3, 1) for _ in range(3))
    elif kind == TORUS:
        extent = (0.7 * size, size * b.uniform(0.1, 0.3))
    else:
        extent = (size * b.uniform(0.2, 0.8), size * b.uniform(0.2, 0.8))
    b.add(frame, kind, extent, b.pattern(size))


def limb(b: Builder, frame: Array, links: int, length: float, thick: float, bend: float) -> Array:
    """Add a chain along -z with randomly bent joints; returns the frame at its end."""
    pattern, same, box = b.pattern(length), b.chance(0.6), b.chance(0.3)
    for _ in range(links):
        frame = frame @ place(turn=(b.uniform(-bend, bend), b.uniform(-bend, bend), 0))
        middle = frame @ place((0, 0, -0.5 * length))
        if box:
            b.add(middle, BOX, (thick, thick, 0.5 * length), pattern)
        else:
            b.add(middle, CAPSULE, (thick, 0.5 * length), pattern)
        frame = frame @ place((0, 0, -length))
        length, thick = length * b.uniform(0.75, 1.05), thick * b.uniform(0.7, 1.0)
        pattern = pattern if same else b.pattern(length)
    return frame


def machine(b: Builder, frame: Array) -> None:
    """A vehicle on wheels or tracks, with a body that may turn, cabins, boxes and arms."""
    long, wide = b.uniform(0.4, 0.8), b.uniform(0.2, 0.4)
    radius, dark = b.uniform(0.08, 0.2), b.pattern(0.15)
    if b.chance(0.4):
        for side in (-wide, wide):
            b.add(frame @ place((0, side, radius)), BOX, (long, 0.3 * wide, radius), dark)
            for end in (-long, long):
                at = frame @ place((end, side, radius), (90, 0, 0))
                b.add(at, CYLINDER, (radius, 0.3 * wide), dark)
    else:
        for x in np.linspace(-0.75 * long, 0.75 * long, b.count(2, 4)):
            for side in (-wide, wide):
                at = frame @ place((float(x), side, radius), (90, 0, 0))
                b.add(at, CYLINDER, (radius, b.uniform(0.03, 0.09)), dark)
    level, half = 1.2 * radius, b.uniform(0.05, 0.18)
    b.add(frame @ place((0, 0, level + half)), BOX, (long, 0.8 * wide, half), b.pattern(0.3, 0.8))
    top = frame @ place((0, 0, level + 2 * half))
    if b.chance(0.5):
        b.add(top @ place((0, 0, 0.03)), CYLINDER, (0.8 * wide, 0.04), b.plain())
        top = top @ place((0, 0, 0.06), (0, 0, b.uniform(0, 360)))
    body = b.pattern(0.3, 0.8)
    for _ in range(b.count(1, 3)):
        x, y = b.uniform(-0.6, 0.6) * long, b.uniform(-0.3, 0.3) * wide
        size = (b.uniform(0.12, 0.45) * long, b.uniform(0.4, 0.9) * wide, b.uniform(0.06, 0.3))
        b.add(top @ place((x, y, size[2])), BOX, size, body if b.chance(0.5) else b.pattern(0.3))
        if b.chance(0.5):
            pane = (0.8 * size[0], 1.04 * size[1], 0.4 * size[2])
            b.add(top @ place((x, y, 1.3 * size[2])), BOX, pane, b.plain())
    for _ in range(b.count(0, 2)):
        root = top @ place((b.uniform(-0.8, 0.8) * long, b.uniform(-0.5, 0.5) * wide, 0.1))
        turn = (0, 180 + b.uniform(-70, 70), b.uniform(-40, 40))
        thick = b.uniform(0.03, 0.08)
        end = limb(b, root @ place(turn=turn), b.count(1, 3), b.uniform(0.25, 0.5), thick, 50)
        if b.chance(0.7):
            lump(b, end, b.uniform(0.08, 0.2))
    if b.chance(0.5):
        lump(b, top @ place((b.uniform(-1, 1) * long, 0, b.uniform(0, 0.2))), b.uniform(0.1, 0.3))


def figure(b: Builder, frame: Array) -> None:
    """A person with trunk, head, arms and legs in a random pose."""
    leg, trunk, wide = b.uniform(0.25, 0.45), b.uniform(0.25, 0.4), b.uniform(0.1, 0.2)
    thick = b.uniform(0.05, 0.09)
    hip = frame @ place((0, 0, 2 * leg), (b.uniform(-8, 8), b.uniform(-15, 15), 0))
    deep = wide * b.uniform(0.6, 1)
    shirt = b.pattern(0.2)
    b.add(hip, ELLIPSOID, (deep, wide, 0.15), b.pattern(0.2))
    chest = hip @ place((0, 0, 0.6 * trunk), (0, b.uniform(-15, 15), b.uniform(-20, 20)))
    kind = b.count(BOX, CYLINDER)
    size = (deep, 0.55 * trunk) if kind == CYLINDER else (deep, 1.1 * wide, 0.6 * trunk)
    b.add(chest, kind, size, shirt)
    for side in (-1, 1):
        foot = limb(b, hip @ place((0, 0.6 * side * wide, 0)), 2, leg, thick, 30)
        b.add(foot @ place((0.05, 0, 0)), ELLIPSOID, (0.13, 0.06, 0.05), b.plain())
        shoulder = chest @ place((0, side * (wide + 0.05), 0.45 * trunk), (side * 20, 0, 0))
        hand = limb(b, shoulder, 2, 0.75 * leg, 0.75 * thick, 70)
        if b.chance(0.4):
            lump(b, hand, b.uniform(0.05, 0.2))
    neck = chest @ place((0, 0, 0.6 * trunk))
    head = neck @ place((0, 0, 0.17), (0, b.uniform(-15, 15), b.uniform(-40, 40)))
    size = (b.uniform(0.12, 0.17), b.uniform(0.12, 0.17), b.uniform(0.14, 0.2))
    b.add(head, ELLIPSOID if b.chance(0.8) else BOX, size, b.plain())
    if b.chance(0.6):
        hair = tuple(1.06 * s for s in size)
        b.add(head @ place((-0.02, 0, 0.05)), ELLIPSOID, hair, b.pattern(0.1))
    if b.chance(0.5):
        b.add(neck, TORUS, (0.09, 0.04), b.pattern(0.1))
    if b.chance(0.4):
        back = chest @ place((-deep - 0.06, 0, 0.05))
        b.add(back, BOX, (0.09, 0.8 * wide, 0.45 * trunk), b.pattern(0.2))
    for side in (-1, 1):
        b.add(head @ place((0.93 * size[0], 0.05 * side, 0.02)), ELLIPSOID, (0.025,) * 3, b.plain())


def beast(b: Builder, frame: Array) -> None:
    """An animal with four or six legs, neck, head and tail."""
    long, fat, leg = b.uniform(0.35, 0.65), b.uniform(0.15, 0.3), b.uniform(0.15, 0.35)
    body, skin = frame @ place((0, 0, 2 * leg), (0, b.uniform(-15, 15), 0)), b.pattern(0.3)
    b.add(body, ELLIPSOID, (long, fat, fat * b.uniform(0.7, 1.2)), skin)
    for x in np.linspace(-0.65 * long, 0.65 * long, b.count(2, 3)):
        for side in (-0.6 * fat, 0.6 * fat):
            limb(b, body @ place((float(x), side, 0)), 2, leg, b.uniform(0.04, 0.09), 25)
    neck = body @ place((0.8 * long, 0, 0.2 * fat), (0, b.uniform(-30, 60) + 180, 0))
    head = limb(b, neck, b.count(1, 3), b.uniform(0.12, 0.3), b.uniform(0.06, 0.13), 25)
    b.add(head, ELLIPSOID, (b.uniform(0.1, 0.2), b.uniform(0.08, 0.14), b.uniform(0.1, 0.2)), skin)
    for side in (-1, 1):
        b.add(head @ place((0, 0.08 * side, -0.1)), ELLIPSOID, (0.03, 0.03, 0.08), b.plain())
    tail = body @ place((-0.9 * long, 0, 0), (0, b.uniform(10, 120), 0))
    limb(b, tail, b.count(1, 4), b.uniform(0.12, 0.25), b.uniform(0.03, 0.09), 30)


def tower(b: Builder, frame: Array) -> None:
    """A tower with storeys and a roof, and optionally sails, windows or a mast."""
    radius, taper, level = b.uniform(0.2, 0.45), b.uniform(0.75, 1.0), 0.0
    wall, round_, turn = b.pattern(0.3, 0.3), b.chance(0.5), b.uniform(0, 90)
    for _ in range(b.count(1, 5)):
        half = b.uniform(0.08, 0.25)
        at = frame @ place((0, 0, level + half), (0, 0, turn))
        if round_:
            b.add(at, CYLINDER, (radius, half), wall)
        else:
            b.add(at, BOX, (radius, radius * b.uniform(0.6, 1), half), wall)
        for _ in range(b.count(0, 3)):
            angle = b.uniform(0, 360)
            pane = at @ place(turn=(0, 0, angle)) @ place((0.95 * radius, 0, 0))
            b.add(pane, BOX, (0.06, b.uniform(0.03, 0.08), 0.6 * half), b.plain())
        level, radius = level + 2 * half, radius * taper
        wall = wall if b.chance(0.7) else b.pattern(0.3, 0.3)
    top = frame @ place((0, 0, level), (0, 0, b.uniform(0, 360)))
    b.add(top, ELLIPSOID if b.chance(0.6) else BOX, (1.1 * radius, radius, radius), b.pattern(0.2))
    if b.chance(0.5):
        turn = (b.uniform(0, 360), b.uniform(-15, 5), 0.0)
        hub = top @ place((1.2 * radius, 0, 0.3 * radius), turn)
        b.add(hub, ELLIPSOID, (0.07, 0.06, 0.06), b.plain())
        spar, cloth = b.plain(), b.pattern(0.2, 0.3)
        blades, reach, broad = b.count(2, 6), b.uniform(0.25, 0.5), b.uniform(0.03, 0.1)
        for blade in range(blades):
            arm = hub @ place(turn=(360 / blades * blade, 0, 0))
            b.add(arm @ place((0, 0, reach)), BOX, (0.015, 0.02, reach), spar)
            b.add(arm @ place((0, broad, 1.1 * reach)), BOX, (0.01, broad, 0.8 * reach), cloth)
    elif b.chance(0.6):
        b.add(top @ place((0, 0, radius + 0.1)), CYLINDER, (0.03, b.uniform(0.1, 0.3)), b.plain())


def craft(b: Builder, frame: Array) -> None:
    """A ship, plane or rocket: a long hull with wings, fins and a mast."""
    long, fat = b.uniform(0.5, 0.8), b.uniform(0.12, 0.25)
    turn = (b.uniform(-20, 20), b.uniform(-30, 30), b.uniform(0, 360))
    hull = frame @ place((0, 0, b.uniform(0.3, 0.8)), turn)
    b.add(hull, ELLIPSOID, (long, fat, fat), b.pattern(0.3))
    for _ in range(b.count(1, 3)):
        x, span, deep = b.uniform(-0.8, 0.5) * long, b.uniform(0.3, 0.8), b.uniform(0.06, 0.2)
        tilt = (b.uniform(-15, 15) if b.chance(0.7) else 90.0, 0, 0)
        b.add(hull @ place((x, 0, b.uniform(-0.5, 1) * fat), tilt), BOX, (deep, span, 0.025),
              b.pattern(0.2))  # fmt: skip
    for side in (-1, 1):
        pod = hull @ place((b.uniform(-0.2, 0.2), 0.35 * side, 0), (0, 90, 0))
        b.add(pod, CAPSULE, (b.uniform(0.04, 0.09), b.uniform(0.08, 0.2)), b.plain())
    b.add(hull @ place((-0.8 * long, 0, fat)), BOX, (0.08, 0.02, 0.2), b.plain())
    b.add(hull @ place((0.5 * long, 0, 0.7 * fat)), ELLIPSOID, (0.15, 0.09, 0.1), b.plain())


def furniture(b: Builder, frame: Array) -> None:
    """A table, stool or chair, optionally with objects on it."""
    wide, deep, high = b.uniform(0.3, 0.7), b.uniform(0.3, 0.7), b.uniform(0.2, 0.7)
    thick, wood = b.uniform(0.03, 0.07), b.pattern(0.3)
    for x in (-0.85 * wide, 0.85 * wide):
        for y in (-0.85 * deep, 0.85 * deep):
            at = frame @ place((x, y, 0.5 * high))
            if b.chance(0.5):
                b.add(at, CYLINDER, (thick, 0.5 * high), wood)
            else:
                b.add(at, BOX, (thick, thick, 0.5 * high), wood)
    board = wood if b.chance(0.5) else b.pattern(0.3)
    b.add(frame @ place((0, 0, high)), BOX, (wide, deep, 0.04), board)
    if b.chance(0.5):
        back = b.uniform(0.2, 0.5)
        b.add(frame @ place((-0.9 * wide, 0, high + back)), BOX, (0.04, deep, back), b.pattern(0.3))
    for _ in range(b.count(0, 4)):
        size = b.uniform(0.06, 0.2)
        spot = (b.uniform(-0.7, 0.7) * wide, b.uniform(-0.7, 0.7) * deep, high + 0.04 + 0.7 * size)
        lump(b, frame @ place(spot), size, b.chance(0.5))


def plant(b: Builder, frame: Array) -> None:
    """A tree, cactus or lamp: a stem with crowns and branches."""
    high = b.uniform(0.3, 0.9)
    root = frame @ place(turn=(180, 0, 0))
    stem = limb(b, root, b.count(1, 3), 0.4 * high, b.uniform(0.03, 0.1), 12)
    crown = b.pattern(0.3)
    for _ in range(b.count(1, 4)):
        spot = tuple(float(v) for v in b.random.normal(0, 0.12, 3))
        size = tuple(b.uniform(0.1, 0.3) for _ in range(3))
        b.add(stem @ place(spot), ELLIPSOID if b.chance(0.8) else CYLINDER, size, crown)  # type: ignore[arg-type]
    for _ in range(b.count(0, 3)):
        spot = frame @ place((0, 0, b.uniform(0.2, 0.7) * high), (0, 0, b.uniform(0, 360)))
        limb(b, spot @ place(turn=(0, b.uniform(-140, -90), 0)), b.count(1, 2), 0.2, 0.04, 40)


def heap(b: Builder, frame: Array) -> None:
    """Random solids at random positions."""
    for _ in range(b.count(2, 9)):
        size = b.uniform(0.1, 0.4)
        angle, far = b.uniform(0, 2 * math.pi), 0.8 * math.sqrt(b.random.random())
        spot = (far * math.cos(angle), far * math.sin(angle), 0.7 * size)
        if b.chance(0.4):
            spot = (spot[0], spot[1], b.uniform(0, 1.2))
        lump(b, frame @ place(spot), size, b.chance(0.5))


FAMILIES = (machine, figure, beast, tower, craft, furniture, plant, heap)
SHARES = (0.24, 0.2, 0.08, 0.14, 0.06, 0.08, 0.06, 0.14)
"""Probability of each kind of main object."""


TRAINING_SEEDS = range(2**30)
"""Seeds of training objects."""

HELD_OUT_SEEDS = range(2**30, 2**31)
"""Seeds of held-out objects."""

STREAM = 70_203
"""Random stream of the objects, independent of all other streams."""


def procedural_object(seed: int) -> Solids:
    """The object of a seed, within about 1.2 of the origin along each axis, z up.

    Args:
        seed: One of `TRAINING_SEEDS` or `HELD_OUT_SEEDS`.

    Raises:
        ValueError: If the seed is in neither range.
    """
    if seed not in TRAINING_SEEDS and seed not in HELD_OUT_SEEDS:
        raise ValueError(f"seed={seed}: must be from 0 to {HELD_OUT_SEEDS.stop - 1}")
    b = Builder(np.random.default_rng([STREAM, seed]))
    ground = _ground(b) if b.chance(0.75) else 0.0
    main = FAMILIES[int(b.random.choice(len(FAMILIES), p=SHARES))]
    spot = (b.uniform(-0.2, 0.2), b.uniform(-0.2, 0.2), 0.0)
    main(b, place(spot, (0, 0, b.uniform(0, 360)), b.uniform(0.7, 1.1)))
    for _ in range(b.count(0, 4) if ground else b.count(0, 1)):
        _prop(b, max(ground, 0.6))
    return _framed(b, b.solids(_light(b)))


def _ground(b: Builder) -> float:
    """Add a ground plate below the object; returns its extent."""
    reach, thick = b.uniform(0.5, 1.0), b.uniform(0.015, 0.08)
    at = place((0, 0, -thick), (0, 0, b.uniform(0, 90)))
    if b.chance(0.5):
        b.add(at, BOX, (reach, reach * b.uniform(0.6, 1), thick), b.pattern(0.4, 0.5))
    else:
        b.add(at, CYLINDER, (reach, thick), b.pattern(0.4, 0.5))
        if b.chance(0.3):
            b.add(at, TORUS, (reach, b.uniform(0.02, 0.05)), b.plain())
    if b.chance(0.3):
        patch = place((0, 0, 0), (0, 0, b.uniform(0, 90)))
        b.add(patch, BOX, (0.6 * reach, b.uniform(0.2, 0.6) * reach, 0.01), b.pattern(0.3, 0.4))
    return reach


def _prop(b: Builder, reach: float) -> None:
    """Add a small object beside the main one."""
    angle, far = b.uniform(0, 2 * math.pi), reach * b.uniform(0.5, 0.9)
    spot = (far * math.cos(angle), far * math.sin(angle), 0.0)
    kind = b.count(0, 4)
    if kind < 2:
        size = b.uniform(0.05, 0.25)
        lump(b, place((spot[0], spot[1], 0.7 * size)), size, kind == 0)
    elif kind == 2:
        plant(b, place(spot, (0, 0, b.uniform(0, 360)), b.uniform(0.3, 0.7)))
    elif kind == 3:
        heap(b, place(spot, scale=b.uniform(0.1, 0.35)))
    else:
        size = (b.uniform(0.03, 0.3), b.uniform(0.03, 0.3), b.uniform(0.03, 0.3))
        at = place((spot[0], spot[1], size[2]), (0, 0, b.uniform(0, 90)))
        b.add(at, BOX, size, b.pattern(0.2))


def _light(b: Builder) -> Array:
    """A random sun from above and ambient light, about as strong as in the demo scenes."""
    turn, rise = b.uniform(0, 2 * math.pi), math.radians(b.uniform(35, 75))
    towards = (math.cos(turn) * math.cos(rise), math.sin(turn) * math.cos(rise), math.sin(rise))
    sun, sky, ambient = b.uniform(0.4, 0.6), b.uniform(0.15, 0.28), b.uniform(0.32, 0.45)
    return np.array([*towards, sun, sky, ambient, b.uniform(0.4, 0.7)])


def _framed(b: Builder, solids: Solids) -> Solids:
    """Centre the object and scale it to fit into the view of the cameras."""
    low, high = solids.bounds()
    half = 0.5 * (high - low)
    scale = min(b.uniform(1.1, 1.7) / float(np.linalg.norm(half)), 1.1 / float(half.max()))
    jitter = b.random.uniform(-0.08, 0.08, 3)
    return solids.moved(scale, jitter - scale * 0.5 * (low + high))
