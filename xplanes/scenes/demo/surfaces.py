"""Colours painted through a solid, in the coordinates of the part that wears them.

A pattern fills the volume, so that any point has a colour, not only the surface. All colours are
RGB in [0, 1].
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

Colour = tuple[float, float, float]


def rgb(code: str) -> Colour:
    """The colour of an HTML code such as ``#f0b400``."""
    value = int(code.removeprefix("#"), 16)
    return (value >> 16 & 255) / 255, (value >> 8 & 255) / 255, (value & 255) / 255


class Surface(ABC):
    """A colour for every point of a part."""

    @abstractmethod
    def colour(self, points: Tensor) -> Tensor:
        """Colours at points in the part's own coordinates. [N, 3]"""


@dataclass(frozen=True)
class Plain(Surface):
    """One colour, mottled by soft waves of the given strength and wave length."""

    paint: Colour
    mottle: float = 0.0
    wave: float = 0.25

    def colour(self, points: Tensor) -> Tensor:
        paint = points.new_tensor(self.paint).expand_as(points)
        if not self.mottle:
            return paint
        x, y, z = (points * (2 * math.pi / self.wave)).unbind(-1)
        waves = (x + 0.9 * (0.7 * y).sin()).sin() * (y + 0.9 * (0.6 * z).sin()).cos()
        waves = waves + 0.6 * (1.7 * z + 0.8 * x).sin() * (1.3 * y - 0.5 * x).cos()
        return (paint * (1 + self.mottle * waves[:, None])).clamp(0, 1)


@dataclass(frozen=True)
class Stripes(Surface):
    """Bands of equal width across one axis (0, 1, 2), the colours taken in turn."""

    paints: tuple[Colour, ...]
    axis: int
    width: float
    shift: float = 0.0

    def colour(self, points: Tensor) -> Tensor:
        return _pick(self.paints, _cell(points[:, self.axis] + self.shift, self.width))


@dataclass(frozen=True)
class Checker(Surface):
    """Cubes of two or more colours."""

    paints: tuple[Colour, ...]
    cell: tuple[float, float, float]

    def colour(self, points: Tensor) -> Tensor:
        cells = sum(_cell(points[:, axis], size) for axis, size in enumerate(self.cell))
        return _pick(self.paints, torch.as_tensor(cells))


@dataclass(frozen=True)
class Sectors(Surface):
    """Slices of an orange around z, the colours taken in turn."""

    paints: tuple[Colour, ...]
    count: int

    def colour(self, points: Tensor) -> Tensor:
        turn = torch.atan2(points[:, 1], points[:, 0]) / (2 * math.pi) + 0.5
        return _pick(self.paints, (turn * self.count).floor())


@dataclass(frozen=True)
class Bricks(Surface):
    """Rows of bricks with joints between them, every brick in its own tone.

    Attributes:
        paint: Colour of the bricks.
        joint_paint: Colour of the joints.
        length: Length of a brick.
        height: Height of a row, along z.
        joint: Width of the joints.
        around: Radius of a round wall whose bricks run around z; 0 for straight walls.
        tone: How much the tones of the bricks differ.
    """

    paint: Colour
    joint_paint: Colour
    length: float
    height: float
    joint: float
    around: float = 0.0
    tone: float = 0.2

    def colour(self, points: Tensor) -> Tensor:
        x, y, z = (points * _INWARD).unbind(-1)
        if self.around:
            along, length = torch.atan2(y, x) * self.around, self.length
            length = 2 * math.pi * self.around / max(round(2 * math.pi * self.around / length), 1)
        else:
            # On a face of constant x or y the sum runs along the wall.
            along, length = x + y, self.length
        row = (z / self.height).floor()
        along = along / length + 0.5 * row.remainder(2)
        column = along.floor()
        if self.around:
            column = column.remainder(round(2 * math.pi * self.around / length))
        in_joint = ((along - along.floor()) * length < self.joint) | (
            z - row * self.height < self.joint
        )
        noise = ((row * 12.9898 + column * 78.233).sin() * 437.585).frac()
        bricks = points.new_tensor(self.paint) * (1 + self.tone * noise[:, None])
        joints = points.new_tensor(self.joint_paint)
        return torch.where(in_joint[:, None], joints, bricks.clamp(0, 1))


# Patterns are read a little below the surface: a face that lies exactly on the border between
# two cells would otherwise take the colour of either at random.
_INWARD = 0.998


def _cell(values: Tensor, width: float) -> Tensor:
    return (values * (_INWARD / width)).floor()


def _pick(paints: tuple[Colour, ...], cells: Tensor) -> Tensor:
    """The colour of each numbered cell, taken in turn. [N, 3]"""
    return cells.new_tensor(paints)[cells.remainder(len(paints)).long()]
