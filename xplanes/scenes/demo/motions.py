"""How far a joint has moved at each time: degrees of a hinge, length of a slide."""

import colorsys
import math
import random
from abc import ABC, abstractmethod
from bisect import bisect_right
from dataclasses import dataclass

from xplanes.scenes.demo.geometry import Colour, rgb


class Motion(ABC):
    """A smooth function of time."""

    @abstractmethod
    def at(self, time: float) -> float:
        """The state of the joint at ``time``, from 0 to 1."""


@dataclass(frozen=True)
class Swing(Motion):
    """To and fro around ``centre``: ``centre + reach sin(2 pi (cycles time + phase))``."""

    centre: float
    reach: float
    cycles: float
    phase: float = 0.0

    def at(self, time: float) -> float:
        return self.centre + self.reach * math.sin(2 * math.pi * (self.cycles * time + self.phase))


@dataclass(frozen=True)
class Steady(Motion):
    """At constant speed: ``start + speed time``."""

    start: float
    speed: float

    def at(self, time: float) -> float:
        return self.start + self.speed * time


@dataclass(frozen=True)
class Keys(Motion):
    """Through given values at given times, coming to rest at each.

    Attributes:
        times: Rising times.
        values: State at each of them; before the first and after the last nothing moves.
    """

    times: tuple[float, ...]
    values: tuple[float, ...]

    def at(self, time: float) -> float:
        after = bisect_right(self.times, time)
        if after == 0 or after == len(self.times):
            return self.values[0 if after == 0 else -1]
        start, stop = self.times[after - 1], self.times[after]
        part = (time - start) / (stop - start)
        eased = part * part * part * (part * (6 * part - 15) + 10)
        return self.values[after - 1] + eased * (self.values[after] - self.values[after - 1])


@dataclass(frozen=True)
class Bounce(Motion):
    """A ball that jumps to ``height`` ``count`` times; the turn at the ground is rounded off."""

    height: float
    count: float
    phase: float = 0.0
    rounding: float = 0.08

    def at(self, time: float) -> float:
        # A parabola of the triangle wave, whose tip is softened.
        wave = math.cos(math.pi * (self.count * time + self.phase))
        soft = math.sqrt(1 - wave * wave + self.rounding**2) - self.rounding
        full = math.sqrt(1 + self.rounding**2) - self.rounding
        return self.height * soft / full


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
