"""Scenes with particular motions: fast, occluded, or ending early."""

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
    Torus,
)
from xplanes.synthetic.demo.motions import Bounce, Keys, Steady, Swing, Variation
from xplanes.synthetic.demo.shading import Light
from xplanes.synthetic.demo.suite.pieces import around, ball, moving, numbered, rod


def fast_motion(variation: Variation) -> Assembly:
    """A rotor turns four times, balls race around it in opposite directions, a hammer strikes."""
    red, blue = variation.paint("#d83c32"), variation.paint("#2e6ad0")
    joints = [
        *moving("rotor", (0, 0, 0.42), turn=Steady(0, 1440)),
        *moving("near", (0, 0, -0.1), turn=Steady(0, 1080)),
        *moving("far", (0, 0, -0.4), turn=Steady(90, -900)),
        *moving("hammer", (-0.62, -0.55, -0.25), turn=Swing(20, 55, 5), axis=(0, 1, 0)),
    ]
    parts = [
        Part(Cylinder(0.85, 0.04), Sectors(((0.82, 0.78, 0.7), (0.55, 0.53, 0.5)), 12),
             position=(0, 0, -0.64)),
        rod((0, 0, -0.6), (0, 0, 0.42), 0.07, Plain((0.45, 0.46, 0.5))),
        Part(ball(0.11), Plain((0.3, 0.3, 0.33)), "rotor"),
        Part(ball(0.15), Sectors((red, (0.95, 0.93, 0.88)), 4), "near", (0.48, 0, 0)),
        Part(ball(0.12), Plain(variation.paint("#3aa858")), "near", (-0.48, 0, 0)),
        Part(ball(0.16), Stripes((blue, (0.95, 0.93, 0.88)), 2, 0.1), "far", (0.68, 0, 0)),
        rod((-0.62, -0.55, -0.6), (-0.62, -0.55, -0.25), 0.04, Plain((0.45, 0.46, 0.5))),
        rod((0, 0, 0), (0, 0, 0.4), 0.03, Plain(variation.natural("#8a6038")), "hammer"),
        Part(Box((0.16, 0.08, 0.08)), Plain(variation.paint("#8a4ab8")), "hammer", (0, 0, 0.42)),
    ]  # fmt: skip
    blades = ((red, 0.0), ((0.93, 0.78, 0.25), 120.0), (blue, 240.0))
    for (paint, turn), place in zip(blades, around(3, 0.4), strict=True):
        parts.append(Part(Box((0.36, 0.1, 0.02)), Plain(paint), "rotor", place, (18, 0, turn)))
    return Assembly(tuple(parts), tuple(joints))


def fast_motion_test(variation: Variation) -> Assembly:
    """Clubs fly between two hands and tumble; a ball shoots to and fro; a top dances."""
    pink, lime = variation.paint("#d84a8a"), variation.paint("#88b832")
    white = (0.94, 0.93, 0.9)
    joints = []
    parts = [
        Part(Box((0.85, 0.6, 0.03)), Stripes((variation.natural("#9a8a70"),
             variation.natural("#8a7a62")), 0, 0.17), position=(0, 0, -0.78)),
        Part(Box((0.04, 0.5, 0.14)), Plain((0.4, 0.42, 0.48)), position=(-0.8, 0.0, -0.62)),
        Part(Box((0.04, 0.5, 0.14)), Plain((0.4, 0.42, 0.48)), position=(0.8, 0.0, -0.62)),
    ]  # fmt: skip
    for number, paint in enumerate((pink, lime, variation.paint("#3a90d8"))):
        name, phase = f"club {number}", number / 3
        joints += moving(name, (0, 0.12 * (number - 1), -0.45), x=Swing(0, 0.5, 2, phase),
                         z=Bounce(1.25, 4, 2 * phase + 0.5), turn=Steady(120.0 * number, 1300),
                         axis=(0, 1, 0))  # fmt: skip
        parts += [
            Part(Capsule(0.085, 0.11), Stripes((paint, white), 2, 0.09), name, (0, 0, 0.1)),
            Part(Capsule(0.03, 0.14), Plain(white), name, (0, 0, -0.12)),
        ]
    joints += [
        *moving("shot", (0, -0.38, -0.64), x=Swing(0, 0.62, 4), turn=Swing(0, 340, 4),
                axis=(0, 1, 0)),
        *moving("top", (0, 0.4, -0.72), x=Swing(0, 0.45, 3, 0.2), turn=Steady(0, 1800)),
    ]  # fmt: skip
    parts += [
        Part(ball(0.1), Sectors((variation.paint("#e07a28"), (0.2, 0.2, 0.24)), 6), "shot",
             rotation=(90, 0, 0)),
        Part(Ellipsoid((0.15, 0.15, 0.07)), Sectors((variation.paint("#7a48c0"), lime), 4), "top",
             (0, 0, 0.14)),
        Part(Capsule(0.022, 0.12), Plain(white), "top", (0, 0, 0.14)),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), Light(shadow=0.35))


def occlusion(variation: Variation) -> Assembly:
    """Balls on a track pass through a tunnel, behind columns and below a roof."""
    stone, dark = variation.natural("#c9c0ae"), variation.natural("#b0a592")
    codes = ("#d8403a", "#3a78d0", "#e8b030", "#3aa060")
    parts = [
        Part(Cylinder(0.95, 0.04), Plain(variation.natural("#8a9a6a"), 0.06, 0.3),
             position=(0, 0, -0.54)),
        Part(Box((0.62, 0.3, 0.035)), Plain(variation.paint("#a85040")), position=(0.0, 0.55, 0.2)),
        Part(Box((0.5, 0.22, 0.03)), Plain(variation.paint("#c06850")), position=(0.0, 0.55, 0.26)),
        Part(Box((0.2, 0.2, 0.35)), Bricks(stone, dark, 0.16, 0.08, 0.012),
             position=(0.0, 0.0, -0.15)),
        Part(Torus(0.65, 0.02), Plain((0.35, 0.35, 0.38)), position=(0, 0, -0.49)),
    ]  # fmt: skip
    parts += [
        Part(Cylinder(0.055, 0.34), Plain(stone), position=(x, y, -0.16))
        for x in (-0.52, -0.26, 0.0, 0.26, 0.52)
        for y in (0.36, 0.76)
    ]
    for angle in (-62.0, -90.0, -118.0):
        turn = angle + 90
        x, y, _ = around(1, 0.65, start=angle)[0]
        parts += [
            Part(Box((0.19, 0.02, 0.2)), Plain(dark), "world",
                 around(1, 0.85, -0.3, angle)[0], (0, 0, turn)),
            Part(Box((0.13, 0.02, 0.2)), Plain(dark), "world",
                 around(1, 0.45, -0.3, angle)[0], (0, 0, turn)),
            Part(Box((0.19, 0.22, 0.02)), Plain(variation.paint("#5a6a9a")), "world",
                 (x, y, -0.09), (0, 0, turn)),
        ]  # fmt: skip
    joints: list[Joint] = []
    for number, angle in numbered(4):
        name = f"ball {number}"
        joints += moving(name, (0, 0, -0.35), turn=Steady(angle + 20 * number, 360))
        pattern = Sectors((variation.paint(codes[number]), (0.95, 0.93, 0.88)), 6)
        parts.append(Part(ball(0.13), pattern, name, (0.65, 0, 0)))
    joints += moving("lift", (0, 0, 0.05), z=Swing(0.0, 0.34, 1))
    parts += [
        Part(Cylinder(0.12, 0.1), Sectors((variation.paint("#9a48b0"), (0.9, 0.85, 0.6)), 8),
             "lift"),
        Part(Ellipsoid((0.1, 0.1, 0.13)), Plain(variation.paint("#e8d040")), "lift", (0, 0, 0.12)),
    ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints))


def occlusion_test(variation: Variation) -> Assembly:
    """Drawers open and show what they hold, a screen passes in front of a clown in his box."""
    wood, light = variation.natural("#8a5c3a"), variation.natural("#a87a50")
    joints = [
        *moving("upper", (-0.35, -0.02, 0.1), y=Keys((0.05, 0.35, 0.55, 0.8), (0, -0.5, -0.5, 0))),
        *moving("lower", (-0.35, -0.02, -0.32), y=Keys((0.3, 0.6, 0.7, 1), (0, -0.5, -0.5, 0))),
        *moving("clown", (0.48, 0.3, -0.5), z=Keys((0.1, 0.4, 0.6, 0.95), (0, 0.48, 0.48, 0)),
                turn=Swing(0, 30, 2)),
        *moving("lid", (0.48, 0.55, -0.08), turn=Keys((0.05, 0.35, 0.65, 1), (0, 105, 105, 0)),
                axis=(-1, 0, 0)),
        *moving("screen", (0.48, -0.2, -0.15), x=Swing(0.0, 0.32, 1)),
    ]  # fmt: skip
    parts = [
        Part(Box((0.95, 0.8, 0.035)), Plain(variation.natural("#7a7a86"), 0.05, 0.4),
             position=(0, 0, -0.6)),
        *(Part(Box((0.02, 0.3, 0.44)), Plain(wood), position=(-0.35 + x, 0, -0.12))
          for x in (-0.36, 0.36)),
        *(Part(Box((0.36, 0.3, 0.02)), Plain(wood), position=(-0.35, 0, z))
          for z in (-0.54, -0.12, 0.32)),
        Part(Box((0.36, 0.02, 0.42)), Plain(wood), position=(-0.35, 0.29, -0.12)),
        *(Part(Box((0.02, 0.25, 0.21)), Plain(variation.paint("#b84a3a")),
               position=(0.48 + x, 0.3, -0.32)) for x in (-0.25, 0.25)),
        *(Part(Box((0.25, 0.02, 0.21)), Plain(variation.paint("#d8a03a")),
               position=(0.48, 0.3 + y, -0.32)) for y in (-0.25, 0.25)),
        Part(Box((0.26, 0.26, 0.02)), Plain(variation.paint("#b84a3a")), "lid", (0, -0.26, 0.0)),
        Part(ball(0.14), Plain(variation.natural("#e8b890")), "clown", (0, 0, 0.18)),
        Part(Capsule(0.13, 0.06), Checker((variation.paint("#3a9a58"), (0.92, 0.9, 0.5)),
             (0.08, 0.08, 0.08)), "clown", (0, 0, -0.06 + 0.02)),
        Part(Ellipsoid((0.1, 0.1, 0.14)), Stripes((variation.paint("#4a58c8"), (0.9, 0.9, 0.9)), 2,
             0.06), "clown", (0, 0, 0.34)),
        Part(ball(0.04), Plain((0.85, 0.15, 0.15)), "clown", (0, -0.14, 0.18)),
        Part(Box((0.22, 0.015, 0.36)), Stripes((variation.paint("#488a98"), (0.88, 0.86, 0.78)), 0,
             0.11), "screen"),
    ]  # fmt: skip
    for name, ware in (("upper", "#e0563a"), ("lower", "#3a88d0")):
        paint = variation.paint(ware)
        parts += [
            Part(Box((0.33, 0.02, 0.18)), Plain(light), name, (0, -0.28, 0)),
            Part(Box((0.33, 0.27, 0.015)), Plain(light), name, (0, 0, -0.16)),
            *(Part(Box((0.015, 0.27, 0.1)), Plain(light), name, (x, 0, -0.07))
              for x in (-0.31, 0.31)),
            Part(ball(0.035), Plain((0.8, 0.7, 0.35)), name, (0, -0.33, 0.04)),
            Part(ball(0.12), Sectors((paint, (0.95, 0.92, 0.85)), 6), name, (-0.14, -0.04, -0.03)),
            Part(Cylinder(0.09, 0.1), Plain(paint), name, (0.14, 0.06, -0.05)),
        ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), Light(towards=(0.2, -0.8, 0.7)))


def short_times(variation: Variation) -> Assembly:
    """A robot turns at the waist, waves, and nods; the recording ends at time 0.6."""
    shell, dark = variation.paint("#4a8ac0"), Plain((0.22, 0.23, 0.26))
    glow = Plain(variation.paint("#f0c838"))
    joints = [
        *moving("waist", (0, 0, -0.2), turn=Swing(0, 45, 2)),
        *moving("head", (0, 0, 0.46), parent="waist", turn=Swing(0, 22, 3, 0.1), axis=(1, 0, 0)),
        *moving("left", (-0.34, 0, 0.3), parent="waist", turn=Keys((0, 0.2, 0.4, 0.6, 0.8),
                (10, 150, 70, 150, 10)), axis=(0, 1, 0)),
        *moving("right", (0.34, 0, 0.3), parent="waist", turn=Swing(0, 60, 2), axis=(1, 0, 0)),
    ]  # fmt: skip
    parts = [
        Part(Cylinder(0.55, 0.05), Checker(((0.7, 0.7, 0.68), (0.5, 0.52, 0.55)),
             (0.16, 0.16, 1)), position=(0, 0, -0.82)),
        *(Part(Capsule(0.1, 0.2), dark, position=(x, 0, -0.48)) for x in (-0.15, 0.15)),
        *(Part(Box((0.11, 0.17, 0.05)), Plain(shell), position=(x, -0.04, -0.74))
          for x in (-0.15, 0.15)),
        Part(Box((0.28, 0.18, 0.24)), Plain(shell), "waist", (0, 0, 0.18)),
        Part(Box((0.16, 0.02, 0.1)), Checker((variation.paint("#f0c838"), (0.3, 0.3, 0.3)),
             (0.08, 1.0, 0.05)), "waist", (0, -0.18, 0.22)),
        Part(Cylinder(0.07, 0.06), dark, "waist", (0, 0, 0.44)),
        Part(Box((0.2, 0.16, 0.15)), Plain(shell), "head", (0, 0, 0.16)),
        *(Part(ball(0.05), glow, "head", (x, -0.16, 0.18)) for x in (-0.09, 0.09)),
        rod((0, 0, 0.3), (0, 0, 0.42), 0.015, dark, "head"),
        Part(ball(0.04), Plain(variation.paint("#d83a3a")), "head", (0, 0, 0.44)),
    ]  # fmt: skip
    for side in ("left", "right"):
        parts += [
            Part(ball(0.1), dark, side),
            Part(Capsule(0.065, 0.15), Plain(shell), side, (0, 0, -0.2)),
            Part(Capsule(0.055, 0.13), dark, side, (0, -0.02, -0.44)),
            Part(ball(0.085), glow, side, (0, -0.02, -0.6)),
        ]
    return Assembly(tuple(parts), tuple(joints))


def short_times_test(variation: Variation) -> Assembly:
    """A merry-go-round of animals turns and a ship swings; the recording ends at time 0.4."""
    canvas = Sectors((variation.paint("#c83a4a"), (0.95, 0.92, 0.84)), 12)
    gold, hull = Plain(variation.natural("#d0a040")), variation.natural("#7a5030")
    codes = ("#8a5a3a", "#3a8a9a", "#c89030", "#7a4a98")
    joints = [
        *moving("round", (-0.3, 0.15, -0.4), turn=Steady(0, 500)),
        *moving("ship", (0.62, -0.35, 0.25), turn=Swing(0, 50, 3), axis=(0, 1, 0)),
    ]
    parts = [
        Part(Box((1.0, 0.8, 0.03)), Plain(variation.natural("#9aa07a"), 0.06, 0.3),
             position=(0, 0, -0.62)),
        Part(Cylinder(0.52, 0.05), Sectors((variation.paint("#5070a8"), (0.9, 0.88, 0.8)), 16),
             "round", (0, 0, -0.1)),
        Part(Cylinder(0.06, 0.45), gold, "round", (0, 0, 0.35)),
        Part(Ellipsoid((0.56, 0.56, 0.16)), canvas, "round", (0, 0, 0.82)),
        Part(ball(0.06), gold, "round", (0, 0, 1.0)),
        *(rod((0.62, y, -0.6), (0.62, -0.35, 0.25), 0.035, gold) for y in (-0.6, -0.1)),
        *(rod((0, 0, 0), (x, 0, -0.5), 0.02, gold, "ship") for x in (-0.14, 0.14)),
        Part(Ellipsoid((0.32, 0.12, 0.1)), Stripes((hull, variation.paint("#c06a3a")), 2, 0.05),
             "ship", (0, 0, -0.56)),
        Part(Box((0.012, 0.1, 0.14)), Plain((0.94, 0.92, 0.86)), "ship", (0, 0, -0.36)),
    ]  # fmt: skip
    for number, (x, y, _) in enumerate(around(4, 0.38)):
        name = f"animal {number}"
        joints += moving(name, (x, y, 0.2), (0, 0, 90.0 * number + 90), parent="round",
                         z=Swing(0, 0.12, 4, 0.25 * number))  # fmt: skip
        coat = Plain(variation.paint(codes[number]), 0.15, 0.1)
        parts += [
            Part(Capsule(0.075, 0.11), coat, name, rotation=(0, 90, 0)),
            Part(Ellipsoid((0.1, 0.05, 0.06)), coat, name, (0.2, 0, 0.12)),
            rod((0.12, 0, 0.02), (0.17, 0, 0.12), 0.04, coat, name),
            *(rod((a, b, 0), (a, b, -0.16), 0.022, coat, name)
              for a in (-0.1, 0.1) for b in (-0.04, 0.04)),
            rod((x, y, -0.08), (x, y, 0.75), 0.014, gold, "round"),
        ]  # fmt: skip
    return Assembly(tuple(parts), tuple(joints), Light(towards=(-0.5, -0.5, 0.8), shadow=0.45))
