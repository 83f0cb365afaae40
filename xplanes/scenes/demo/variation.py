"""What the seed of a scene changes: colours and the phases of motions."""

import colorsys
import random

from xplanes.scenes.demo.surfaces import Colour, rgb


class Variation:
    """Draws that depend on nothing but a scene's name and seed; seed 0 is the designed look.

    The same colour code becomes the same colour wherever a scene uses it.

    Args:
        name: Name of the scene.
        seed: Any whole number.
    """

    def __init__(self, name: str, seed: int) -> None:
        self._key = f"{name} {seed}"
        self._designed = seed == 0
        self._phases = random.Random(f"{self._key} phase")

    def paint(self, code: str) -> Colour:
        """A colour that may become any other hue, from its HTML code."""
        return self._recolour(code, 0.5)

    def natural(self, code: str) -> Colour:
        """A colour of wood, stone or grass, which stays what it is."""
        return self._recolour(code, 0.02)

    def phase(self, usual: float = 0.0) -> float:
        """Part of a cycle, from 0 to 1, at which a motion starts."""
        return usual if self._designed else self._phases.random()

    def _recolour(self, code: str, spread: float) -> Colour:
        colour = rgb(code)
        if self._designed:
            return colour
        draw = random.Random(f"{self._key} {code}")
        hue, saturation, value = colorsys.rgb_to_hsv(*colour)
        hue = (hue + draw.uniform(-spread, spread)) % 1.0
        return colorsys.hsv_to_rgb(hue, saturation, min(value * draw.uniform(0.9, 1.1), 1.0))
