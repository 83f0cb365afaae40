"""Drawing solids part by part: places, sizes, colours."""

import colorsys
import math

import numpy as np
from numpy.typing import NDArray

from xplanes.pretraining.solids import (
    BRICKS,
    CHECKER,
    PLAIN,
    SECTORS,
    STRIPES,
    Array,
    Solids,
)

Vector = tuple[float, float, float]
Pattern = tuple[int, tuple[Vector, Vector, Vector], tuple[float, ...]]
"""Kind, three paints, and numbers as `solids` lists them."""

ORIGIN: Vector = (0.0, 0.0, 0.0)


def place(position: Vector = ORIGIN, turn: Vector = ORIGIN, scale: float = 1.0) -> Array:
    """A similarity: scale, then turns about x, y and z in degrees, then a shift. [4, 4]"""
    (a, b, c), frame = (math.radians(angle) for angle in turn), np.eye(4)
    sa, ca, sb, cb, sc, cc = (f(v) for v in (a, b, c) for f in (math.sin, math.cos))
    frame[:3, :3] = [
        [cc * cb * scale, (cc * sb * sa - sc * ca) * scale, (cc * sb * ca + sc * sa) * scale],
        [sc * cb * scale, (sc * sb * sa + cc * ca) * scale, (sc * sb * ca - cc * sa) * scale],
        [-sb * scale, cb * sa * scale, cb * ca * scale],
    ]
    frame[:3, 3] = position
    return frame


class Builder:
    """Collects the parts of one object.

    Args:
        random: Where all choices come from.
    """

    def __init__(self, random: np.random.Generator) -> None:
        self.random = random
        self._kinds: list[int] = []
        self._sizes: list[Vector] = []
        self._frames: list[Array] = []
        self._patterns: list[Pattern] = []

    def add(self, frame: Array, kind: int, size: tuple[float, ...], pattern: Pattern) -> None:
        """One part, in the frame's units."""
        self._kinds.append(kind)
        self._sizes.append((*size, *(1.0,) * (3 - len(size))))  # type: ignore[arg-type]
        self._frames.append(frame)
        self._patterns.append(pattern)

    def solids(self, light: NDArray) -> Solids:
        """All parts so far."""
        frames = np.stack(self._frames)
        scales = np.linalg.norm(frames[:, :3, 0], axis=-1)
        numbers = [(*n, *(0.0,) * (4 - len(n))) for _, _, n in self._patterns]
        return Solids(
            np.array(self._kinds),
            np.array(self._sizes, dtype=np.float64) * scales[:, None],
            np.ascontiguousarray(frames[:, :3, :3] / scales[:, None, None]),
            np.ascontiguousarray(frames[:, :3, 3]),
            np.array([kind for kind, _, _ in self._patterns]),
            np.array([paints for _, paints, _ in self._patterns], dtype=np.float64),
            np.array(numbers, dtype=np.float64),
            np.asarray(light, dtype=np.float64),
        )

    def uniform(self, low: float, high: float) -> float:
        """A number between two."""
        return float(self.random.uniform(low, high))

    def count(self, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``, both included."""
        return int(self.random.integers(low, high + 1))

    def chance(self, share: float) -> bool:
        """True this often."""
        return bool(self.random.random() < share)

    def paint(self) -> Vector:
        """A colour: strong, natural, or close to grey."""
        taste, hue = self.random.random(), self.random.random()
        if taste < 0.5:
            saturation, value = self.uniform(0.4, 1), self.uniform(0.55, 1)
        elif taste < 0.75:
            hue, saturation, value = 0.4 * hue, self.uniform(0.15, 0.65), self.uniform(0.4, 1)
        else:
            saturation, value = self.uniform(0, 0.12), self.uniform(0.15, 1)
        return colorsys.hsv_to_rgb(hue, saturation, value)

    def pattern(self, size: float, plain: float = 0.6) -> Pattern:
        """A pattern for a part of about this size; plain this often."""
        paints = (self.paint(), self.paint(), self.paint())
        if self.chance(plain):
            mottle = self.uniform(0.02, 0.15) if self.chance(0.3) else 0.0
            return PLAIN, paints, (mottle, self.uniform(0.1, 0.6))
        kind, cell = self.count(STRIPES, SECTORS), size * self.uniform(0.2, 0.7)
        if kind == STRIPES:
            return kind, paints, (float(self.count(0, 2)), cell, float(self.count(2, 3)))
        if kind == CHECKER:
            return kind, paints, (cell, cell, cell, float(self.count(2, 3)))
        if kind == BRICKS:
            return kind, paints, (cell, 0.4 * cell, 0.07 * cell)
        return kind, paints, (float(self.count(2, 8) * 2), float(self.count(2, 3)))

    def plain(self) -> Pattern:
        """One colour."""
        return PLAIN, (self.paint(), ORIGIN, ORIGIN), (0.0, 1.0)
