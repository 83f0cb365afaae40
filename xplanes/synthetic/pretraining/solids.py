"""Lit solids as arrays for the compiled loops, and their conversion to the demo's classes."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from xplanes.synthetic.demo.geometry import (
    Box,
    Bricks,
    Capsule,
    Checker,
    Cylinder,
    Ellipsoid,
    Plain,
    Primitive,
    Sectors,
    Stripes,
    Surface,
    Torus,
)
from xplanes.synthetic.demo.posed import Posed, PosedPart
from xplanes.synthetic.demo.shading import Light

BOX, ELLIPSOID, CYLINDER, CAPSULE, TORUS = range(5)
"""Kinds of solids. Their sizes are the arguments of the demo class of the same name."""

PLAIN, STRIPES, CHECKER, BRICKS, SECTORS = range(5)
"""Kinds of patterns.

Their parameters, in this order: mottle and wave length; axis, width and number of colours; three
cell sizes and number of colours; length, height and joint; count and number of colours.
"""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solids:
    """Solids with positions, patterns and light.

    Attributes:
        kinds: BOX, ELLIPSOID, CYLINDER, CAPSULE or TORUS. int64 [P]
        sizes: Half sides, radii, or radius and half height. [P, 3]
        rotations: From each part's coordinates to the world's. [P, 3, 3]
        centres: Each part's centre in the world. [P, 3]
        patterns: PLAIN, STRIPES, CHECKER, BRICKS or SECTORS. int64 [P]
        paints: Three colours of each pattern, in [0, 1]. [P, 3, 3]
        numbers: Parameters of each pattern. [P, 4]
        light: Direction to the sun, strength of sun, sky and ambient light, and shadow. [7]
    """

    kinds: NDArray[np.int64]
    sizes: Array
    rotations: Array
    centres: Array
    patterns: NDArray[np.int64]
    paints: Array
    numbers: Array
    light: Array

    @property
    def arrays(self) -> tuple[NDArray, ...]:
        """Arguments of the compiled loops."""
        return (
            self.kinds, self.sizes, self.rotations, self.centres, self.reach,
            self.patterns, self.paints, self.numbers, self.light,
        )  # fmt: skip

    @property
    def extents(self) -> Array:
        """Half sides of each part's bounding box in its own axes. [P, 3]"""
        size, extent = self.sizes, self.sizes.copy()
        for kind, columns in (
            (CYLINDER, (size[:, 0], size[:, 0], size[:, 1])),
            (CAPSULE, (size[:, 0], size[:, 0], size[:, 0] + size[:, 1])),
            (TORUS, (size[:, 0] + size[:, 1], size[:, 0] + size[:, 1], size[:, 1])),
        ):
            chosen = self.kinds == kind
            extent[chosen] = np.stack(columns, axis=-1)[chosen]
        return extent

    @property
    def reach(self) -> Array:
        """Radius of each part's bounding sphere around its centre. [P]"""
        return np.linalg.norm(self.extents, axis=-1)

    def bounds(self) -> tuple[Array, Array]:
        """Corners of the axis-aligned bounding box of all parts. [3], [3]"""
        reach = np.einsum("pij,pj->pi", np.abs(self.rotations), self.extents)
        return (self.centres - reach).min(axis=0), (self.centres + reach).max(axis=0)

    def moved(self, scale: float, shift: Array) -> "Solids":
        """All solids and patterns scaled about the origin, then translated."""
        numbers = self.numbers.copy()
        for kind in (PLAIN, STRIPES):
            numbers[self.patterns == kind, 1] *= scale
        for kind in (CHECKER, BRICKS):
            numbers[self.patterns == kind, :3] *= scale
        sizes, centres = self.sizes * scale, self.centres * scale + shift
        return replace(self, sizes=sizes, centres=centres, numbers=numbers)

    def posed(self) -> Posed:
        """The same solids as the demo's classes, in double precision: the reference."""
        towards, (sun, sky, ambient, shadow) = tuple(self.light[:3]), self.light[3:]
        light = Light(towards, float(sun), float(sky), float(ambient), float(shadow))
        parts = [
            PosedPart(
                _primitive(int(self.kinds[i]), self.sizes[i].tolist()),
                _surface(int(self.patterns[i]), self.paints[i].tolist(), self.numbers[i].tolist()),
                torch.from_numpy(self.rotations[i]),
                torch.from_numpy(self.centres[i]),
            )
            for i in range(len(self.kinds))
        ]
        return Posed(tuple(parts), light)


def _primitive(kind: int, size: list[float]) -> Primitive:
    if kind in (BOX, ELLIPSOID):
        return (Box if kind == BOX else Ellipsoid)((size[0], size[1], size[2]))
    return {CYLINDER: Cylinder, CAPSULE: Capsule, TORUS: Torus}[kind](size[0], size[1])


def _surface(kind: int, colours: list[list[float]], numbers: list[float]) -> Surface:
    paints = tuple((r, g, b) for r, g, b in colours)
    if kind == PLAIN:
        return Plain(paints[0], numbers[0], numbers[1])
    if kind == STRIPES:
        return Stripes(paints[: int(numbers[2])], int(numbers[0]), numbers[1])
    if kind == CHECKER:
        return Checker(paints[: int(numbers[3])], (numbers[0], numbers[1], numbers[2]))
    if kind == BRICKS:
        return Bricks(paints[0], paints[1], numbers[0], numbers[1], numbers[2])
    return Sectors(paints[: int(numbers[1])], int(numbers[0]))
