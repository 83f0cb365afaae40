"""Balls that bounce on a tiled plate."""

from xplanes.scenes.demo.assembly import Assembly, Joint, Part
from xplanes.scenes.demo.motions import Bounce, Steady
from xplanes.scenes.demo.primitives import Box, Cylinder, Ellipsoid
from xplanes.scenes.demo.surfaces import Checker, Plain, Sectors, Stripes, Surface
from xplanes.scenes.demo.variation import Variation

_FLOOR = -0.55


def balls(variation: Variation) -> Assembly:
    """Five balls jump to their own beat and turn as they fly; plate and posts stand still."""
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
"""Place (x, y), radius, height of the jumps, their number, phase and surface."""


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
