"""A still life: teapot, mug, books, fruit and a cactus on a round table."""

from xplanes.scenes.demo.assembly import Assembly, Part, Vector
from xplanes.scenes.demo.primitives import Box, Capsule, Cylinder, Ellipsoid
from xplanes.scenes.demo.surfaces import Checker, Colour, Plain, Sectors, Stripes
from xplanes.scenes.demo.torus import Torus
from xplanes.scenes.demo.variation import Variation

_TOP = -0.42


def still(variation: Variation) -> Assembly:
    """Nothing moves."""
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
