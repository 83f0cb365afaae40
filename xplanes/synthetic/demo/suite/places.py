"""Scenes with particular positions, scales and camera arrangements."""

from xplanes.synthetic.demo.assembly import Assembly, Part, Vector
from xplanes.synthetic.demo.geometry import (
    Box,
    Capsule,
    Checker,
    Colour,
    Cylinder,
    Ellipsoid,
    Plain,
    Sectors,
    Stripes,
    Torus,
)
from xplanes.synthetic.demo.implicit import Bent
from xplanes.synthetic.demo.motions import Bounce, Keys, Steady, Swing, Variation
from xplanes.synthetic.demo.shading import Light
from xplanes.synthetic.demo.suite.pieces import around, ball, moving, rod

AWAY: Vector = (3.6, -2.8, 2.0)
"""Centre of the scene ``off_centre``."""

AWAY_TEST: Vector = (-2.2, 4.4, -1.4)
"""Centre of the scene ``off_centre_test``."""

LARGE, SMALL = 10.0, 0.1
"""Scale of ``scale`` and ``scale_test`` relative to the other scenes."""


def off_centre(variation: Variation) -> Assembly:
    """A tractor drives on the spot across furrows, far from the origin."""
    green, yellow = variation.paint("#3f8a3c"), Plain(variation.paint("#e8c030"))
    black = Plain((0.13, 0.13, 0.14))
    joints = [
        *moving("body", (0, 0, -0.02), z=Swing(0, 0.03, 3), turn=Swing(0, 4, 2), axis=(0, 1, 0)),
        *moving("plough", (0.62, 0, -0.15), turn=Swing(-10, 25, 1), axis=(0, 1, 0)),
        *moving("rear", (0.28, 0, -0.2), (90, 0, 0), turn=Steady(0, -300)),
        *moving("front", (-0.42, 0, -0.32), (90, 0, 0), turn=Steady(0, -500)),
    ]
    parts = [
        Part(Box((0.9, 0.6, 0.05)), Stripes((variation.natural("#7a5a3c"),
             variation.natural("#6a4c32")), 1, 0.1), position=(0, 0, -0.6)),
        Part(Box((0.34, 0.16, 0.14)), Plain(green), "body", (-0.24, 0, 0.02)),
        Part(Box((0.2, 0.2, 0.1)), Plain(green), "body", (0.26, 0, 0.0)),
        *(rod((x, y, 0.08), (x * 0.9 + 0.02, y, 0.5), 0.025, black, "body")
          for x in (0.1, 0.42) for y in (-0.17, 0.17)),
        Part(Box((0.24, 0.24, 0.03)), Plain(green), "body", (0.26, 0, 0.52)),
        Part(Capsule(0.025, 0.14), black, "body", (-0.4, 0.0, 0.28)),
        Part(Capsule(0.09, 0.08), Plain(variation.paint("#c8483a")), "body", (0.26, 0, 0.2)),
        Part(ball(0.09), Plain(variation.natural("#e0b088")), "body", (0.26, 0, 0.4)),
        *(Part(ball(0.05), yellow, "body", (-0.58, y, 0.04)) for y in (0.1, -0.1)),
        rod((0, 0, 0), (0.24, 0, -0.12), 0.03, yellow, "plough"),
        *(Part(Box((0.04, 0.015, 0.1)), Plain((0.6, 0.62, 0.66)), "plough", (0.25, y, -0.2),
               (0, -20, 0)) for y in (-0.2, 0.0, 0.2)),
        Part(Box((0.03, 0.26, 0.02)), yellow, "plough", (0.24, 0, -0.11)),
    ]  # fmt: skip
    for joint, ring, tube, apart in (("rear", 0.25, 0.085, 0.28), ("front", 0.14, 0.06, 0.22)):
        for side in (-apart, apart):
            parts += [
                Part(Torus(ring, tube), Sectors(((0.13, 0.13, 0.14), (0.24, 0.24, 0.25)), 18),
                     joint, (0, 0, side)),
                Part(Cylinder(ring * 0.75, 0.03), Sectors((variation.paint("#e8c030"),
                     variation.paint("#b88a20")), 6), joint, (0, 0, side)),
            ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints)).placed(AWAY)


def off_centre_test(variation: Variation) -> Assembly:
    """A lighthouse turns its lamp above boats that rock on the sea, far from the origin."""
    sea, red = variation.natural("#3a7a98"), variation.paint("#c83a34")
    white = (0.95, 0.94, 0.9)
    joints = [*moving("lamp", (-0.25, 0.2, 0.62), turn=Steady(0, 320))]
    parts = [
        Part(Cylinder(0.9, 0.06), Plain(sea, 0.1, 0.25), position=(0, 0, -0.64)),
        Part(Ellipsoid((0.36, 0.34, 0.2)), Plain(variation.natural("#8a8070"), 0.15, 0.15),
             position=(-0.25, 0.2, -0.58)),
        *(Part(Cylinder(0.17 - 0.02 * i, 0.12), Plain(red if i % 2 == 0 else white),
               position=(-0.25, 0.2, -0.32 + 0.24 * i)) for i in range(4)),
        Part(Torus(0.13, 0.025), Plain((0.3, 0.3, 0.34)), position=(-0.25, 0.2, 0.53)),
        Part(Cylinder(0.08, 0.09), Plain((0.95, 0.9, 0.55)), "lamp"),
        Part(Box((0.02, 0.09, 0.09)), Plain((0.15, 0.15, 0.18)), "lamp", (0.07, 0, 0)),
        rod((0.1, 0, 0), (0.34, 0, 0), 0.03, Plain(variation.paint("#f0d850")), "lamp"),
        Part(Ellipsoid((0.12, 0.12, 0.1)), Plain(red), position=(-0.25, 0.2, 0.74)),
    ]  # fmt: skip
    for number, (x, y, turn) in enumerate(((0.45, 0.1, 30), (0.1, -0.55, 200), (0.3, 0.6, 110))):
        name, phase = f"boat {number}", 0.3 * number
        joints += moving(name, (x, y, -0.5), (0, 0, float(turn)), z=Swing(0, 0.06, 2, phase),
                         turn=Swing(0, 14, 2, phase + 0.25), axis=(1, 0, 0))  # fmt: skip
        sail = Plain(variation.paint(("#e09a38", "#4a60b8", "#5a9a50")[number]))
        parts += [
            Part(Ellipsoid((0.2, 0.09, 0.09)), Plain(variation.natural("#8a5030")), name),
            rod((0, 0, 0.05), (0, 0, 0.5), 0.016, Plain(white), name),
            Part(Box((0.1, 0.01, 0.16)), sail, name, (0.11, 0, 0.3)),
        ]
    return Assembly(tuple(parts), tuple(joints), Light(towards=(-0.6, -0.3, 0.8))).placed(AWAY_TEST)


def scale(variation: Variation) -> Assembly:
    """A drawbridge opens for a ship; ten times as large as other scenes."""
    stone, wood = variation.natural("#a09a90"), variation.natural("#80583a")
    joints = [
        *moving("left", (-0.42, 0, -0.1), turn=Keys((0.05, 0.35, 0.7, 1), (0, -65, -65, 0)),
                axis=(0, 1, 0)),
        *moving("right", (0.42, 0, -0.1), turn=Keys((0.05, 0.35, 0.7, 1), (0, 65, 65, 0)),
                axis=(0, 1, 0)),
        *moving("ship", (0, 0, -0.5), y=Keys((0.1, 0.95), (-0.55, 0.55)), turn=Swing(0, 5, 3),
                axis=(0, 1, 0)),
    ]  # fmt: skip
    planks = Stripes((wood, variation.natural("#6e4a30")), 0, 0.07)
    parts = [
        Part(Box((0.95, 0.85, 0.04)), Plain(variation.natural("#4a88a8"), 0.08, 0.2),
             position=(0, 0, -0.64)),
        Part(Box((0.21, 0.2, 0.025)), planks, "left", (0.21, 0, 0)),
        Part(Box((0.21, 0.2, 0.025)), planks, "right", (-0.21, 0, 0)),
        Part(Ellipsoid((0.13, 0.3, 0.12)), Plain(variation.paint("#b84a3a")), "ship"),
        Part(Box((0.09, 0.14, 0.06)), Plain((0.93, 0.92, 0.88)), "ship", (0, 0.04, 0.13)),
        Part(Cylinder(0.045, 0.1), Stripes((variation.paint("#e0b030"), (0.2, 0.2, 0.22)), 2, 0.07),
             "ship", (0, 0.04, 0.26)),
    ]  # fmt: skip
    for side in (-1, 1):
        parts += [
            Part(Box((0.22, 0.22, 0.24)), Plain(stone, 0.06, 0.15),
                 position=(0.68 * side, 0, -0.36)),
            *(Part(Box((0.06, 0.05, 0.3)), Checker((stone, variation.natural("#b8b0a0")),
                   (0.06, 0.1, 0.075)), position=(0.5 * side, y, 0.2)) for y in (-0.24, 0.24)),
            Part(Cylinder(0.03, 0.24), Plain((0.35, 0.35, 0.38)), "world", (0.5 * side, 0, 0.5),
                 (90, 0, 0)),
            *(Part(ball(0.065), Plain(variation.paint("#3a8a58")), position=(0.5 * side, y, 0.55))
              for y in (-0.24, 0.24)),
        ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints)).placed((0, 0, 0), scale=LARGE)


def scale_test(variation: Variation) -> Assembly:
    """A music box with a dancer, drum and bell; ten times as small as other scenes."""
    rose, gold = variation.paint("#c86a80"), Plain(variation.natural("#d0a848"))
    box = Checker((variation.paint("#4a5a98"), variation.paint("#586ab0")), (0.12, 0.12, 0.12))
    joints = [
        *moving("dancer", (-0.2, 0, -0.28), turn=Steady(0, 400)),
        *moving("arm", (0, 0, 0.58), parent="dancer", turn=Swing(0, 35, 3), axis=(1, 0, 0)),
        *moving("drum", (0.48, -0.3, -0.3), (0, 90, 0), turn=Steady(0, 300)),
        *moving("bell", (0.5, 0.35, 0.3), turn=Swing(0, 28, 3), axis=(1, 0, 0)),
    ]
    parts = [
        Part(Box((0.8, 0.62, 0.13)), box, position=(0, 0, -0.5)),
        Part(Box((0.84, 0.66, 0.025)), gold, position=(0, 0, -0.37)),
        Part(Cylinder(0.3, 0.03), Sectors(((0.94, 0.92, 0.88), rose), 10), "dancer",
             (0, 0, -0.03)),
        *(rod((x, 0, 0), (0.4 * x, 0, 0.32), 0.03, Plain(variation.natural("#eac0a8")), "dancer")
          for x in (-0.07, 0.07)),
        Part(Ellipsoid((0.25, 0.25, 0.07)), Sectors((rose, (0.95, 0.85, 0.88)), 14), "dancer",
             (0, 0, 0.34)),
        Part(Capsule(0.075, 0.1), Plain(rose), "dancer", (0, 0, 0.47)),
        Part(ball(0.085), Plain(variation.natural("#eac0a8")), "dancer", (0, 0, 0.75)),
        Part(Ellipsoid((0.09, 0.09, 0.06)), Plain(variation.natural("#5a3420")), "dancer",
             (0, 0.02, 0.81)),
        rod((0, 0, 0), (0.3, 0, 0.22), 0.025, Plain(variation.natural("#eac0a8")), "arm"),
        rod((0, 0, 0), (-0.3, 0, 0.22), 0.025, Plain(variation.natural("#eac0a8")), "arm"),
        Part(Cylinder(0.13, 0.22), Stripes(((0.82, 0.7, 0.35), (0.6, 0.48, 0.2)), 2, 0.055),
             "drum"),
        *(Part(ball(0.022), Plain((0.35, 0.3, 0.2)), "drum", (x, y, z))
          for z in (-0.14, 0.0, 0.14) for x, y, _ in around(5, 0.13, start=200 * z)),
        *(rod((0.5 + x, 0.35 + y, -0.36), (0.5, 0.35 + 0.4 * y, 0.3), 0.02, gold)
          for x in (-0.15, 0.15) for y in (-0.15, 0.15)),
        Part(Ellipsoid((0.15, 0.15, 0.17)), Plain(variation.paint("#8ab0a0")), "bell",
             (0, 0, -0.22)),
        Part(Torus(0.14, 0.025), gold, "bell", (0, 0, -0.3)),
        Part(ball(0.045), Plain((0.3, 0.3, 0.3)), "bell", (0, 0, -0.42)),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), Light(shadow=0.4)).placed((0, 0, 0), scale=SMALL)


def fixed_cameras(variation: Variation) -> Assembly:
    """A figure dances beside a jumping dog."""
    skin, hair = Plain(variation.natural("#d8a078")), Plain(variation.natural("#3a2a20"))
    top, skirt = variation.paint("#d04a5a"), variation.paint("#3a5aa8")
    joints = [
        *moving("hips", (-0.15, 0.1, -0.1), x=Swing(0, 0.12, 2), z=Swing(0, 0.04, 4),
                turn=Swing(0, 50, 1)),
        *moving("chest", (0, 0, 0.12), parent="hips", turn=Swing(0, 16, 2, 0.2), axis=(0, 1, 0)),
        *moving("dog", (0.5, -0.3, -0.5), (0, 0, 160), z=Bounce(0.4, 3),
                turn=Swing(0, 15, 3), axis=(0, 1, 0)),
        *moving("tail", (-0.2, 0, 0.08), parent="dog", turn=Swing(0, 45, 6)),
    ]  # fmt: skip
    parts = [
        Part(Cylinder(0.85, 0.03), Checker(((0.85, 0.8, 0.72), (0.62, 0.5, 0.42)),
             (0.17, 0.17, 1)), position=(0, 0, -0.75)),
        Part(Ellipsoid((0.24, 0.2, 0.18)), Stripes((skirt, (0.9, 0.88, 0.85)), 2, 0.07), "hips",
             (0, 0, -0.05)),
        Part(Capsule(0.14, 0.14), Plain(top), "chest", (0, 0, 0.16)),
        Part(ball(0.13), skin, "chest", (0, 0, 0.52)),
        Part(ball(0.135), hair, "chest", (0, 0.035, 0.56)),
        Part(Ellipsoid((0.05, 0.05, 0.14)), hair, "chest", (0, 0.15, 0.46)),
    ]  # fmt: skip
    for side in (-1, 1):
        leg, arm, low = f"leg {side}", f"arm {side}", f"elbow {side}"
        joints += [
            *moving(leg, (0.1 * side, 0, -0.12), parent="hips", turn=Swing(0, 26 * side, 2),
                    axis=(1, 0, 0)),
            *moving(arm, (0.17 * side, 0, 0.3), parent="chest",
                    turn=Swing(-75 * side, 50 * side, 2, 0.25), axis=(0, 1, 0)),
            *moving(low, (0, 0, -0.24), parent=arm, turn=Swing(-30 * side, 40, 3), axis=(0, 1, 0)),
        ]  # fmt: skip
        parts += [
            Part(Capsule(0.07, 0.15), skin, leg, (0, 0, -0.2)),
            Part(Capsule(0.055, 0.1), skin, leg, (0, 0, -0.42)),
            Part(Ellipsoid((0.06, 0.11, 0.05)), Plain((0.2, 0.2, 0.25)), leg, (0, -0.04, -0.56)),
            Part(Capsule(0.05, 0.1), Plain(top), arm, (0, 0, -0.12)),
            Part(Capsule(0.042, 0.1), skin, low, (0, 0, -0.12)),
            Part(ball(0.055), skin, low, (0, 0, -0.27)),
        ]
    coat = Plain(variation.natural("#b88a50"), 0.2, 0.15)
    parts += [
        Part(Capsule(0.1, 0.14), coat, "dog", (0, 0, 0.05), (0, 90, 0)),
        Part(Ellipsoid((0.12, 0.09, 0.09)), coat, "dog", (0.27, 0, 0.18)),
        Part(ball(0.03), hair, "dog", (0.39, 0, 0.19)),
        *(Part(Ellipsoid((0.03, 0.02, 0.08)), hair, "dog", (0.23, y, 0.24)) for y in (-0.08, 0.08)),
        *(rod((x, y, 0), (x, y, -0.18), 0.035, coat, "dog")
          for x in (-0.14, 0.14) for y in (-0.07, 0.07)),
        rod((0, 0, 0), (-0.16, 0, 0.12), 0.025, coat, "tail"),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints))


def fixed_cameras_test(variation: Variation) -> Assembly:
    """A crane swings its load between stacks of containers while a lorry passes."""
    yellow, steel = Plain(variation.paint("#e0a828")), Plain((0.5, 0.52, 0.56))
    joints = [
        *moving("jib", (-0.3, 0.2, 0.75), turn=Swing(-20, 75, 1)),
        *moving("trolley", (0, 0, 0), parent="jib", x=Swing(0.55, 0.2, 2)),
        *moving("load", (0, 0, -0.5), parent="trolley", z=Swing(-0.05, 0.2, 2, 0.3)),
        *moving("lorry", (0, -0.58, -0.6), x=Keys((0.0, 0.45, 0.6, 1), (-0.6, 0.15, 0.15, 0.65))),
    ]
    parts = [
        Part(Box((1.0, 0.8, 0.03)), Plain((0.55, 0.54, 0.52), 0.05, 0.3), position=(0, 0, -0.75)),
        Part(Box((0.98, 0.02, 0.002)), Plain((0.9, 0.88, 0.6)), position=(0, -0.38, -0.718)),
        *(rod((-0.3 + x, 0.2 + y, -0.72), (-0.3 + x, 0.2 + y, 0.72), 0.025, yellow)
          for x in (-0.08, 0.08) for y in (-0.08, 0.08)),
        *(rod((-0.3 - 0.08 * s, 0.12, z), (-0.3 + 0.08 * s, 0.12, z + 0.2), 0.014, yellow)
          for s, z in ((1, -0.6), (-1, -0.4), (1, -0.2), (-1, 0.0), (1, 0.2), (-1, 0.4))),
        *(rod((-0.3 - 0.08 * s, 0.28, z), (-0.3 + 0.08 * s, 0.28, z + 0.2), 0.014, yellow)
          for s, z in ((-1, -0.6), (1, -0.4), (-1, -0.2), (1, 0.0), (-1, 0.2), (1, 0.4))),
        Part(Box((0.62, 0.05, 0.04)), yellow, "jib", (0.34, 0, 0.02)),
        Part(Box((0.12, 0.1, 0.09)), Plain((0.4, 0.4, 0.42)), "jib", (-0.32, 0, 0.0)),
        Part(Box((0.1, 0.1, 0.1)), Plain(variation.paint("#e8e0c8")), "jib", (0.05, 0.12, -0.05)),
        Part(Box((0.06, 0.07, 0.03)), steel, "trolley", (0, 0, -0.04)),
        rod((0, 0, 0), (0, 0, 0.45), 0.012, steel, "load"),
        Part(Box((0.2, 0.09, 0.09)), Stripes((variation.paint("#c04838"),
             variation.paint("#a83a2e")), 0, 0.05), "load", (0, 0, -0.09)),
        Part(Box((0.24, 0.1, 0.03)), steel, "lorry", (0.05, 0, 0)),
        Part(Box((0.09, 0.11, 0.11)), Plain(variation.paint("#3a78b0")), "lorry", (0.3, 0, 0.1)),
        Part(Box((0.02, 0.09, 0.045)), Plain((0.75, 0.85, 0.9)), "lorry", (0.38, 0, 0.14)),
        *(Part(Cylinder(0.06, 0.03), Plain((0.12, 0.12, 0.12)), "lorry", (x, y, -0.06), (90, 0, 0))
          for x in (-0.12, 0.08, 0.3) for y in (-0.1, 0.1)),
    ]  # fmt: skip
    codes = ("#4a8a5a", "#3a6a9a", "#b8743a", "#8a4a6a", "#5a5a8a")
    places = ((0.6, 0.5, 0), (0.6, 0.5, 1), (0.6, 0.28, 0), (0.15, 0.6, 0), (0.6, -0.1, 0))
    for code, (x, y, level) in zip(codes, places, strict=True):
        wall = Stripes((variation.paint(code), _darker(variation.paint(code))), 0, 0.05)
        parts.append(Part(Box((0.2, 0.09, 0.09)), wall, position=(x, y, -0.63 + 0.185 * level)))
    return Assembly(tuple(parts), tuple(joints), Light(towards=(-0.3, -0.7, 0.8)))


def _darker(paint: Colour) -> Colour:
    """A slightly darker colour."""
    red, green, blue = paint
    return 0.82 * red, 0.82 * green, 0.82 * blue


def half_circle(variation: Variation) -> Assembly:
    """Puppets play on a stage with curtains, seen from the front only."""
    velvet, wood = variation.paint("#9a2a38"), variation.natural("#8a6240")
    joints = [
        *moving("king", (-0.35, -0.1, 0.0), x=Swing(0.1, 0.2, 1), z=Swing(0, 0.06, 3),
                turn=Swing(0, 25, 2)),
        *moving("dragon", (0.35, -0.05, -0.05), x=Swing(0, -0.15, 1), turn=Swing(0, 20, 2, 0.3),
                axis=(0, 1, 0)),
        *moving("sun", (0, 0.3, 0.0), turn=Steady(-60, 120), axis=(0, 1, 0)),
    ]  # fmt: skip
    parts = [
        Part(Box((0.9, 0.5, 0.06)), Stripes((wood, variation.natural("#7a5436")), 0, 0.12),
             position=(0, 0, -0.62)),
        Part(Box((0.9, 0.03, 0.62)), Plain(variation.natural("#6a90b8"), 0.1, 0.5),
             position=(0, 0.48, 0.06)),
        Part(Box((0.92, 0.06, 0.09)), Stripes((velvet, variation.natural("#d8b048")), 0, 0.1),
             position=(0, -0.42, 0.7)),
        Part(Ellipsoid((0.5, 0.03, 0.2)), Plain(variation.natural("#5a9050")),
             position=(-0.4, 0.42, -0.5)),
        Part(Ellipsoid((0.6, 0.03, 0.26)), Plain(variation.natural("#4a7c48")),
             position=(0.4, 0.4, -0.52)),
        Part(ball(0.1), Plain(variation.paint("#f0c030")), "sun", (0, 0.1, 0.5)),
        Part(Capsule(0.13, 0.13), Plain(variation.paint("#5a3a98")), "king", (0, 0, -0.25)),
        Part(ball(0.12), Plain(variation.natural("#e8bc98")), "king", (0, 0, 0.08)),
        Part(Torus(0.09, 0.03), Sectors((variation.natural("#e0b840"), (0.7, 0.5, 0.15)), 10),
             "king", (0, 0, 0.18)),
        *(rod((0.12 * s, -0.03, -0.12), (0.24 * s, -0.14, -0.26), 0.04,
              Plain(variation.paint("#5a3a98")), "king") for s in (-1, 1)),
        *(Part(ball(0.02), Plain((0.1, 0.1, 0.1)), "king", (0.045 * s, -0.11, 0.1))
          for s in (-1, 1)),
        Part(Capsule(0.12, 0.16), Stripes((variation.paint("#3a9a50"),
             variation.paint("#60b870")), 2, 0.08), "dragon", (0, 0, -0.24)),
        Part(Ellipsoid((0.18, 0.12, 0.1)), Plain(variation.paint("#3a9a50")), "dragon",
             (-0.1, 0, 0.08)),
        *(Part(ball(0.04), Plain((0.95, 0.85, 0.3)), "dragon", (-0.06, 0.08 * s, 0.16))
          for s in (-1, 1)),
        *(Part(Ellipsoid((0.02, 0.12, 0.09)), Plain(variation.paint("#e08030")), "dragon",
               (0.08, 0.16 * s, -0.1), (25 * s, 0, 0)) for s in (-1, 1)),
    ]  # fmt: skip
    for side in (-1, 1):
        for fold in range(4):
            place = (side * (0.86 - 0.1 * fold), -0.4, 0.05)
            parts.append(Part(Capsule(0.055, 0.58), Plain(velvet, 0.05, 0.2), position=place))
    return Assembly(tuple(parts), tuple(joints), Light(towards=(0.2, -0.9, 0.5), shadow=0.4))


def half_circle_test(variation: Variation) -> Assembly:
    """A pantry wall: a cat on the shelf, a clock with a pendulum, a fan, a plant that sways."""
    wall, shelf = variation.natural("#d8c8a0"), Plain(variation.natural("#7a5234"))
    fur = Plain(variation.natural("#d08a40"), 0.2, 0.1)
    joints = [
        *moving("pendulum", (-0.48, 0.1, 0.4), turn=Swing(0, 24, 3), axis=(0, 1, 0)),
        *moving("fan", (0.5, 0.1, 0.42), (90, 0, 0), turn=Steady(0, 420)),
        *moving("head", (0.02, -0.02, 0.08), turn=Swing(0, 45, 1)),
        *moving("paw", (0.12, -0.1, -0.1), turn=Swing(0, 30, 2), axis=(0, 1, 0)),
    ]
    parts = [
        Part(Box((0.9, 0.03, 0.85)), Checker((wall, variation.natural("#c8b890")), (0.3, 1, 0.3)),
             position=(0, 0.22, 0)),
        *(Part(Box((0.85, 0.2, 0.025)), shelf, position=(0, 0, z)) for z in (-0.24, -0.8)),
        Part(Cylinder(0.2, 0.05), Sectors((variation.paint("#3a6a58"), (0.9, 0.9, 0.82)), 12),
             "world", (-0.48, 0.14, 0.45), (90, 0, 0)),
        rod((0, 0, 0), (0, 0, -0.42), 0.016, Plain((0.75, 0.6, 0.25)), "pendulum"),
        Part(Cylinder(0.075, 0.015), Plain((0.85, 0.7, 0.3)), "pendulum", (0, 0, -0.44),
             (90, 0, 0)),
        Part(ball(0.06), Plain((0.3, 0.3, 0.34)), "fan"),
        *(Part(Ellipsoid((0.13, 0.06, 0.012)), Plain(variation.paint("#4a90c0")), "fan",
               (x, y, 0), (0, 0, 72.0 * i)) for i, (x, y, _) in enumerate(around(5, 0.15))),
        Part(Torus(0.31, 0.02), Plain((0.4, 0.42, 0.45)), "fan"),
        rod((0.5, 0.1, 0.1), (0.5, 0.1, -0.22), 0.03, Plain((0.4, 0.42, 0.45))),
        Part(Ellipsoid((0.14, 0.12, 0.17)), fur, position=(0.02, 0, -0.08)),
        Part(ball(0.105), fur, "head", (0, -0.04, 0.08)),
        *(Part(Ellipsoid((0.035, 0.02, 0.06)), fur, "head", (0.06 * s, -0.02, 0.18), (0, 14 * s, 0))
          for s in (-1, 1)),
        *(Part(ball(0.02), Plain((0.2, 0.45, 0.2)), "head", (0.04 * s, -0.13, 0.1))
          for s in (-1, 1)),
        rod((0, 0, 0), (0.12, -0.08, 0.16), 0.035, fur, "paw"),
        Part(Bent(length=0.5, radius=0.035, tip=0.03, bend=Swing(60, 50, 2)),
             Stripes((variation.natural("#d08a40"), variation.natural("#a86828")), 2, 0.06),
             "world", (-0.08, -0.16, -0.26), (0, 150, 0)),
        Part(Cylinder(0.13, 0.1), Plain(variation.paint("#b8503a")), position=(-0.45, 0, -0.67)),
        *(Part(Bent(length=0.36, radius=0.03, tip=0.012, bend=Swing(35, 25, 2, 0.2 * i)),
               Plain(variation.natural("#4a9048")), "world", (-0.45, 0, -0.58), (0, 0, 72.0 * i))
          for i in range(5)),
        *(Part(Cylinder(0.09, 0.13), Stripes((variation.paint(code), (0.93, 0.9, 0.84)), 2, 0.09),
               position=(x, 0.02, -0.64)) for x, code in ((0.1, "#4a6ab0"), (0.34, "#b89030"),
               (0.58, "#8a4a90"))),
    ]  # fmt: skip
    room = Assembly(tuple(parts), tuple(joints), Light(towards=(0.9, -0.4, 0.6), shadow=0.4))
    return room.placed((0, 0, 0), (0, 0, 90))
