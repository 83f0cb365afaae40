"""Scenes with particular materials and appearance."""

from xplanes.synthetic.demo.assembly import Assembly, Joint, Part
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
    Translucent,
    Unlit,
)
from xplanes.synthetic.demo.motions import Bounce, Keys, Steady, Swing, Variation
from xplanes.synthetic.demo.shading import Light
from xplanes.synthetic.demo.suite.pieces import around, ball, chain, moving, numbered, rod

WHITE = Unlit(Plain((1.0, 1.0, 1.0)))
"""Pure white in every view, without shading."""


def white_floor(variation: Variation) -> Assembly:
    """Toys slide, roll, spin and jump on a white board eight units wide."""
    red, blue = Plain(variation.paint("#d8342c")), Plain(variation.paint("#2b62c9"))
    green, gold = Plain(variation.paint("#2f9e4f")), Plain(variation.paint("#efb022"))
    pink = variation.paint("#d8569b")
    joints = [
        *moving("cube", (-1.7, -0.9, 0.28), x=Swing(0.0, 0.7, 1), turn=Steady(0, 140)),
        *moving("ball", (0.9, 1.2, 0.3), z=Bounce(1.1, 2), turn=Steady(0, 200), axis=(1, 0.3, 0)),
        *moving("top", (1.4, -1.3, 0.0), (8, 0, 0), turn=Steady(0, 540), axis=(0, 0, 1)),
        *moving("wheel", (0.0, -2.1, 0.36), (90, 0, 0), x=Swing(0, 1.1, 1),
                turn=Swing(0, -175, 1)),
        *moving("see", (-0.5, 0.2, 0.42), turn=Swing(0, 16, 2), axis=(0, 1, 0)),
        *moving("tower", (-2.0, 1.7, 0.0), turn=Swing(0, 60, 1)),
        *moving("car", (2.3, 0.6, 0.0), y=Swing(0, 1.2, 1, 0.25)),
    ]  # fmt: skip
    parts = [
        Part(Box((3.9, 3.9, 0.02)), WHITE, position=(0, 0, -0.02)),
        Part(Box((0.28, 0.28, 0.28)), Checker((variation.paint("#d8342c"), (0.95, 0.9, 0.8)),
             (0.28, 0.28, 0.28)), "cube"),
        Part(ball(0.3), Sectors((pink, variation.paint("#f3d64a")), 8), "ball"),
        Part(Ellipsoid((0.34, 0.34, 0.16)), Sectors((variation.paint("#2f9e4f"),
             variation.paint("#efb022"), variation.paint("#2b62c9")), 6), "top", (0, 0, 0.36)),
        Part(Capsule(0.05, 0.3), red, "top", (0, 0, 0.36)),
        Part(Torus(0.28, 0.08), Sectors((variation.paint("#2b62c9"), (0.1, 0.1, 0.14)), 10),
             "wheel"),
        *(rod((0, 0, 0), place, 0.04, gold, "wheel") for place in around(5, 0.27)),
        Part(Box((0.85, 0.14, 0.04)), Stripes((variation.paint("#2f9e4f"),
             variation.paint("#8fcf5a")), 0, 0.2), "see"),
        Part(ball(0.15), red, "see", (-0.7, 0, 0.18)),
        Part(ball(0.12), blue, "see", (0.7, 0, 0.15)),
        rod((-0.5, -0.2, 0.04), (-0.5, 0.0, 0.38), 0.05, gold),
        rod((-0.5, 0.6, 0.04), (-0.5, 0.4, 0.38), 0.05, gold),
        Part(Cylinder(0.05, 0.22), blue, "world", (-0.5, 0.2, 0.38), (90, 0, 0)),
        *(Part(Box((0.24 - 0.05 * i, 0.24 - 0.05 * i, 0.16)), surface, "tower",
               (0, 0, 0.16 + 0.32 * i), (0, 0, 20 * i))
          for i, surface in enumerate((blue, gold, red))),
        Part(Box((0.2, 0.42, 0.13)), gold, "car", (0, 0, 0.2)),
        Part(Box((0.17, 0.2, 0.12)), Plain(variation.natural("#3f4652")), "car", (0, -0.05, 0.42)),
        *(Part(Cylinder(0.1, 0.05), Plain((0.12, 0.12, 0.13)), "car", (x, y, 0.1), (0, 90, 0))
          for x in (-0.2, 0.2) for y in (-0.27, 0.27)),
        Part(Cylinder(0.16, 0.3), Stripes((variation.paint("#d8569b"), (0.95, 0.93, 0.9)), 2, 0.12),
             position=(2.5, 2.4, 0.3)),
        Part(Ellipsoid((0.3, 0.22, 0.2)), green, position=(-2.6, -2.4, 0.2)),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), Light())


def white_floor_test(variation: Variation) -> Assembly:
    """A train runs in a circle on a white disc, past skittles, a swing and a hoop that rolls."""
    violet, teal = Plain(variation.paint("#6a3fb0")), Plain(variation.paint("#129a93"))
    orange, brown = Plain(variation.paint("#e8702a")), Plain(variation.natural("#7b4d2c"))
    leaf, crimson = Plain(variation.natural("#5a8f3c")), Plain(variation.paint("#a8174a"))
    joints = []
    parts: list[Part] = [
        Part(Cylinder(4.0, 0.03), WHITE, position=(0, 0, -0.03)),
    ]
    for number, surface in enumerate((violet, orange, teal)):
        name = f"wagon {number}"
        joints += moving(name, (0.2, 0.1, 0), turn=Steady(-31.0 * number, 250.0))
        parts += [
            Part(Box((0.2, 0.34, 0.14)), surface, name, (1.7, 0, 0.26)),
            *(Part(Cylinder(0.11, 0.04), Plain((0.15, 0.13, 0.12)), name, (1.7 + x, y, 0.11),
                   (0, 90, 0)) for x in (-0.2, 0.2) for y in (-0.2, 0.2)),
        ]  # fmt: skip
    parts += [
        Part(Cylinder(0.13, 0.22), crimson, "wagon 0", (1.7, 0.1, 0.48), (90, 0, 0)),
        Part(Cylinder(0.06, 0.14), brown, "wagon 0", (1.7, 0.24, 0.7)),
        Part(Ellipsoid((0.16, 0.26, 0.14)), leaf, "wagon 1", (1.7, 0, 0.42)),
        Part(ball(0.17), crimson, "wagon 2", (1.7, 0.0, 0.5)),
    ]
    joints += [
        *moving("swing", (-0.1, 0.1, 1.25), turn=Swing(0, 38, 3), axis=(1, 0, 0)),
        *moving("hoop", (-2.6, 0.3, 0.42), (0, 90, 90), parent="world", x=Swing(0.2, 1.3, 1, 0.3),
                turn=Swing(0, -178, 1, 0.3)),
        *moving("frog", (0.9, -2.7, 0.17), x=Keys((0, 0.35, 0.7, 1), (0, -0.7, -1.5, -2.0)),
                z=Bounce(0.7, 4)),
    ]  # fmt: skip
    for x in (-0.55, 0.35):
        parts += [rod((x, -0.4, 0), (x, 0.1, 1.3), 0.045, violet),
                  rod((x, 0.6, 0), (x, 0.1, 1.3), 0.045, violet)]  # fmt: skip
    parts += [
        rod((-0.55, 0.1, 1.3), (0.35, 0.1, 1.3), 0.045, violet),
        rod((-0.2, 0, 0), (-0.2, 0, -0.85), 0.022, brown, "swing"),
        rod((0.2, 0, 0), (0.2, 0, -0.85), 0.022, brown, "swing"),
        Part(Box((0.26, 0.12, 0.03)), orange, "swing", (0, 0, -0.87)),
        Part(Capsule(0.11, 0.12), teal, "swing", (0, 0, -0.64)),
        Part(ball(0.1), Plain(variation.natural("#e3b28c")), "swing", (0, 0, -0.34)),
        Part(Torus(0.36, 0.06), Sectors((variation.paint("#e8702a"), variation.paint("#6a3fb0")),
             12), "hoop"),
        Part(Ellipsoid((0.24, 0.17, 0.13)), leaf, "frog"),
        Part(ball(0.06), Plain((0.95, 0.95, 0.8)), "frog", (-0.15, 0.08, 0.11)),
        Part(ball(0.06), Plain((0.95, 0.95, 0.8)), "frog", (-0.15, -0.08, 0.11)),
    ]  # fmt: skip
    for number, (x, y, _) in enumerate(around(6, 0.32)):
        band = Stripes((variation.paint("#a8174a"), (0.94, 0.9, 0.84)), 2, 0.15, 0.05)
        place = (-2.1 + x, 2.0 + y, 0.26)
        parts += [
            Part(Capsule(0.08, 0.18), band, position=place),
            Part(ball(0.07), (violet, orange)[number % 2], position=(*place[:2], 0.55)),
        ]
    parts.append(Part(Box((0.35, 0.2, 0.22)), teal, "world", (2.6, 1.8, 0.22), (0, 0, 35)))
    return Assembly(tuple(parts), tuple(joints), Light(towards=(-0.5, 0.2, 0.9), shadow=0.5))


_DIM = Light(sun=0.55, sky=0.25, ambient=0.3)


def dark(variation: Variation) -> Assembly:
    """A machine of black, charcoal and grey metal: two gears, a piston and a governor."""
    black, coal = Plain((0.045, 0.045, 0.05)), Plain((0.11, 0.11, 0.12), 0.06, 0.3)
    grey, steel = Plain((0.27, 0.27, 0.28)), Plain((0.4, 0.41, 0.43))
    joints = [
        *moving("large", (-0.28, -0.12, 0.05), (90, 0, 0), turn=Steady(0, 150)),
        *moving("small", (0.42, -0.12, 0.05), (90, 0, 0), turn=Steady(12, -262.5)),
        *moving("piston", (0.0, 0.36, 0.1), z=Swing(0.0, 0.2, 2)),
        *moving("governor", (-0.55, 0.42, -0.45), turn=Steady(0, 300)),
    ]
    parts = [
        Part(Box((0.92, 0.66, 0.06)), black, position=(0, 0, -0.62)),
        Part(Box((0.86, 0.6, 0.03)), coal, position=(0, 0, -0.54)),
        *(Part(Box((0.07, 0.1, 0.36)), grey, position=(x, 0.06, -0.22)) for x in (-0.28, 0.42)),
    ]
    for name, radius, teeth, surface in (("large", 0.4, 14, coal), ("small", 0.215, 8, steel)):
        parts += [
            Part(Cylinder(radius, 0.06), surface, name),
            Part(Cylinder(0.08, 0.12), black, name),
        ]
        for number, angle in numbered(teeth):
            place = around(teeth, radius + 0.03)[number]
            parts.append(Part(Box((0.05, 0.032, 0.055)), surface, name, place, (0, 0, angle)))
        parts += [Part(Cylinder(0.05, 0.075), black, name, place)
                  for place in around(4, 0.6 * radius)]  # fmt: skip
    parts += [
        Part(Cylinder(0.2, 0.3), coal, position=(0.0, 0.36, -0.25)),
        Part(Torus(0.2, 0.035), black, position=(0.0, 0.36, 0.05)),
        Part(Cylinder(0.06, 0.34), steel, "piston"),
        Part(Box((0.24, 0.1, 0.05)), grey, "piston", (0, 0, 0.22)),
        Part(Cylinder(0.04, 0.4), steel, "governor", (0, 0, 0.35)),
        Part(Cylinder(0.16, 0.05), black, "governor", (0, 0, -0.02)),
    ]
    for x in (-1, 1):
        parts += [
            rod((0, 0, 0.7), (0.26 * x, 0, 0.45), 0.025, grey, "governor"),
            Part(ball(0.085), black, "governor", (0.28 * x, 0, 0.42)),
        ]
    return Assembly(tuple(parts), tuple(joints), _DIM)


def dark_test(variation: Variation) -> Assembly:
    """A black beetle walks on the spot on slate, and a grey snail passes."""
    jet, shell = Plain((0.035, 0.035, 0.04)), Sectors(((0.07, 0.07, 0.08), (0.1, 0.1, 0.115)), 10)
    ash, stone = Plain((0.33, 0.33, 0.32)), Plain((0.2, 0.2, 0.21), 0.1, 0.25)
    joints = [*moving("body", (0, 0, -0.12), z=Swing(0, 0.03, 4), turn=Swing(0, 14, 1))]
    parts = [
        Part(Cylinder(0.98, 0.05), stone, position=(0, 0, -0.6)),
        Part(Ellipsoid((0.46, 0.34, 0.27)), shell, "body", (-0.12, 0, 0.04)),
        Part(Ellipsoid((0.2, 0.24, 0.18)), Plain((0.06, 0.06, 0.065)), "body", (0.38, 0, 0)),
        Part(ball(0.13), jet, "body", (0.6, 0, -0.02)),
        Part(Torus(0.3, 0.02), ash, "body", (-0.12, 0, 0.04), (0, 90, 0)),
    ]
    for side in (-1, 1):
        parts += chain([(0.68, 0.05 * side, 0.05), (0.8, 0.16 * side, 0.22),
                        (0.98, 0.26 * side, 0.2)], 0.018, jet, "body")  # fmt: skip
        parts.append(Part(ball(0.035), ash, "body", (0.69, 0.08 * side, 0.03)))
        for leg in range(3):
            name = f"leg {side} {leg}"
            phase = 0.5 * ((leg + (side > 0)) % 2)
            joints += moving(name, (0.3 - 0.3 * leg, 0.22 * side, -0.05), parent="body",
                             turn=Swing(0, 20, 3, phase))  # fmt: skip
            reach = 0.1 - 0.1 * leg
            knee, foot = (reach, 0.28 * side, 0.13), (1.5 * reach, 0.42 * side, -0.4)
            parts += chain([(0, 0, 0), knee, foot], 0.032, jet, name)
    joints += moving("snail", (-0.75, 0.68, -0.5), (0, 0, -10), x=Steady(0, 0.75))
    parts += [
        Part(Capsule(0.06, 0.15), ash, "snail", (0.05, 0, 0), (0, 90, 0)),
        Part(Torus(0.085, 0.06), Sectors(((0.15, 0.15, 0.16), (0.24, 0.24, 0.25)), 8), "snail",
             (-0.02, 0, 0.14), (90, 0, 0)),
        rod((0.22, 0.03, 0.03), (0.29, 0.06, 0.14), 0.014, ash, "snail"),
        rod((0.22, -0.03, 0.03), (0.29, -0.06, 0.14), 0.014, ash, "snail"),
        Part(Ellipsoid((0.2, 0.14, 0.12)), Plain((0.14, 0.14, 0.15), 0.12, 0.2),
             position=(0.55, -0.62, -0.5)),
        Part(Ellipsoid((0.12, 0.16, 0.09)), Plain((0.25, 0.25, 0.25), 0.12, 0.2),
             position=(-0.6, -0.6, -0.52)),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), _DIM)


def wires(variation: Variation) -> Assembly:
    """A cube of wire in the thin rings of a gyroscope."""
    copper, silver = Plain(variation.paint("#b8622f")), Plain(variation.natural("#9aa3ad"))
    blue, red = Plain(variation.paint("#2a58b8")), Plain(variation.paint("#c22f35"))
    joints = [
        *moving("outer", turn=Steady(0, 90), axis=(0, 0, 1)),
        *moving("middle", parent="outer", turn=Steady(20, 160), axis=(1, 0, 0)),
        *moving("inner", parent="middle", turn=Steady(0, -200), axis=(0, 1, 0)),
    ]
    parts = [
        Part(Torus(0.98, 0.014), silver, "outer", rotation=(90, 0, 0)),
        Part(Torus(0.86, 0.013), copper, "middle", rotation=(0, 0, 0)),
        Part(Torus(0.74, 0.012), blue, "inner", rotation=(90, 0, 0)),
        rod((0.98, 0, 0), (0.86, 0, 0), 0.012, silver, "outer"),
        rod((-0.98, 0, 0), (-0.86, 0, 0), 0.012, silver, "outer"),
        rod((0, 0.74, 0), (0, 0.86, 0), 0.012, copper, "middle"),
        rod((0, -0.74, 0), (0, -0.86, 0), 0.012, copper, "middle"),
    ]
    side = 0.38
    corners = [(x, y, z) for x in (-side, side) for y in (-side, side) for z in (-side, side)]
    for i, first in enumerate(corners):
        for second in corners[i + 1 :]:
            changes = sum(a != b for a, b in zip(first, second, strict=True))
            if changes == 1:
                parts.append(rod(first, second, 0.012, red, "inner"))
            elif changes == 3:
                parts.append(rod(first, second, 0.009, silver, "inner"))
    parts += [rod((0.98 * x, 0.98 * y, -1.05), (x * 0.7, y * 0.7, -1.0), 0.01, silver)
              for x, y, _ in around(3, 0.7)]  # fmt: skip
    parts += [
        Part(Torus(0.69, 0.012), silver, position=(0, 0, -1.05)),
        rod((0, 0, -1.05), (0, 0, -0.98), 0.014, silver),
        *(rod((0, 0, -1.05), (x, y, -1.05), 0.01, silver) for x, y, _ in around(3, 0.69, start=60)),
    ]
    return Assembly(tuple(parts), tuple(joints), Light(shadow=0.0))


def wires_test(variation: Variation) -> Assembly:
    """A mobile of thin rods and threads hangs from a mast of wire lattice."""
    black, brass = Plain(variation.natural("#3a3d44")), Plain(variation.paint("#c79a2d"))
    green, violet = Plain(variation.paint("#23805a")), Plain(variation.paint("#7a3aa8"))
    parts: list[Part] = []
    mast, levels = around(3, 0.13), [-0.95 + 0.275 * i for i in range(8)]
    for number, (x, y, _) in enumerate(mast):
        u, v, _ = mast[(number + 1) % 3]
        parts.append(rod((x - 0.55, y, -0.95), (x - 0.55, y, 0.975), 0.012, black))
        for low, high in zip(levels[:-1], levels[1:], strict=True):
            parts.append(rod((x - 0.55, y, low), (u - 0.55, v, high), 0.008, brass))
        parts.append(rod((x - 0.55, y, -0.95), (x * 3.6 - 0.55, y * 3.6, -1.0), 0.012, black))
    parts += chain([(-0.55, 0, 0.97), (0.0, 0, 1.06), (0.3, 0, 0.97)], 0.012, black)
    joints: list[Joint] = [*moving("first", (0.3, 0, 0.95), turn=Steady(0, 120))]
    lengths = ((0.62, 0.2), (0.42, 0.24), (0.3, 0.26))
    parent, colours = "first", (green, violet, brass)
    for number, ((reach, drop), surface) in enumerate(zip(lengths, colours, strict=True)):
        parts += [
            rod((0, 0, 0), (0, 0, -drop), 0.007, black, parent),
            rod((-reach, 0, -drop), (reach * 0.8, 0, -drop), 0.011, surface, parent),
            rod((-reach, 0, -drop), (-reach, 0, -drop - 0.3), 0.007, black, parent),
            Part(Torus(0.09, 0.011), surface, parent, (-reach, 0, -drop - 0.39), (90, 0, 0)),
            rod((-reach, 0, -drop - 0.48), (-reach, 0, -drop - 0.3), 0.008, surface, parent),
        ]
        name = f"next {number}"
        joints += moving(name, (reach * 0.8, 0, -drop), parent=parent,
                         turn=Steady(40.0 * number, (-210.0, 260.0, -300.0)[number]))  # fmt: skip
        parent = name
    spiral = [(x, y, -0.1 - 0.05 * i)
              for i, (x, y, _) in enumerate(around(8, 0.09) + around(8, 0.12))]  # fmt: skip
    parts += [rod((0, 0, 0), (0, 0, -0.1), 0.007, black, parent),
              *chain([(0, 0, -0.1), *spiral], 0.01, violet, parent)]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), Light(shadow=0.0))


_SOFT = Light(sun=0.4, sky=0.2, ambient=0.5, shadow=0.0)
"""A light without shadows, since those of translucent parts would be opaque."""


def transparent(variation: Variation) -> Assembly:
    """Glass shells, coloured jelly and a bottle half full, with solid things within and behind."""
    red, blue = variation.paint("#d23a3a"), variation.paint("#3a6fd8")
    green, amber = variation.paint("#3aa86a"), variation.paint("#e0a030")
    joints = [
        *moving("bubble", (0.32, -0.3, 0.0), z=Swing(0.12, 0.22, 1), turn=Steady(0, 120)),
        *moving("core", parent="bubble", x=Swing(0, 0.16, 2), y=Swing(0, 0.16, 2, 0.25)),
        *moving("jelly", (-0.5, -0.32, -0.25), turn=Swing(0, 50, 1), x=Swing(0, 0.12, 1)),
        *moving("fish", (-0.1, 0.5, 0.0), turn=Steady(0, 360)),
    ]
    parts = [
        Part(Torus(0.8, 0.035), Sectors(((0.9, 0.88, 0.84), (0.5, 0.53, 0.58)), 24),
             position=(0, 0, -0.6)),
        *(rod((0, 0, -0.6), place, 0.03, Plain((0.5, 0.53, 0.58)))
          for place in around(5, 0.8, -0.6)),
        Part(ball(0.36), _glass((0.55, 0.75, 0.9), 0.18), "bubble"),
        Part(ball(0.12), Plain(red), "core"),
        Part(Box((0.24, 0.24, 0.24)), Translucent(Plain(green), density=2.4), "jelly"),
        Part(ball(0.09), Plain(amber), "jelly", (0.05, 0.05, 0.0)),
        Part(Cylinder(0.36, 0.46), _glass((0.7, 0.8, 0.85), 0.12), position=(-0.1, 0.5, -0.09)),
        Part(Cylinder(0.33, 0.28), Translucent(Plain(blue), density=1.3),
             position=(-0.1, 0.5, -0.24)),
        Part(Ellipsoid((0.05, 0.12, 0.08)), Plain(amber), "fish", (0.2, 0, -0.2)),
        Part(Box((0.015, 0.05, 0.06)), Plain(red), "fish", (0.2, -0.15, -0.2)),
        rod((0.62, 0.45, -0.56), (0.62, 0.45, 0.45), 0.06, Plain(amber)),
        Part(ball(0.16), _glass(red, 0.4), position=(0.62, 0.45, 0.55)),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), _SOFT)


def transparent_test(variation: Variation) -> Assembly:
    """Panes of coloured glass turn past each other around a lamp under an hourglass of jelly."""
    pink, cyan = variation.paint("#d84a9a"), variation.paint("#35b5c4")
    lime, violet = variation.paint("#8fc43a"), variation.paint("#6a4ac8")
    joints = [
        *moving("panes", (0, 0, -0.15), turn=Steady(0, 130)),
        *moving("inner", (0, 0, -0.15), turn=Steady(30, -190)),
        *moving("sand", (0.0, 0.0, 0.62), z=Swing(0, 0.08, 2)),
    ]
    parts: list[Part] = [
        Part(Box((0.3, 0.3, 0.05)), Plain((0.32, 0.25, 0.2)), position=(0, 0, -0.66)),
        Part(Capsule(0.1, 0.22), Stripes(((0.95, 0.9, 0.7), violet), 2, 0.12),
             position=(0, 0, -0.28)),
    ]  # fmt: skip
    for number, (angle, surface) in enumerate(
        ((0, _glass(pink, 0.22)), (120, _glass(cyan, 0.22)), (240, _glass(lime, 0.22)))
    ):
        place = around(3, 0.68)[number]
        parts += [
            Part(Box((0.02, 0.3, 0.42)), surface, "panes", place, (0, 0, angle)),
            Part(Box((0.03, 0.32, 0.02)), Plain((0.2, 0.2, 0.22)), "panes",
                 (*place[:2], -0.43), (0, 0, angle)),
        ]  # fmt: skip
    for number, (x, y, _) in enumerate(around(2, 0.34)):
        surface = Translucent(Plain((violet, pink)[number]), density=2.2)
        parts.append(Part(Ellipsoid((0.2, 0.2, 0.32)), surface, "inner", (x, y, 0)))
    parts += [
        Part(ball(0.36), Translucent(Plain(cyan), density=1.4, shell=0.1), "sand"),
        Part(Torus(0.38, 0.02), Plain((0.25, 0.22, 0.3)), "sand"),
        Part(ball(0.07), Plain((0.95, 0.6, 0.15)), "sand"),
    ]
    return Assembly(tuple(parts), tuple(joints), _SOFT)


def texture(variation: Variation) -> Assembly:
    """Rotating cube, ball and drum with fine patterns."""
    ink, paper = variation.natural("#20242e"), (0.95, 0.94, 0.9)
    red, blue = variation.paint("#c83a30"), variation.paint("#2a5ab8")
    joints = [
        *moving("cube", (-0.32, -0.2, -0.1), (0, 0, 15), turn=Steady(0, 150)),
        *moving("ball", (0.42, -0.3, -0.2), turn=Steady(0, -200), axis=(0.3, 0, 1)),
        *moving("drum", (0.3, 0.45, -0.15), turn=Swing(0, 60, 1), z=Swing(0, 0.1, 2)),
    ]
    parts = [
        Part(Box((0.85, 0.85, 0.04)), Checker((variation.natural("#d8d0bc"), ink), (0.05, 0.05, 1)),
             position=(0, 0, -0.56)),
        Part(Box((0.3, 0.3, 0.3)), Checker((red, paper, blue, paper, ink), (0.04, 0.04, 0.04)),
             "cube"),
        Part(ball(0.28), Checker((variation.paint("#2f9a58"), (0.97, 0.9, 0.4)),
             (0.045, 0.045, 0.045)), "ball"),
        Part(Cylinder(0.24, 0.26), Bricks(variation.natural("#b0553a"), paper, 0.075, 0.04, 0.009,
             around=0.24, tone=0.5), "drum"),
        Part(Torus(0.24, 0.05), Sectors((ink, variation.natural("#e0b840")), 60), "drum",
             (0, 0, 0.3)),
        Part(Box((0.03, 0.3, 0.35)), Stripes((blue, paper, red, paper), 1, 0.03),
             position=(-0.8, 0.35, -0.17)),
        Part(Ellipsoid((0.3, 0.16, 0.12)), Plain(variation.natural("#8a9a4a"), 0.5, 0.06),
             position=(-0.35, 0.5, -0.42)),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints))


def texture_test(variation: Variation) -> Assembly:
    """A fish with fine scales, striped rings and a flying carpet."""
    sand, stone = variation.natural("#cdb98c"), variation.natural("#8a8578")
    joints = [
        *moving("fish", (0.05, 0.1, 0.15), turn=Steady(30, 220), z=Swing(0, 0.12, 2)),
        *moving("tail", (-0.4, 0, 0), parent="fish", turn=Swing(0, 28, 4)),
        *moving("carpet", (0.0, -0.45, -0.12), x=Swing(0, 0.3, 1),
                turn=Swing(0, 14, 2), axis=(0, 1, 0)),
        *moving("rings", (-0.55, 0.5, -0.5), turn=Swing(0, 90, 1)),
    ]  # fmt: skip
    scales = Bricks(variation.paint("#3a88b0"), variation.natural("#16324a"), 0.06, 0.03, 0.008,
                    around=0.25, tone=0.6)  # fmt: skip
    weave = Checker((variation.paint("#a8304a"), variation.natural("#e8c060"),
                     variation.natural("#203050")), (0.035, 0.05, 0.035))  # fmt: skip
    parts = [
        Part(Cylinder(0.9, 0.05), Plain(sand, 0.45, 0.09), position=(0, 0, -0.58)),
        Part(Ellipsoid((0.4, 0.16, 0.24)), scales, "fish"),
        Part(Box((0.15, 0.02, 0.2)), Stripes((variation.paint("#e08838"), (0.2, 0.15, 0.2)), 2,
             0.025), "tail", (-0.12, 0, 0)),
        Part(Ellipsoid((0.14, 0.02, 0.1)), Stripes((variation.paint("#e08838"), (0.2, 0.15, 0.2)),
             0, 0.025), "fish", (0, 0, 0.26)),
        *(Part(ball(0.04), Plain((0.95, 0.95, 0.8)), "fish", (0.3, y, 0.07)) for y in (-0.1, 0.1)),
        Part(Box((0.4, 0.015, 0.27)), weave, "carpet"),
        *(Part(Torus(0.2 - 0.035 * i, 0.05), Sectors((variation.paint("#58a038"),
               (0.94, 0.92, 0.5), variation.natural("#2a2a24")), 45 - 9 * i), "rings",
               (0, 0, 0.02 + 0.085 * i)) for i in range(4)),
        Part(Box((0.14, 0.14, 0.22)), Bricks(stone, (0.9, 0.88, 0.82), 0.07, 0.035, 0.008,
             tone=0.6), "world", (0.58, 0.4, -0.32), (0, 0, 25)),
        Part(Box((0.16, 0.16, 0.025)), Checker(((0.15, 0.15, 0.17), (0.9, 0.9, 0.88)),
             (0.032, 0.032, 1)), "world", (0.58, 0.4, -0.075), (0, 0, 25)),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), Light(towards=(0.5, -0.6, 0.7), shadow=0.45))


def _glass(colour: tuple[float, float, float], opacity: float) -> Surface:
    return Translucent(Plain(colour), shell=opacity)
