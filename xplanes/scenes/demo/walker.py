"""A hiker who walks on the spot."""

from xplanes.scenes.demo.assembly import Assembly, Joint, Part
from xplanes.scenes.demo.motions import Swing
from xplanes.scenes.demo.primitives import Box, Capsule, Cylinder, Ellipsoid
from xplanes.scenes.demo.surfaces import Checker, Plain, Sectors, Stripes
from xplanes.scenes.demo.torus import Torus
from xplanes.scenes.demo.variation import Variation

_SIDES = (("left", 1.0, 0.0), ("right", -1.0, 0.5))
"""Name, side of the body, and lag of the stride."""

_STRIDES = 2


def walker(variation: Variation) -> Assembly:
    """Arms and legs swing, the body rises and falls a little; the ground stands still."""
    phase = variation.phase()
    joints = [
        Joint("body", "world", (0.0, 0.0, -0.06), (0, 0, 0), "slide", (0, 0, 1),
              Swing(0.0, 0.018, 2 * _STRIDES, 2 * phase)),
        Joint("chest", "body", (0.0, 0.0, 0.1), (0, 4, 0), "hinge", (0, 0, 1),
              Swing(0.0, 7.0, _STRIDES, phase)),
    ]  # fmt: skip
    parts = [*_ground(variation), *_trunk(variation), *_head(variation)]
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


def _ground(variation: Variation) -> list[Part]:
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
