"""How far a joint has moved at each time: degrees of a hinge, length of a slide."""

import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from dataclasses import dataclass


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
