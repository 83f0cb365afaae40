"""A crawler excavator at work beside a heap of earth."""

from xplanes.scenes.demo.assembly import Assembly, Joint, Part
from xplanes.scenes.demo.motions import Keys
from xplanes.scenes.demo.primitives import Box, Capsule, Cylinder, Ellipsoid
from xplanes.scenes.demo.surfaces import Bricks, Colour, Plain, Sectors, Stripes
from xplanes.scenes.demo.torus import Torus
from xplanes.scenes.demo.variation import Variation

_STEPS = (0.0, 0.22, 0.42, 0.58, 0.8, 1.0)


def excavator(variation: Variation) -> Assembly:
    """Tracks, earth and cones stand still; house, boom, arm and bucket move."""
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


def _house(
    variation: Variation,
    yellow: Colour,
    dark: Colour,
    steel: Colour,
) -> list[Part]:
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


def _limbs(
    yellow: Colour,
    dark: Colour,
    steel: Colour,
) -> list[Part]:
    bar = Stripes((yellow, dark), 0, 0.085, 0.0)
    pins = [("boom", 0.0), ("bend", 0.0), ("arm", 0.0), ("bucket", 0.0)]
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
    for joint, x in pins:
        parts.append(Part(Cylinder(0.06, 0.075), Plain(steel), joint, (x, 0, 0), (90, 0, 0)))
    tooth = Box((0.035, 0.016, 0.01))
    teeth = [
        Part(tooth, Plain(steel), "bucket", (0.03, y, -0.13)) for y in (-0.1, -0.033, 0.033, 0.1)
    ]
    return parts + teeth
