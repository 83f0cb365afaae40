"""Scenes with changing shapes (deformation, topology, scaling), and static ones."""

from xplanes.synthetic.demo.assembly import Assembly, Joint, Part
from xplanes.synthetic.demo.geometry import (
    Box,
    Capsule,
    Checker,
    Cylinder,
    Ellipsoid,
    Plain,
    Sectors,
    Stripes,
    Torus,
    rgb,
)
from xplanes.synthetic.demo.implicit import Bent, Blend, Drop, Fluid, Lobed, Twisted, Waving
from xplanes.synthetic.demo.motions import Keys, Steady, Swing, Variation
from xplanes.synthetic.demo.shading import Light
from xplanes.synthetic.demo.suite.pieces import around, ball, moving, rod


def deformation(variation: Variation) -> Assembly:
    """A twisting column, three stalks that bend, and a lobed ball that breathes."""
    red, cream = variation.paint("#c8483c"), (0.94, 0.9, 0.8)
    green, leaf = variation.paint("#3f9a55"), variation.natural("#7cc05a")
    violet = variation.paint("#7a55c0")
    column = Twisted(half=(0.17, 0.17, 0.42), rounding=0.04, twist=Swing(0, 75, 1))
    heart = Lobed(radius=0.27, lobes=5, swell=Swing(0.12, 0.12, 2), most=0.24,
                  stretch=Swing(1.0, 0.15, 2, 0.25), tallest=(0.85, 1.15))  # fmt: skip
    parts = [
        Part(Cylinder(0.9, 0.05), Checker(((0.75, 0.72, 0.66), (0.6, 0.6, 0.62)),
             (0.2, 0.2, 1.0)), position=(0, 0, -0.65)),
        Part(column, Stripes((red, cream), 2, 0.12), position=(0.42, 0.3, -0.18)),
        Part(heart, Sectors((violet, variation.paint("#c070c8")), 10), position=(0.3, -0.45, -0.2)),
        Part(Cylinder(0.1, 0.08), Plain((0.4, 0.38, 0.36)), position=(0.3, -0.45, -0.55)),
    ]  # fmt: skip
    for number, (x, y, turn, bend) in enumerate(
        ((-0.35, -0.25, 200, 95), (-0.5, 0.25, 150, 70), (-0.15, 0.5, 60, 110))
    ):
        stalk = Bent(length=0.85 - 0.1 * number, radius=0.085, tip=0.045,
                     bend=Swing(10, bend, 1, 0.3 * number))  # fmt: skip
        bands = Stripes((green, leaf), 2, 0.11)
        parts.append(Part(stalk, bands, "world", (x, y, -0.6), (0, 0, float(turn))))
    return Assembly(tuple(parts))


def deformation_test(variation: Variation) -> Assembly:
    """A flag waves on its pole, an eel winds beside it, and a cushion is squeezed."""
    blue, white = variation.paint("#2d5fb8"), (0.95, 0.95, 0.93)
    orange, teal = variation.paint("#e5803a"), variation.paint("#2a9a98")
    flag = Waving(half=(0.52, 0.018, 0.3), reach=0.2, waves=1.2, phase=Steady(0, 2.0))
    eel = Waving(half=(0.6, 0.06, 0.07), reach=0.16, waves=1.6, phase=Steady(0.2, 2.0))
    cushion = Lobed(radius=0.3, lobes=4, swell=Swing(0.16, 0.05, 1), most=0.21,
                    stretch=Swing(0.8, 0.28, 2), tallest=(0.52, 1.08))  # fmt: skip
    joints = [
        *moving("press", (0.25, 0.5, 0.02), z=Swing(0.0, 0.075, 2)),
        *moving("wand", (-0.5, 0.45, -0.62), turn=Swing(0, 40, 1), axis=(0, 0, 1)),
    ]
    parts = [
        Part(Box((0.8, 0.75, 0.04)), Stripes(((0.6, 0.48, 0.36), (0.52, 0.41, 0.3)), 1, 0.15),
             position=(0, 0, -0.66)),
        rod((-0.55, -0.1, -0.62), (-0.55, -0.1, 0.85), 0.035, Plain((0.75, 0.72, 0.65))),
        Part(ball(0.06), Plain(variation.natural("#d8b040")), position=(-0.55, -0.1, 0.9)),
        Part(flag, Checker((blue, white), (0.26, 1.0, 0.15)), position=(0.0, -0.1, 0.5)),
        Part(eel, Stripes((teal, variation.paint("#8fd0c0")), 0, 0.1), position=(0.1, -0.45, -0.2)),
        rod((-0.5, -0.45, -0.62), (-0.5, -0.45, -0.2), 0.03, Plain((0.3, 0.3, 0.32))),
        Part(cushion, Sectors((orange, variation.natural("#f0c070")), 8),
             position=(0.25, 0.5, -0.36)),
        Part(Bent(length=0.7, radius=0.04, tip=0.07, bend=Swing(30, 100, 2)),
             Stripes((variation.paint("#b83a6a"), white), 2, 0.1), "wand"),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), Light(shadow=0.4))


def topology(variation: Variation) -> Assembly:
    """Five drops of fluid meet in the middle, merge and part again; two rings pass through it."""
    paints = tuple(
        variation.paint(code) for code in ("#d8403a", "#e8a82c", "#3aa05a", "#3a70d0", "#9a4ac0")
    )
    drops = tuple(
        Drop((x, y, z), 0.2, Swing(0, -0.85 * x, 1, phase), Swing(0, -0.85 * y, 1, phase),
             Swing(0, 0.12, 2, 0.2 * i))
        for i, ((x, y, _), z, phase) in enumerate(
            zip(around(5, 0.62), (0.1, -0.1, 0.15, 0.0, -0.15), (0, 0.06, 0, 0.08, 0.03),
                strict=True))
    )  # fmt: skip
    fluid = Fluid(drops=drops, blend=0.055, half=(1.4, 1.4, 0.55))
    joints = [
        *moving("ring", (0, 0, 0.75), (0, 0, 30), z=Swing(-0.72, 0.5, 1, 0.1)),
        *moving("bar", (0, 0, -0.62), turn=Steady(0, 180)),
    ]
    grey = Plain((0.5, 0.5, 0.54))
    parts = [
        Part(fluid, Blend(fluid, paints)),
        Part(Torus(0.34, 0.05), Sectors(((0.9, 0.9, 0.88), (0.35, 0.36, 0.4)), 16), "ring"),
        Part(Capsule(0.06, 0.55), grey, "bar", (0, 0, 0), (0, 90, 0)),
        Part(ball(0.14), Plain(paints[0]), "bar", (0.55, 0, 0)),
        Part(ball(0.14), Plain(paints[3]), "bar", (-0.55, 0, 0)),
        Part(Box((0.12, 0.12, 0.3)), Plain(paints[1]), position=(0, 0.55, -0.72)),
    ]
    return Assembly(tuple(parts), tuple(joints))


def topology_test(variation: Variation) -> Assembly:
    """Drops fall from a tap into a pool; two eggs pass into each other; blocks close up."""
    water, deep = variation.paint("#4a9ad8"), variation.paint("#2a5ab0")
    shells = variation.paint("#e06a50"), variation.paint("#f0d080")
    fall = [
        Drop((0.3, 0.0, 0.72), 0.13, z=Keys((start, start + 0.28), (0.0, -1.22)),
             size=Keys((start, start + 0.3), (1.0, 0.8)))
        for start in (0.02, 0.36, 0.68)
    ]  # fmt: skip
    pool = [Drop((0.3 + x, y, -0.56), 0.2) for x, y, _ in around(6, 0.24)]
    tap = [Drop((0.3, 0.0, 0.8), 0.17)]
    fluid = Fluid(drops=(*fall, *pool, *tap), blend=0.035, half=(0.85, 0.7, 1.05))
    paints = (*(water for _ in fall), *(deep for _ in pool), water)
    joints = [
        *moving("left egg", (-0.55, 0.4, 0.1), (0, 0, 20), y=Swing(0, 0.34, 1)),
        *moving("right egg", (-0.55, 0.4, 0.1), (0, 0, 20), y=Swing(0, -0.34, 1),
                z=Swing(0, 0.1, 2)),
        *moving("left block", (-0.55, -0.4, -0.35), x=Swing(-0.19, 0.17, 2)),
        *moving("right block", (-0.55, -0.4, -0.35), x=Swing(0.19, -0.17, 2)),
    ]  # fmt: skip
    parts = [
        Part(fluid, Blend(fluid, paints)),
        rod((0.3, 0.0, 0.95), (0.3, 0.42, 0.95), 0.07, Plain((0.62, 0.63, 0.66))),
        rod((0.3, 0.42, 0.95), (0.3, 0.42, -0.7), 0.07, Plain((0.62, 0.63, 0.66))),
        Part(Torus(0.5, 0.05), Plain((0.55, 0.42, 0.36)), position=(0.3, 0, -0.68)),
        Part(Ellipsoid((0.17, 0.24, 0.17)), Plain(shells[0]), "left egg"),
        Part(Ellipsoid((0.2, 0.16, 0.2)), Sectors(shells, 6), "right egg"),
        Part(Box((0.18, 0.2, 0.14)), Checker((variation.paint("#5a8a3c"), (0.9, 0.9, 0.85)),
             (0.09, 0.1, 0.14)), "left block"),
        Part(Box((0.18, 0.2, 0.14)), Checker((variation.paint("#8a3c6a"), (0.9, 0.9, 0.85)),
             (0.09, 0.1, 0.14)), "right block"),
        Part(Box((0.45, 0.26, 0.03)), Plain((0.4, 0.38, 0.36)), position=(-0.55, -0.4, -0.53)),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), Light(towards=(-0.4, -0.4, 0.9), shadow=0.4))


def scaling(variation: Variation) -> Assembly:
    """Balloons swell and shrink by turns, a flower opens to three times its size, a cube pulses."""
    joints: list[Joint] = []
    parts = [Part(Cylinder(0.85, 0.04), Plain(variation.natural("#b8a98c"), 0.06, 0.3),
                  position=(0, 0, -0.7))]  # fmt: skip
    codes = ("#d83a4a", "#3a7ad8", "#e8b030")
    for number, (x, y, _) in enumerate(around(3, 0.52, start=40)):
        name, paint = f"balloon {number}", variation.paint(codes[number])
        joints += moving(name, (x, y, -0.2), size=Swing(0.68, 0.32, 1, number / 3))
        parts += [
            Part(Ellipsoid((0.28, 0.28, 0.34)), Sectors((paint, (0.95, 0.94, 0.9)), 8), name,
                 (0, 0, 0.34)),
            Part(ball(0.035), Plain(paint), name, (0, 0, -0.02)),
            rod((x, y, -0.68), (x, y, -0.2), 0.015, Plain((0.4, 0.38, 0.35))),
        ]  # fmt: skip
    joints += moving("flower", (0, 0, -0.35), size=Keys((0.0, 0.55, 0.9), (0.35, 1.1, 0.7)))
    parts += [
        rod((0, 0, -0.68), (0, 0, -0.36), 0.03, Plain(variation.natural("#5a9040"))),
        Part(Ellipsoid((0.15, 0.15, 0.1)), Plain(variation.natural("#f0c040"), 0.1, 0.08), "flower",
             (0, 0, 0.12)),
    ]  # fmt: skip
    for number, (x, y, z) in enumerate(around(7, 0.22, 0.06)):
        parts.append(Part(Ellipsoid((0.15, 0.08, 0.04)), Plain(variation.paint("#c85ab8")),
                          "flower", (x, y, z), (0, -25, 360.0 * number / 7)))  # fmt: skip
    joints += moving("cube", (-0.05, -0.6, -0.64), size=Swing(0.6, 0.4, 2, 0.5))
    parts.append(Part(Box((0.16, 0.16, 0.16)), Checker((variation.paint("#2a9a7a"),
                 (0.9, 0.92, 0.85)), (0.16, 0.16, 0.16)), "cube", (0, 0, 0.16)))  # fmt: skip
    return Assembly(tuple(parts), tuple(joints))


def scaling_test(variation: Variation) -> Assembly:
    """A snowman grows to four times its size while a house shrinks and mushrooms shoot up."""
    snow, coal = Plain((0.8, 0.84, 0.9)), Plain((0.1, 0.1, 0.12))
    joints = [
        *moving("man", (-0.4, -0.25, -0.6), size=Keys((0.0, 0.85), (0.28, 1.1))),
        *moving("house", (0.42, 0.3, -0.6), turn=Swing(0, 12, 1), size=Keys((0.1, 1), (1.2, 0.35))),
    ]
    parts = [
        Part(Box((0.85, 0.8, 0.03)), Plain(variation.natural("#7aa25a"), 0.08, 0.3),
             position=(0, 0, -0.63)),
        Part(ball(0.28), snow, "man", (0, 0, 0.26)),
        Part(ball(0.21), snow, "man", (0, 0, 0.68)),
        Part(ball(0.15), snow, "man", (0, 0, 0.99)),
        Part(Capsule(0.03, 0.07), Plain(variation.natural("#e8803a")), "man", (0.0, -0.18, 0.99),
             (90, 0, 0)),
        Part(Cylinder(0.17, 0.015), coal, "man", (0, 0, 1.12)),
        Part(Cylinder(0.11, 0.1), Stripes((rgb("#20242c"), variation.paint("#c03a3a")), 2, 0.09),
             "man", (0, 0, 1.22)),
        *(Part(ball(0.025), coal, "man", (x, -0.13, z))
          for x, z in ((-0.05, 1.04), (0.05, 1.04))),
        *(Part(ball(0.03), coal, "man", (0.0, -0.2, z)) for z in (0.62, 0.72)),
        rod((0.18, 0, 0.75), (0.42, -0.05, 0.9), 0.02, Plain(variation.natural("#6a4a2c")), "man"),
        rod((-0.18, 0, 0.75), (-0.42, -0.05, 0.9), 0.02, Plain(variation.natural("#6a4a2c")),
            "man"),
        Part(Box((0.28, 0.24, 0.22)), Plain(variation.paint("#c8604a"), 0.06, 0.1), "house",
             (0, 0, 0.22)),
        Part(Box((0.2, 0.28, 0.2)), Plain(variation.paint("#5a4a78")), "house", (0, 0, 0.44),
             (0, 45, 0)),
        Part(Box((0.07, 0.02, 0.12)), Plain(variation.paint("#3a6a9a")), "house", (0, -0.24, 0.12)),
        Part(Box((0.02, 0.07, 0.07)), Plain((0.95, 0.9, 0.6)), "house", (-0.28, 0, 0.26)),
    ]  # fmt: skip
    for number, (x, y, size) in enumerate(((0.35, -0.5, 1.0), (0.62, -0.3, 0.7), (-0.5, 0.5, 0.9))):
        name = f"mushroom {number}"
        start = 0.1 + 0.2 * number
        joints += moving(name, (x, y, -0.6),
                         size=Keys((start, start + 0.4), (0.2 * size, 1.1 * size)))  # fmt: skip
        parts += [
            Part(Capsule(0.06, 0.12), Plain((0.92, 0.9, 0.84)), name, (0, 0, 0.14)),
            Part(Ellipsoid((0.2, 0.2, 0.12)), Plain(variation.paint("#d04030"), 0.3, 0.12), name,
                 (0, 0, 0.32)),
        ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), Light(towards=(0.6, -0.2, 0.8)))


def static(variation: Variation) -> Assembly:
    """Nothing moves: a lamp, a vase, a clock and blocks on a round table."""
    wood = variation.natural("#8a5a38")
    brass, blue = Plain(variation.natural("#c0983c")), variation.paint("#3a66b0")
    parts = [
        Part(Cylinder(0.85, 0.035), Stripes((wood, variation.natural("#7c4e30")), 0, 0.11),
             position=(0, 0, -0.5)),
        Part(Cylinder(0.12, 0.16), Plain(wood), position=(0, 0, -0.68)),
        Part(Cylinder(0.14, 0.02), brass, position=(-0.4, 0.3, -0.44)),
        rod((-0.4, 0.3, -0.44), (-0.4, 0.3, 0.35), 0.025, brass),
        Part(Lobed(radius=0.27, lobes=12, swell=Steady(0.07, 0), most=0.07, stretch=Steady(0.8, 0),
                   tallest=(0.8, 0.8)), Plain(variation.natural("#ecd9a8")),
             position=(-0.4, 0.3, 0.42)),
        Part(Ellipsoid((0.17, 0.17, 0.22)), Sectors((blue, (0.93, 0.93, 0.9)), 14),
             position=(0.38, 0.32, -0.26)),
        Part(Torus(0.1, 0.03), Plain(blue), position=(0.38, 0.32, -0.04)),
        Part(Cylinder(0.22, 0.05), Plain((0.94, 0.93, 0.88)), "world", (0.05, -0.1, -0.24),
             (75, 0, 0)),
        Part(Torus(0.22, 0.035), Plain(variation.paint("#a83a3a")), "world", (0.05, -0.1, -0.24),
             (75, 0, 0)),
        rod((0.05, -0.16, -0.24), (0.05, -0.14, -0.08), 0.012, Plain((0.1, 0.1, 0.1))),
        rod((0.05, -0.16, -0.24), (0.15, -0.17, -0.27), 0.012, Plain((0.1, 0.1, 0.1))),
        Part(Box((0.12, 0.12, 0.12)), Checker((variation.paint("#3a9a5a"), (0.92, 0.9, 0.8)),
             (0.12, 0.12, 0.12)), "world", (0.5, -0.4, -0.345), (0, 0, 25)),
        Part(Box((0.1, 0.1, 0.1)), Plain(variation.paint("#e08a30")), "world", (0.5, -0.4, -0.125),
             (0, 0, 60)),
        Part(Capsule(0.07, 0.2), Stripes((variation.paint("#c04a8a"), (0.95, 0.9, 0.9)), 2, 0.08),
             "world", (-0.4, -0.45, -0.395), (0, 90, 30)),
    ]  # fmt: skip
    for x, y, z, tilt in ((0.38, 0.32, 0.0, 0), (0.36, 0.34, 0.0, 14), (0.4, 0.3, 0.0, -12)):
        parts += [
            Part(Bent(length=0.5, radius=0.012, tip=0.01, bend=Steady(2.5 * tilt, 0)),
                 Plain(variation.natural("#4f8a3c")), position=(x, y, z)),
            Part(ball(0.07), Sectors((variation.paint("#e05a6a"), variation.paint("#f0a0a8")), 10),
                 position=(x + 0.0098 * tilt, y, z + 0.5)),
        ]  # fmt: skip
    return Assembly(tuple(parts))


def static_test(variation: Variation) -> Assembly:
    """Nothing moves: a castle of towers and walls on a hill, and a dragon asleep around it."""
    stone, roof = variation.natural("#a8a093"), variation.paint("#9a3f3a")
    scale = Stripes((variation.paint("#3c8a5a"), variation.paint("#2c6a48")), 2, 0.06)
    parts = [
        Part(Ellipsoid((0.9, 0.9, 0.28)), Plain(variation.natural("#7c9a50"), 0.1, 0.3),
             position=(0, 0, -0.72)),
        Part(Cylinder(0.16, 0.5), Stripes((stone, variation.natural("#98907f")), 2, 0.1),
             position=(0.0, 0.05, 0.0)),
        Part(Lobed(radius=0.2, lobes=10, swell=Steady(0.12, 0), most=0.12, stretch=Steady(1.2, 0),
                   tallest=(1.2, 1.2)), Plain(roof), position=(0.0, 0.05, 0.55)),
        rod((0, 0.05, 0.7), (0, 0.05, 1.0), 0.014, Plain((0.3, 0.3, 0.3))),
        Part(Box((0.1, 0.008, 0.06)), Plain(variation.paint("#e0c040")),
             position=(0.1, 0.05, 0.94)),
        Part(Torus(0.17, 0.03), Plain(stone), position=(0, 0.05, 0.3)),
    ]  # fmt: skip
    corners = around(4, 0.5, start=45)
    for number, (x, y, _) in enumerate(corners):
        parts += [
            Part(Cylinder(0.1, 0.28), Stripes((stone, variation.natural("#98907f")), 2, 0.08),
                 position=(x, y, -0.3)),
            Part(Ellipsoid((0.12, 0.12, 0.2)), Plain(roof), position=(x, y, 0.0)),
        ]  # fmt: skip
        u, v, _ = corners[(number + 1) % 4]
        turn = 90.0 * number
        parts.append(Part(Box((0.04, 0.3, 0.15)), Checker((stone, variation.natural("#bdb5a6")),
                     (0.1, 0.1, 0.075)), "world", (0.5 * (x + u), 0.5 * (y + v), -0.42),
                     (0, 0, turn + 90)))  # fmt: skip
    body = Bent(length=2.3, radius=0.14, tip=0.04, bend=Steady(200, 0))
    parts += [
        Part(body, scale, "world", (0.72, -0.3, -0.5), (90, 0, 180)),
        Part(Ellipsoid((0.13, 0.2, 0.11)), Plain(variation.paint("#3c8a5a")),
             position=(0.74, -0.45, -0.44)),
        *(Part(ball(0.03), Plain((0.95, 0.85, 0.3)), position=(0.74 + x, -0.55, -0.36))
          for x in (-0.07, 0.07)),
    ]  # fmt: skip
    for number, (x, y, _) in enumerate(((0.1, -0.62, 0), (-0.25, -0.6, 0), (0.6, 0.3, 0))):
        crown = Plain(variation.natural("#4f7d3a"), 0.15, 0.1)
        parts += [
            rod((x, y, -0.6), (x, y, -0.35), 0.025, Plain(variation.natural("#6a4a30"))),
            Part(Ellipsoid((0.1, 0.1, 0.14 + 0.02 * number)), crown, position=(x, y, -0.28)),
        ]
    return Assembly(tuple(parts), (), Light(towards=(0.5, 0.4, 0.7)))
