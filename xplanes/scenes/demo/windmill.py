"""A brick windmill on a green island."""

import math

from xplanes.scenes.demo.assembly import Assembly, Joint, Part
from xplanes.scenes.demo.motions import Steady, Swing
from xplanes.scenes.demo.primitives import Box, Capsule, Cylinder, Ellipsoid
from xplanes.scenes.demo.surfaces import Bricks, Checker, Plain, Sectors, Stripes
from xplanes.scenes.demo.torus import Torus
from xplanes.scenes.demo.variation import Variation

_GROUND = -0.72


def windmill(variation: Variation) -> Assembly:
    """The sails turn and the cap follows the wind a little; the island stands still."""
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
        # The sail hangs beside its spar, on the side that follows in the turn.
        middle = (0.0, 0.34 * y, 0.34 * z)
        beside = (0.0, 0.37 * y + 0.075 * z, 0.37 * z - 0.075 * y)
        turn = (90.0 * (quarter - 1), 0.0, 0.0)
        parts += [
            Part(Box((0.018, 0.016, 0.34)), Plain(wood), "sails", middle, turn),
            Part(Box((0.008, 0.075, 0.25)), cloth, "sails", beside, turn),
        ]
    return parts
