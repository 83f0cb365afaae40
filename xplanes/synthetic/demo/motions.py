"""Motions of joints over time: degrees for a hinge, world units for a slide."""

import colorsys
import math
import random
from abc import ABC, abstractmethod
from bisect import bisect_right
from dataclasses import dataclass

from xplanes.synthetic.demo.geometry import Colour, rgb


class Motion(ABC):
    """A smooth function of time."""

    @abstractmethod
    def at(self, time: float) -> float:
        """State of the joint at ``time`` in [0, 1]."""


@dataclass(frozen=True)
class Swing(Motion):
    """Oscillation around ``centre``: ``centre + reach sin(2 pi (cycles time + phase))``."""

    centre: float
    reach: float
    cycles: float
    phase: float = 0.0

    def at(self, time: float) -> float:
        return self.centre + self.reach * math.sin(2 * math.pi * (self.cycles * time + self.phase))


@dataclass(frozen=True)
class Steady(Motion):
    """Constant speed: ``start + speed time``."""

    start: float
    speed: float

    def at(self, time: float) -> float:
        return self.start + self.speed * time


@dataclass(frozen=True)
class Keys(Motion):
    """Smooth interpolation of keyframes, with zero speed at each of them.

    Attributes:
        times: Times in ascending order.
        values: State at each time; constant before the first and after the last.
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
    """A ball that bounces ``count`` times to ``height``, with a smooth reversal at the ground."""

    height: float
    count: float
    phase: float = 0.0
    rounding: float = 0.08

    def at(self, time: float) -> float:
        # A parabola of a triangle wave with a smoothed tip.
        wave = math.cos(math.pi * (self.count * time + self.phase))
        soft = math.sqrt(1 - wave * wave + self.rounding**2) - self.rounding
        full = math.sqrt(1 + self.rounding**2) - self.rounding
        return self.height * soft / full


class Variation:
    """Random variation of a scene, determined by its name and seed; seed 0 keeps the designed look.

    Within a scene, a colour code always gives the same colour.

    Args:
        name: Name of the scene.
        seed: Any integer.
    """

    def __init__(self, name: str, seed: int) -> None:
        self._key = f"{name} {seed}"
        self._designed = seed == 0
        self._phases = random.Random(f"{self._key} phase")

    def paint(self, code: str) -> Colour:
        """A colour whose hue may change freely, from its HTML code."""
        return self._recolour(code, 0.5)

    def natural(self, code: str) -> Colour:
        """A colour whose hue changes only slightly (wood, stone, grass), from its HTML code."""
        return self._recolour(code, 0.02)

    def phase(self, usual: float = 0.0) -> float:
        """Initial phase of a motion, in [0, 1]."""
        return usual if self._designed else self._phases.random()

    def _recolour(self, code: str, spread: float) -> Colour:
        colour = rgb(code)
        if self._designed:
            return colour
        draw = random.Random(f"{self._key} {code}")
        hue, saturation, value = colorsys.rgb_to_hsv(*colour)
        hue = (hue + draw.uniform(-spread, spread)) % 1.0
        return colorsys.hsv_to_rgb(hue, saturation, min(value * draw.uniform(0.9, 1.1), 1.0))
