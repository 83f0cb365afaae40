"""Objects in unbounded surroundings, captured by a phone or a camera rig in opaque images."""

from xplanes.synthetic.demo.assembly import Assembly, Part, Vector
from xplanes.synthetic.demo.geometry import (
    Box,
    Bricks,
    Capsule,
    Checker,
    Cylinder,
    Ellipsoid,
    Plain,
    Sectors,
    Stripes,
    Surface,
    Torus,
)
from xplanes.synthetic.demo.motions import Variation
from xplanes.synthetic.demo.suite.pieces import ball, rod
from xplanes.synthetic.demo.world import World

TIMESTEPS = 11
"""Number of timesteps in the search for the lowest point of an object."""


def _ground(thing: Assembly, surface: Surface) -> tuple[float, Part]:
    """Height of the ground below an object, and the ground as a part."""
    lows = [thing.pose(i / (TIMESTEPS - 1)).bounds()[0][2] for i in range(TIMESTEPS)]
    height = float(min(lows)) - 0.005
    return height, Part(Box((60.0, 60.0, 0.5)), surface, position=(0, 0, height - 0.5))


def _tree(
    x: float, y: float, ground: float, size: float, trunk: Surface, crown: Surface
) -> list[Part]:
    """A tree: a trunk with three round masses of leaves."""
    height = 1.1 * size
    places: list[Vector] = [(0.0, 0.0, 0.0), (0.3, 0.1, -0.25), (-0.25, -0.2, -0.3)]
    return [
        rod((x, y, ground), (x, y, ground + height), 0.09 * size, trunk),
        *(
            Part(
                ball(0.45 * size),
                crown,
                position=(x + a * size, y + b * size, ground + height + (0.35 + c) * size),
            )
            for a, b, c in places
        ),
    ]


def park(thing: Assembly, variation: Variation) -> World:
    """Grass with trees, a wall, a kiosk and a hill."""
    grass = Plain(variation.natural("#6f9a4e"), 0.25, 1.7)
    ground, floor = _ground(thing, grass)
    bark = Plain(variation.natural("#6b4a32"), 0.2, 0.4)
    leaves = [Plain(variation.natural(code), 0.25, 0.6) for code in ("#3f7a3a", "#7f9a32")]
    places = ((-2.4, 2.2, 1.0), (1.1, 3.4, 1.3), (3.6, 2.0, 1.1), (-4.5, 5.0, 1.7), (5.5, 6.5, 2.0))
    parts = [floor]
    for number, (x, y, size) in enumerate(places):
        parts += _tree(x, y, ground, size, bark, leaves[number % 2])
    kiosk = Stripes((variation.paint("#d8483c"), (0.95, 0.93, 0.88)), 0, 0.3)
    wall = Bricks(variation.natural("#a8583c"), (0.8, 0.77, 0.7), 0.7, 0.3, 0.06)
    parts += [
        Part(Box((0.55, 0.4, 0.6)), kiosk, position=(-0.9, 4.4, ground + 0.6)),
        Part(Box((0.7, 0.55, 0.08)), Plain(variation.paint("#2f5fa8")),
             position=(-0.9, 4.4, ground + 1.28)),
        Part(Box((3.5, 0.2, 0.7)), wall, "world", (1.5, 8.5, ground + 0.7), (0, 0, -8)),
        Part(Ellipsoid((14.0, 9.0, 3.2)), Plain(variation.natural("#5a8a5a"), 0.2, 4.0),
             position=(-8, 26, ground)),
        Part(Box((0.5, 0.14, 0.05)), Plain(variation.natural("#9a6a3c")),
             position=(2.2, 1.3, ground + 0.35)),
        *(Part(Box((0.05, 0.12, 0.17)), Plain((0.2, 0.2, 0.22)), position=(x, 1.3, ground + 0.17))
          for x in (1.8, 2.6)),
    ]  # fmt: skip
    return World(tuple(parts), zenith=(0.35, 0.58, 0.9), horizon=(0.82, 0.88, 0.93))


def desert(thing: Assembly, variation: Variation) -> World:
    """Sand with rocks, columns of a ruin and far mountains, under an evening sky."""
    sand = Plain(variation.natural("#d2a86c"), 0.16, 2.3)
    ground, floor = _ground(thing, sand)
    stone = Plain(variation.natural("#8a6a58"), 0.25, 0.5)
    marble = Stripes((variation.natural("#e4d8c4"), variation.natural("#bcae98")), 2, 0.35)
    parts = [
        floor,
        *(Part(Cylinder(0.24, h / 2), marble, position=(x, y, ground + h / 2))
          for x, y, h in ((-2.1, 2.5, 2.2), (-0.7, 3.3, 1.2), (0.9, 3.6, 2.4), (2.4, 2.7, 1.7))),
        Part(Box((1.1, 0.3, 0.14)), marble, "world", (0.1, 3.45, ground + 2.5), (0, 9, 6)),
        *(Part(Ellipsoid((1.2 * s, s, 0.8 * s)), stone, "world", (x, y, ground), (0, 0, 40 * s))
          for x, y, s in ((3.4, 1.0, 0.5), (-3.6, 1.2, 0.7), (5.0, 4.5, 1.1), (-5.5, 5.5, 0.9))),
        *(Part(Ellipsoid((7.0, 4.0, h)), Plain(variation.natural(code), 0.2, 3.0),
               position=(x, 30, ground))
          for x, h, code in ((-17, 6.5, "#7a4a58"), (-3, 4.5, "#8a5a5a"), (12, 7.5, "#6a4660"))),
        Part(Capsule(0.22, 0.75), Plain(variation.natural("#4f8a58"), 0.1, 0.2),
             position=(-1.9, 1.6, ground + 0.7)),
        Part(Torus(0.5, 0.1), Plain(variation.paint("#3c6ab0")), "world", (2.1, 1.5, ground + 0.1)),
    ]  # fmt: skip
    return World(tuple(parts), zenith=(0.28, 0.36, 0.66), horizon=(0.97, 0.72, 0.5))


def hall(thing: Assembly, variation: Variation) -> World:
    """A chequered floor in a hall with painted walls, crates and lamps."""
    tiles = Checker((variation.natural("#c8beb0"), variation.natural("#8f8578")), (0.8, 0.8, 9.0))
    ground, floor = _ground(thing, tiles)
    blue, ochre = variation.paint("#3a66a0"), variation.paint("#d09a3c")
    crate = Stripes((variation.natural("#a8763f"), variation.natural("#855a2c")), 2, 0.12)
    return World(
        (
            floor,
            Part(Box((9.0, 0.2, 3.0)), Stripes((blue, (0.86, 0.87, 0.9)), 0, 1.1),
                 position=(0, 6.0, ground + 3)),
            Part(Box((0.2, 9.0, 3.0)), Sectors((ochre, (0.9, 0.86, 0.78)), 60),
                 position=(-7.0, 0, ground + 3)),
            Part(Box((0.2, 9.0, 3.0)), Plain(variation.natural("#7a9a78"), 0.3, 1.1),
                 position=(7.0, 0, ground + 3)),
            *(Part(Box((s, s, s)), crate, "world", (x, y, ground + s), (0, 0, 25 * x))
              for x, y, s in ((-2.3, 2.4, 0.4), (-1.7, 3.2, 0.55), (2.6, 2.6, 0.45))),
            Part(Cylinder(0.3, 0.45),
                 Stripes((variation.paint("#c03a3a"), (0.9, 0.9, 0.9)), 2, 0.3),
                 position=(1.2, 3.6, ground + 0.45)),
            *(rod((x, 4.6, ground), (x, 4.6, ground + 1.8), 0.05, Plain((0.2, 0.2, 0.22)))
              for x in (-3.0, 3.2)),
            *(Part(ball(0.25), Plain((0.98, 0.95, 0.8)), position=(x, 4.6, ground + 1.95))
              for x in (-3.0, 3.2)),
        ),
        zenith=(0.72, 0.74, 0.78),
        horizon=(0.86, 0.86, 0.86),
        haze=80.0,
    )  # fmt: skip


def square(thing: Assembly, variation: Variation) -> World:
    """A paved town square with houses, a fountain and posts."""
    paving = Bricks(variation.natural("#a39a92"), (0.66, 0.63, 0.6), 1.2, 0.6, 0.05)
    ground, floor = _ground(thing, Plain(variation.natural("#9c948c"), 0.22, 1.3))
    roof = Plain(variation.natural("#a04a38"), 0.1, 0.5)
    parts = [
        floor,
        Part(Cylinder(0.9, 0.2), paving, position=(1.9, 3.5, ground + 0.2)),
        Part(Cylinder(0.12, 0.8), Plain((0.62, 0.62, 0.66)), position=(1.9, 3.5, ground + 0.8)),
        *(Part(Capsule(0.07, 0.35), Plain((0.16, 0.16, 0.2)), position=(x, 2.0, ground + 0.35))
          for x in (-3.2, -1.9, -0.6, 0.7)),
    ]  # fmt: skip
    for number, (x, y, code) in enumerate(
        ((-6.5, 9.0, "#d8b070"), (-2.5, 10.5, "#b8c4c8"), (2.0, 11.0, "#c87a6a"),
         (6.5, 9.5, "#8aa87a"), (-9.0, 4.0, "#a88ab0"), (9.5, 5.0, "#d0c090"))
    ):  # fmt: skip
        high = 2.2 + 0.5 * (number % 3)
        front = Checker((variation.natural(code), (0.32, 0.34, 0.4)), (0.75, 0.75, 0.75))
        parts += [
            Part(Box((1.6, 1.2, high)), front, position=(x, y, ground + high)),
            Part(Ellipsoid((2.0, 1.5, 1.0)), roof, position=(x, y, ground + 2 * high)),
        ]
    return World(tuple(parts), zenith=(0.45, 0.62, 0.85), horizon=(0.9, 0.9, 0.88))
