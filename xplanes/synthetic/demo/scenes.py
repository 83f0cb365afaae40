"""The demo scenes by name."""

import difflib
import math
from collections.abc import Callable
from dataclasses import dataclass

from xplanes.errors import SceneError
from xplanes.synthetic.demo.assembly import Assembly, Joint, Part, Vector
from xplanes.synthetic.demo.geometry import (
    Box,
    Bricks,
    Capsule,
    Checker,
    Colour,
    Cylinder,
    Ellipsoid,
    Plain,
    Sectors,
    Stripes,
    Surface,
    Torus,
)
from xplanes.synthetic.demo.motions import Bounce, Keys, Steady, Swing, Variation

_FLOOR = -0.55


def balls(variation: Variation) -> Assembly:
    """Five balls bounce with different periods and spin; plate and posts are static."""
    joints: list[Joint] = []
    parts = _plate(variation)
    for number, (x, y, radius, height, count, phase, surface) in enumerate(_balls(variation)):
        jump = Bounce(height, count, variation.phase(phase))
        spin = Steady(40.0 * number, 90.0 * (1 if number % 2 else -1))
        joints += [
            Joint(f"jump {number}", "world", (x, y, _FLOOR + radius), (0, 0, 0), "slide",
                  (0, 0, 1), jump),
            Joint(f"spin {number}", f"jump {number}", (0, 0, 0), (25, -20, 0), "hinge",
                  (0.3, 0.2, 1), spin),
        ]  # fmt: skip
        parts.append(Part(Ellipsoid((radius, radius, radius)), surface, f"spin {number}"))
    return Assembly(tuple(parts), tuple(joints))


Ball = tuple[float, float, float, float, float, float, Surface]
"""Position (x, y), radius, bounce height, number of bounces, phase and surface."""


def _balls(variation: Variation) -> list[Ball]:
    white = (0.96, 0.96, 0.94)
    red, blue = variation.paint("#d93a2f"), variation.paint("#2f6fc4")
    gold, green = variation.paint("#f2b632"), variation.paint("#3f9b57")
    purple, orange = variation.paint("#7a4fa3"), variation.natural("#d8752c")
    return [
        (0.4, -0.36, 0.2, 0.62, 2, 0.0, Sectors((red, white, blue, white, gold, white), 6)),
        (-0.4, -0.3, 0.17, 0.85, 2, 0.45, Stripes((green, white, green), 2, 0.085)),
        (0.02, 0.02, 0.24, 0.5, 3, 0.7, Plain(orange, 0.06, 0.05)),
        (-0.36, 0.42, 0.2, 0.7, 2, 0.25, Checker((purple, white), (0.1, 0.1, 0.1))),
        (0.42, 0.4, 0.15, 0.95, 2, 0.8, Sectors((blue, gold), 8)),
    ]


def _plate(variation: Variation) -> list[Part]:
    tiles = Checker((variation.natural("#e9e2d2"), variation.paint("#5f8fa8")), (0.15, 0.15, 1.0))
    wood = Stripes((variation.natural("#8a5a33"), variation.natural("#7a4d2b")), 0, 0.06)
    parts = [Part(Box((0.75, 0.75, 0.04)), tiles, position=(0.0, 0.0, _FLOOR - 0.04))]
    for sign in (-1, 1):
        place = (0.0, 0.775 * sign, _FLOOR - 0.015)
        parts.append(Part(Box((0.8, 0.025, 0.065)), wood, position=place))
        place = (0.775 * sign, 0.0, _FLOOR - 0.015)
        parts.append(Part(Box((0.75, 0.025, 0.065)), wood, "world", place, (0, 0, 90)))
        for other in (-1, 1):
            post = (0.775 * sign, 0.775 * other, _FLOOR + 0.02)
            brass = Plain(variation.natural("#c89b3c"))
            parts.append(Part(Cylinder(0.045, 0.1), brass, position=post))
            top = (post[0], post[1], post[2] + 0.12)
            parts.append(Part(Ellipsoid((0.055, 0.055, 0.055)), brass, position=top))
    return parts


_STEPS = (0.0, 0.22, 0.42, 0.58, 0.8, 1.0)


def excavator(variation: Variation) -> Assembly:
    """Tracks, earth and cones are static; house, boom, arm and bucket move."""
    yellow = variation.paint("#f2b21b")
    dark, steel = variation.natural("#34363b"), variation.natural("#8d949c")
    joints = (
        Joint("slew", position=(-0.3, 0.0, -0.3), kind="hinge", motion=_keys(0, -8, -8, 24, 24, 0)),
        Joint("boom", "slew", (0.2, -0.02, 0.14), (0, -58, 0), "hinge", (0, -1, 0),
              _keys(0, -10, 6, 8, -2, 0)),
        Joint("bend", "boom", (0.36, 0.0, 0.0), (0, 42, 0)),
        Joint("arm", "bend", (0.4, 0.0, 0.0), (0, 92, 0), "hinge", (0, -1, 0),
              _keys(10, 30, -8, 4, 34, 10)),
        Joint("bucket", "arm", (0.46, 0.0, 0.0), (0, 20, 0), "hinge", (0, -1, 0),
              _keys(10, 45, -45, -50, 50, 10)),
    )  # fmt: skip
    parts = (
        *_ground(variation),
        *_tracks(dark, steel),
        *_house(variation, yellow, dark, steel),
        *_limbs(yellow, dark, steel),
    )
    return Assembly(parts, joints).placed((0.0, 0.0, 0.1))


def _keys(*values: float) -> Keys:
    return Keys(_STEPS, values)


def _ground(variation: Variation) -> list[Part]:
    sand = variation.natural("#c9ab78")
    earth = variation.natural("#7d5a3c")
    orange, white = variation.natural("#e8601c"), (0.95, 0.95, 0.93)
    parts = [
        Part(Box((0.88, 0.72, 0.05)), Plain(sand, 0.05, 0.5), position=(0.0, 0.0, -0.65)),
        Part(Ellipsoid((0.27, 0.25, 0.19)), Plain(earth, 0.1, 0.2), position=(0.52, 0.4, -0.51)),
        Part(Ellipsoid((0.17, 0.2, 0.13)), Plain(earth, 0.1, 0.2), position=(0.66, 0.18, -0.56)),
        Part(
            Box((0.34, 0.05, 0.13)),
            Bricks(variation.natural("#a8472f"), variation.natural("#d8cdbb"), 0.17, 0.065, 0.014),
            position=(-0.34, 0.6, -0.47),
        ),
    ]
    for x, y in ((0.72, -0.56), (0.2, -0.6), (-0.74, -0.58)):
        for level, radius in enumerate((0.075, 0.055, 0.04, 0.025)):
            paint = Plain(orange if level % 2 == 0 else white)
            height = 0.02 if level == 0 else 0.03
            position = (x, y, -0.59 + 0.058 * level)
            parts.append(Part(Cylinder(radius, height), paint, position=position))
    return parts


def _tracks(dark: Colour, steel: Colour) -> list[Part]:
    light = (0.42, 0.43, 0.46)
    parts = [Part(Box((0.3, 0.2, 0.07)), Plain(dark), position=(-0.3, 0.0, -0.45))]
    for y in (-0.29, 0.29):
        tread = Stripes((dark, light), axis=0, width=0.052)
        parts.append(Part(Box((0.36, 0.095, 0.115)), tread, position=(-0.3, y, -0.485)))
        for x in (-0.66, 0.06):
            turned = Sectors((dark, light), 14)
            parts.append(Part(Cylinder(0.115, 0.095), turned, "world", (x, y, -0.485), (90, 0, 0)))
        for index in range(5):
            side = y + (0.095 if y > 0 else -0.095)
            place = (-0.62 + 0.16 * index, side, -0.5)
            parts.append(Part(Cylinder(0.062, 0.012), Plain(steel), "world", place, (90, 0, 0)))
    parts.append(Part(Cylinder(0.2, 0.05), Plain(dark), position=(-0.3, 0.0, -0.35)))
    return parts


def _house(variation: Variation, yellow: Colour, dark: Colour, steel: Colour) -> list[Part]:
    glass = variation.natural("#6fb3d3")
    return [
        Part(Box((0.4, 0.28, 0.05)), Plain(dark), "slew", (-0.06, 0.0, 0.055)),
        Part(Box((0.25, 0.28, 0.11)), Plain(yellow), "slew", (-0.17, 0.0, 0.215)),
        Part(Box((0.13, 0.27, 0.012)), Stripes((dark, steel), 0, 0.026), "slew", (-0.2, 0.0, 0.33)),
        Part(Cylinder(0.14, 0.27), Plain(dark), "slew", (-0.41, 0.0, 0.19), (90, 0, 0)),
        Part(Capsule(0.026, 0.1), Plain(steel), "slew", (-0.3, -0.16, 0.4)),
        Part(Box((0.16, 0.125, 0.235)), Plain(yellow), "slew", (0.15, 0.155, 0.335)),
        Part(Box((0.013, 0.1, 0.14)), Plain(glass), "slew", (0.305, 0.155, 0.4)),
        Part(Box((0.12, 0.013, 0.11)), Plain(glass), "slew", (0.15, 0.275, 0.43)),
        Part(Box((0.12, 0.013, 0.11)), Plain(glass), "slew", (0.15, 0.035, 0.43)),
        Part(Box((0.18, 0.14, 0.02)), Plain((0.93, 0.93, 0.9)), "slew", (0.15, 0.155, 0.585)),
        Part(Ellipsoid((0.035, 0.035, 0.045)), Plain(variation.paint("#e0401f")), "slew",
             (0.08, 0.155, 0.62)),
    ]  # fmt: skip


def _limbs(yellow: Colour, dark: Colour, steel: Colour) -> list[Part]:
    bar = Stripes((yellow, dark), 0, 0.085, 0.0)
    parts = [
        Part(Box((0.19, 0.055, 0.075)), Plain(yellow), "boom", (0.18, 0.0, 0.0)),
        Part(Box((0.21, 0.05, 0.062)), Plain(yellow), "bend", (0.2, 0.0, 0.0)),
        Part(Box((0.25, 0.042, 0.05)), bar, "arm", (0.2, 0.0, 0.0)),
        Part(Capsule(0.022, 0.16), Plain(steel), "bend", (0.2, 0.0, 0.1), (0, 90, 0)),
        Part(Capsule(0.03, 0.1), Plain(dark), "bend", (0.12, 0.0, 0.1), (0, 90, 0)),
        Part(Capsule(0.02, 0.15), Plain(steel), "arm", (0.22, 0.0, 0.08), (0, 90, 0)),
        Part(Torus(0.045, 0.014), Plain(dark), "arm", (-0.05, 0.0, 0.06), (90, 0, 0)),
        Part(Box((0.1, 0.13, 0.012)), Plain(dark), "bucket", (0.09, 0.0, 0.06)),
        Part(Box((0.012, 0.13, 0.1)), Plain(dark), "bucket", (0.19, 0.0, -0.03)),
        Part(Box((0.07, 0.13, 0.012)), Plain(dark), "bucket", (0.125, 0.0, -0.125)),
        Part(Box((0.1, 0.012, 0.09)), Plain(dark), "bucket", (0.1, 0.13, -0.035)),
        Part(Box((0.1, 0.012, 0.09)), Plain(dark), "bucket", (0.1, -0.13, -0.035)),
    ]
    pin, tooth = Cylinder(0.06, 0.075), Box((0.035, 0.016, 0.01))
    return [
        *parts,
        *(Part(pin, Plain(steel), joint, (0.0, 0, 0), (90, 0, 0))
          for joint in ("boom", "bend", "arm", "bucket")),
        *(Part(tooth, Plain(steel), "bucket", (0.03, y, -0.13))
          for y in (-0.1, -0.033, 0.033, 0.1)),
    ]  # fmt: skip


_SIDES = (("left", 1.0, 0.0), ("right", -1.0, 0.5))
"""Name, side of the body, and phase of the stride."""

_STRIDES = 2


def walker(variation: Variation) -> Assembly:
    """Arms and legs swing and the body bobs slightly; the ground is static."""
    phase = variation.phase()
    joints = [
        Joint("body", "world", (0.0, 0.0, -0.06), (0, 0, 0), "slide", (0, 0, 1),
              Swing(0.0, 0.018, 2 * _STRIDES, 2 * phase)),
        Joint("chest", "body", (0.0, 0.0, 0.1), (0, 4, 0), "hinge", (0, 0, 1),
              Swing(0.0, 7.0, _STRIDES, phase)),
    ]  # fmt: skip
    parts = [*_walker_ground(variation), *_trunk(variation), *_head(variation)]
    for name, side, lag in _SIDES:
        joints += _limb_joints(name, side, phase + lag)
        parts += _limb_parts(name, variation)
    return Assembly(tuple(parts), tuple(joints)).placed((0.0, 0.0, -0.03))


def _limb_joints(name: str, side: float, phase: float) -> list[Joint]:
    forward = (0, -1, 0)
    return [
        Joint(f"{name} hip", "body", (0.0, 0.1 * side, 0.0), (0, 0, 0), "hinge", forward,
              Swing(4.0, 30.0, _STRIDES, phase)),
        Joint(f"{name} knee", f"{name} hip", (0.0, 0.0, -0.37), (0, 0, 0), "hinge", forward,
              Swing(-28.0, 26.0, _STRIDES, phase - 0.32)),
        Joint(f"{name} shoulder", "chest", (0.0, 0.235 * side, 0.4), (9 * side, 0, 0), "hinge",
              forward, Swing(5.0, 34.0, _STRIDES, phase + 0.5)),
        Joint(f"{name} elbow", f"{name} shoulder", (0.0, 0.0, -0.28), (0, 0, 0), "hinge", forward,
              Swing(32.0, 20.0, _STRIDES, phase + 0.5)),
    ]  # fmt: skip


def _limb_parts(name: str, variation: Variation) -> list[Part]:
    jeans = Plain(variation.natural("#3d5f94"), 0.06, 0.15)
    boot, sole = variation.natural("#8a5a2f"), variation.natural("#2d2a28")
    sleeve = Stripes((variation.paint("#d64535"), (0.95, 0.93, 0.88)), 2, 0.055)
    skin = Plain(variation.natural("#e5ae86"))
    return [
        Part(Capsule(0.09, 0.15), jeans, f"{name} hip", (0.0, 0.0, -0.19)),
        Part(Capsule(0.072, 0.14), jeans, f"{name} knee", (0.0, 0.0, -0.17)),
        Part(Cylinder(0.082, 0.045), Plain(boot), f"{name} knee", (0.0, 0.0, -0.31)),
        Part(Ellipsoid((0.14, 0.078, 0.07)), Plain(boot), f"{name} knee", (0.05, 0.0, -0.37)),
        Part(Box((0.145, 0.075, 0.02)), Plain(sole), f"{name} knee", (0.05, 0.0, -0.415)),
        Part(Capsule(0.066, 0.11), sleeve, f"{name} shoulder", (0.0, 0.0, -0.13)),
        Part(Capsule(0.054, 0.1), sleeve, f"{name} elbow", (0.0, 0.0, -0.11)),
        Part(Ellipsoid((0.055, 0.045, 0.07)), skin, f"{name} elbow", (0.0, 0.0, -0.27)),
    ]


def _walker_ground(variation: Variation) -> list[Part]:
    grass, stone = variation.natural("#7fa653"), variation.natural("#b9b2a3")
    slab = Checker((stone, variation.natural("#d6cfbf")), (0.19, 0.19, 1.0))
    return [
        Part(Cylinder(0.72, 0.04), Plain(grass, 0.08, 0.3), position=(0.0, 0.0, -0.95)),
        Part(Box((0.57, 0.285, 0.02)), slab, position=(0.0, 0.0, -0.915)),
    ]


def _trunk(variation: Variation) -> list[Part]:
    shirt = Stripes((variation.paint("#d64535"), (0.95, 0.93, 0.88)), 2, 0.07)
    jeans = Plain(variation.natural("#3d5f94"), 0.06, 0.15)
    pack, strap = variation.paint("#3f7d5c"), variation.natural("#5b4630")
    return [
        Part(Ellipsoid((0.135, 0.2, 0.14)), jeans, "body", (0.0, 0.0, 0.02)),
        Part(Torus(0.15, 0.028), Plain(strap), "body", (0.0, 0.0, 0.12)),
        Part(Cylinder(0.155, 0.12), shirt, "chest", (0.0, 0.0, 0.12)),
        Part(Ellipsoid((0.155, 0.225, 0.24)), shirt, "chest", (0.0, 0.0, 0.25)),
        Part(Box((0.085, 0.16, 0.19)), Plain(pack, 0.05, 0.2), "chest", (-0.21, 0.0, 0.28)),
        Part(Box((0.04, 0.11, 0.08)), Plain(strap), "chest", (-0.3, 0.0, 0.2)),
        Part(Capsule(0.06, 0.13), Plain(variation.paint("#e0b040")), "chest", (-0.21, 0.0, 0.51),
             (90, 0, 0)),
    ]  # fmt: skip


def _head(variation: Variation) -> list[Part]:
    skin, hair = variation.natural("#e5ae86"), variation.natural("#5a3a22")
    scarf, hat = variation.paint("#f0c23c"), variation.paint("#c43d33")
    white, black = (0.97, 0.97, 0.96), (0.1, 0.1, 0.12)
    stripes = Sectors((hat, white), 12)
    parts = [
        Part(Torus(0.085, 0.045), Sectors((scarf, white), 16), "chest", (0.0, 0.0, 0.5)),
        Part(Ellipsoid((0.15, 0.14, 0.17)), Plain(skin), "chest", (0.0, 0.0, 0.67)),
        Part(Ellipsoid((0.15, 0.15, 0.16)), Plain(hair), "chest", (-0.03, 0.0, 0.69)),
        Part(Ellipsoid((0.165, 0.16, 0.13)), stripes, "chest", (-0.01, 0.0, 0.76)),
        Part(Torus(0.135, 0.035), Plain(hat), "chest", (-0.005, 0.0, 0.74)),
        Part(Ellipsoid((0.045, 0.045, 0.045)), Plain(white), "chest", (-0.01, 0.0, 0.91)),
        Part(Ellipsoid((0.035, 0.024, 0.026)), Plain(skin), "chest", (0.15, 0.0, 0.64)),
        Part(Capsule(0.012, 0.035), Plain((0.72, 0.3, 0.28)), "chest", (0.122, 0.0, 0.575),
             (90, 0, 0)),
    ]  # fmt: skip
    for side in (-1, 1):
        eye = (0.125, 0.055 * side, 0.675)
        parts.append(Part(Ellipsoid((0.022, 0.022, 0.028)), Plain(black), "chest", eye))
    return parts


_GROUND = -0.72


def windmill(variation: Variation) -> Assembly:
    """The sails rotate and the cap turns slightly; the island is static."""
    joints = (
        Joint("cap", "world", (0.0, 0.0, 0.28), (0, 0, 0), "hinge", (0, 0, 1),
              Swing(0.0, 12.0, 1.0, variation.phase())),
        Joint("sails", "cap", (0.34, 0.0, 0.06), (0, -6, 0), "hinge", (1, 0, 0),
              Steady(360 * variation.phase(), 200.0)),
    )  # fmt: skip
    parts = [*_island(variation), *_tower(variation), *_cap(variation), *_sails(variation)]
    return Assembly(tuple(parts), joints)


def _island(variation: Variation) -> list[Part]:
    grass, soil = variation.natural("#86ad55"), variation.natural("#8c6a48")
    bark, crown = Plain(variation.natural("#6b4a2d")), variation.natural("#6aa552")
    fence = Stripes(((0.95, 0.94, 0.9), variation.natural("#c9bda5")), 0, 0.06)
    parts = [
        Part(Cylinder(0.84, 0.03), Plain(grass, 0.07, 0.35), position=(0, 0, _GROUND - 0.03)),
        Part(Cylinder(0.8, 0.04), Plain(soil, 0.06, 0.2), position=(0, 0, _GROUND - 0.1)),
        Part(Box((0.24, 0.09, 0.006)), Checker((variation.natural("#cbb994"),
             variation.natural("#b8a47c")), (0.08, 0.06, 1.0)), position=(0.54, 0.0, _GROUND)),
    ]  # fmt: skip
    for x, y, size in ((-0.45, -0.42, 1.0), (-0.6, 0.12, 0.8), (0.18, 0.58, 0.9)):
        leaves = Plain(crown, 0.14, 0.12)
        parts += [
            Part(Cylinder(0.035 * size, 0.1 * size), bark, position=(x, y, _GROUND + 0.1 * size)),
            Part(Ellipsoid((0.17 * size, 0.17 * size, 0.16 * size)), leaves, "world",
                 (x, y, _GROUND + 0.3 * size)),
            Part(Ellipsoid((0.11 * size, 0.11 * size, 0.12 * size)), leaves, "world",
                 (x, y, _GROUND + 0.46 * size)),
        ]  # fmt: skip
    for x, y, turn in ((0.52, -0.3, -58), (0.3, -0.55, -30), (0.5, 0.42, 50)):
        for level in (0.06, 0.12):
            place = (x, y, _GROUND + level)
            parts.append(Part(Box((0.14, 0.01, 0.014)), fence, "world", place, (0, 0, turn + 90)))
    return parts


def _tower(variation: Variation) -> list[Part]:
    brick, mortar = variation.natural("#b5573a"), variation.natural("#dccfb8")
    white = Plain((0.95, 0.94, 0.9))
    glass, door = Plain(variation.natural("#5f93b5")), variation.paint("#3c6e4f")
    parts = []
    for level in range(5):
        radius = 0.33 - 0.028 * level
        wall = Bricks(brick, mortar, 0.13, 0.0667, 0.014, around=radius)
        place = (0.0, 0.0, _GROUND + 0.1 + 0.2 * level)
        parts.append(Part(Cylinder(radius, 0.1), wall, position=place))
    parts += [
        Part(Torus(0.29, 0.025), white, position=(0.0, 0.0, _GROUND + 0.6)),
        Part(Box((0.05, 0.075, 0.13)), Stripes((door, variation.natural("#2f5740")), 1, 0.03),
             position=(0.3, 0.0, _GROUND + 0.13)),
        Part(Box((0.04, 0.095, 0.15)), white, position=(0.3, 0.0, _GROUND + 0.14)),
    ]  # fmt: skip
    for turn in (60, 180, 300, 0):
        height = _GROUND + (0.72 if turn in (0, 180) else 0.34)
        reach = 0.225 if turn in (0, 180) else 0.275
        for deep, half, paint in ((0.03, 0.055, white), (0.04, 0.04, glass)):
            x, y = _around(turn, reach)
            parts.append(Part(Box((deep, half, half * 1.4)), paint, "world", (x, y, height),
                              (0, 0, turn)))  # fmt: skip
    return parts


def _around(degrees: float, radius: float) -> tuple[float, float]:
    turn = math.radians(degrees)
    return radius * math.cos(turn), radius * math.sin(turn)


def _cap(variation: Variation) -> list[Part]:
    roof = Sectors((variation.paint("#3d5a73"), variation.paint("#4a6d8a")), 16)
    wood = Plain(variation.natural("#6b4a2d"))
    return [
        Part(Cylinder(0.25, 0.025), wood, "cap", (0.0, 0.0, 0.0)),
        Part(Ellipsoid((0.235, 0.235, 0.26)), roof, "cap", (0.0, 0.0, 0.03)),
        Part(
            Ellipsoid((0.03, 0.03, 0.05)), Plain(variation.natural("#d8b24a")), "cap", (0, 0, 0.3)
        ),
        Part(Cylinder(0.035, 0.09), wood, "cap", (0.26, 0.0, 0.07), (0, 84, 0)),
        Part(Capsule(0.014, 0.16), wood, "cap", (-0.32, 0.0, 0.02), (0, 70, 0)),
    ]


def _sails(variation: Variation) -> list[Part]:
    wood = variation.natural("#7a5533")
    cloth = Checker(((0.96, 0.94, 0.88), variation.paint("#d4553f")), (1.0, 0.075, 0.1))
    parts = [
        Part(Ellipsoid((0.06, 0.05, 0.05)), Plain(variation.natural("#d8b24a")), "sails"),
    ]
    for quarter in range(4):
        y, z = _around(90 * quarter, 1.0)
        # The sail is on the trailing side of its spar.
        middle = (0.0, 0.34 * y, 0.34 * z)
        beside = (0.0, 0.37 * y + 0.075 * z, 0.37 * z - 0.075 * y)
        turn = (90.0 * (quarter - 1), 0.0, 0.0)
        parts += [
            Part(Box((0.018, 0.016, 0.34)), Plain(wood), "sails", middle, turn),
            Part(Box((0.008, 0.075, 0.25)), cloth, "sails", beside, turn),
        ]
    return parts


_TOP = -0.42


def still_life(variation: Variation) -> Assembly:
    """A static table with a teapot, books, a cactus and fruit."""
    parts = [
        *_table(variation),
        *_books(variation, (-0.38, 0.4)),
        *_teapot(variation, (0.1, 0.06)),
        *_mug(variation, (0.5, -0.34)),
        *_cactus(variation, (0.5, 0.42)),
        *_fruit(variation),
    ]
    return Assembly(tuple(parts)).placed((0.0, 0.0, 0.06))


def _table(variation: Variation) -> list[Part]:
    wood = variation.natural("#ad7643")
    planks = Stripes((wood, variation.natural("#b9824c"), variation.natural("#9a6536")), 1, 0.13)
    cloth = Checker(
        (variation.paint("#c8453a"), (0.96, 0.94, 0.9), (0.96, 0.94, 0.9)), (0.1, 0.1, 1.0)
    )
    return [
        Part(Cylinder(0.95, 0.02), planks, "world", (0.0, 0.0, _TOP - 0.028), (0, 0, 20)),
        Part(Box((0.5, 0.5, 0.004)), cloth, "world", (0.05, -0.02, _TOP - 0.003), (0, 0, 45)),
        Part(Torus(0.94, 0.04), Plain(variation.natural("#7d5029")), position=(0, 0, _TOP - 0.045)),
        Part(
            Cylinder(0.3, 0.06), Plain(variation.natural("#7d5029")), position=(0, 0, _TOP - 0.14)
        ),
    ]


def _books(variation: Variation, place: tuple[float, float]) -> list[Part]:
    parts: list[Part] = []
    height = _TOP
    rows = (("#2f5d8a", 0.3, 0.21, 0.055, 12), ("#c98b2b", 0.27, 0.19, 0.04, -9),
            ("#7a2f3d", 0.22, 0.16, 0.05, 24))  # fmt: skip
    paper = Stripes(((0.93, 0.9, 0.82), (0.83, 0.79, 0.7)), 2, 0.014)
    for code, long, wide, thick, turn in rows:
        cover = Plain(variation.paint(code))
        middle: Vector = (place[0], place[1], height + thick)
        angle = (0.0, 0.0, float(turn))
        lid = Box((long, wide, 0.009))
        parts.append(Part(Box((long - 0.02, wide - 0.02, thick - 0.004)), paper, "world", middle,
                          angle))  # fmt: skip
        for side in (-1, 1):
            level = (place[0], place[1], height + thick + side * (thick - 0.009))
            parts.append(Part(lid, cover, "world", level, angle))
        height += 2 * thick
    ball = Plain(variation.natural("#e7a13a"), 0.1, 0.06)
    middle = (place[0], place[1], height + 0.098)
    parts.append(Part(Ellipsoid((0.105, 0.105, 0.1)), ball, position=middle))
    return parts


def _teapot(variation: Variation, place: tuple[float, float]) -> list[Part]:
    glaze, white = variation.paint("#3f86b5"), (0.96, 0.95, 0.92)
    x, y = place
    body, band = Plain(glaze), Sectors((glaze, white), 20)
    return [
        Part(Ellipsoid((0.3, 0.3, 0.25)), body, position=(x, y, _TOP + 0.24)),
        Part(Torus(0.272, 0.036), band, position=(x, y, _TOP + 0.27)),
        Part(Cylinder(0.17, 0.02), Plain(white), position=(x, y, _TOP + 0.018)),
        Part(Torus(0.13, 0.025), Plain(white), position=(x, y, _TOP + 0.465)),
        Part(Ellipsoid((0.13, 0.13, 0.07)), body, position=(x, y, _TOP + 0.47)),
        Part(Ellipsoid((0.045, 0.045, 0.05)), Plain(white), position=(x, y, _TOP + 0.57)),
        Part(Torus(0.155, 0.032), body, "world", (x - 0.31, y, _TOP + 0.27), (90, 0, 0)),
        Part(Capsule(0.05, 0.12), body, "world", (x + 0.33, y, _TOP + 0.27), (0, 42, 0)),
        Part(Capsule(0.038, 0.06), body, "world", (x + 0.45, y, _TOP + 0.42), (0, 24, 0)),
        Part(Cylinder(0.046, 0.014), Plain(white), "world", (x + 0.482, y, _TOP + 0.5), (0, 24, 0)),
    ]


def _mug(variation: Variation, place: tuple[float, float]) -> list[Part]:
    white, stripe = (0.96, 0.95, 0.92), variation.paint("#d9862f")
    coffee = variation.natural("#4a2c18")
    x, y = place
    return [
        Part(Cylinder(0.13, 0.14), Stripes((white, stripe), 2, 0.07), position=(x, y, _TOP + 0.14)),
        Part(Torus(0.122, 0.014), Plain(white), position=(x, y, _TOP + 0.28)),
        Part(Cylinder(0.112, 0.005), Plain(coffee), position=(x, y, _TOP + 0.281)),
        Part(Torus(0.075, 0.022), Plain(white), "world", (x + 0.1, y - 0.1, _TOP + 0.14),
             (90, 0, -45)),
        Part(Cylinder(0.2, 0.01), Plain(white), position=(x, y, _TOP + 0.009)),
    ]  # fmt: skip


def _cactus(variation: Variation, place: tuple[float, float]) -> list[Part]:
    clay = Plain(variation.natural("#bf6a43"), 0.05, 0.1)
    ribs: tuple[Colour, ...] = (variation.natural("#4f8a4a"), variation.natural("#3a6d3c"))
    x, y = place
    green, flower = Sectors(ribs, 20), Plain(variation.paint("#e0558c"))
    return [
        Part(Cylinder(0.14, 0.1), clay, position=(x, y, _TOP + 0.1)),
        Part(Cylinder(0.17, 0.03), clay, position=(x, y, _TOP + 0.21)),
        Part(
            Cylinder(0.15, 0.01), Plain(variation.natural("#5a4030")), position=(x, y, _TOP + 0.24)
        ),
        Part(Capsule(0.105, 0.24), green, position=(x, y, _TOP + 0.44)),
        Part(Capsule(0.05, 0.07), green, "world", (x + 0.15, y, _TOP + 0.5), (0, 70, 0)),
        Part(Capsule(0.05, 0.08), green, position=(x + 0.22, y, _TOP + 0.6)),
        Part(Capsule(0.045, 0.06), green, "world", (x - 0.14, y, _TOP + 0.42), (0, -70, 0)),
        Part(Capsule(0.045, 0.06), green, position=(x - 0.2, y, _TOP + 0.5)),
        Part(Ellipsoid((0.06, 0.06, 0.035)), flower, position=(x, y, _TOP + 0.79)),
        Part(Ellipsoid((0.03, 0.03, 0.02)), flower, position=(x + 0.22, y, _TOP + 0.73)),
    ]


def _fruit(variation: Variation) -> list[Part]:
    red, green = variation.natural("#c62f2b"), variation.natural("#9dbb3d")
    stem, leaf = Plain(variation.natural("#5c3d20")), Plain(variation.natural("#5f9440"))
    parts = []
    for x, y, paint in ((-0.5, -0.3, red), (-0.26, -0.46, green), (-0.02, -0.5, red)):
        skin = Plain(paint, 0.12, 0.18)
        parts += [
            Part(Ellipsoid((0.13, 0.13, 0.115)), skin, position=(x, y, _TOP + 0.115)),
            Part(Capsule(0.01, 0.03), stem, "world", (x, y, _TOP + 0.25), (0, 14, 0)),
            Part(Ellipsoid((0.05, 0.022, 0.008)), leaf, "world", (x + 0.05, y, _TOP + 0.255),
                 (0, -18, 25)),
        ]  # fmt: skip
    return parts


@dataclass(frozen=True)
class DemoScene:
    """A scene and the position of its fixed camera.

    Attributes:
        build: Builds the scene with the colours and phases of a variation.
        azimuth: Direction of the fixed camera in degrees, from +x towards +y. Its elevation
            is 0, and it lies on a world axis along which the scene is built.
    """

    build: Callable[[Variation], Assembly]
    azimuth: float = -90.0


DEMO_SCENES: dict[str, DemoScene] = {
    "excavator": DemoScene(excavator),
    "walker": DemoScene(walker),
    "balls": DemoScene(balls),
    "windmill": DemoScene(windmill, azimuth=0.0),
    "still_life": DemoScene(still_life),
}


def demo_scene(name: str) -> DemoScene:
    """The scene called ``name``.

    Raises:
        SceneError: If no scene has that name; the message lists all names.
    """
    if name in DEMO_SCENES:
        return DEMO_SCENES[name]
    close = difflib.get_close_matches(name, DEMO_SCENES, n=1)
    hint = f" Did you mean {close[0]}?" if close else ""
    raise SceneError(
        f"no demo scene {name!r}; available: {', '.join(DEMO_SCENES)}.{hint} Scenes on disk need "
        "data=FORMAT, such as dnerf, nerfstudio or colmap: `xplanes inspect FOLDER` tells which."
    )


def build_demo_scene(name: str, seed: int = 0) -> Assembly:
    """The assembly of a named scene, with the colours and phases of ``seed``."""
    return demo_scene(name).build(Variation(name, seed))
