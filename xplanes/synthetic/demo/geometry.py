"""Solids and surfaces of procedural scenes, with exact ray intersections."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import reduce
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.nn.functional import normalize

MISS = math.inf


class Primitive(ABC):
    """A closed solid; ``inside`` is strict, the surface itself is outside."""

    quick: ClassVar[bool] = True
    """Whether `hit` needs few operations, so that small chunks of rays are fastest."""

    @property
    @abstractmethod
    def extent(self) -> tuple[float, float, float]:
        """Half sides of the shape's bounding box, in its own axes. [3]"""

    @property
    def radius_around(self) -> float:
        """Radius of the shape's bounding sphere around its centre."""
        return math.hypot(*self.extent)

    @abstractmethod
    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Distance along each ray to the surface, inf for rays that miss.

        Args:
            origins: Ray origins; a ray from inside hits where it leaves. [N, 3]
            directions: Unit directions. [N, 3]

        Returns:
            Distances above 0 to the first crossing of the surface. [N]
        """

    @abstractmethod
    def normal(self, points: Tensor) -> Tensor:
        """Outward unit normals at points on the surface. [N, 3]"""

    @abstractmethod
    def signed_distance(self, points: Tensor) -> Tensor:
        """Distance to the surface, negative inside. [N]"""

    def at(self, time: float) -> Self:
        """The shape at ``time``; a rigid shape returns itself."""
        return self

    def material(self, points: Tensor) -> Tensor:
        """Undeformed positions of points, at which surfaces are evaluated. [N, 3]"""
        return points

    def inside(self, points: Tensor) -> Tensor:
        """Whether points lie inside the shape. bool [N]"""
        return self.signed_distance(points) < 0


@dataclass(frozen=True)
class Box(Primitive):
    """A box with the given half sides."""

    half: tuple[float, float, float]

    @property
    def extent(self) -> tuple[float, float, float]:
        return self.half

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        axes = zip(origins.unbind(dim=-1), directions.unbind(dim=-1), self.half, strict=True)
        near, far = zip(*(_slab(*axis) for axis in axes), strict=True)
        return _first(reduce(torch.maximum, near), reduce(torch.minimum, far))

    def normal(self, points: Tensor) -> Tensor:
        axis = (points.abs() - points.new_tensor(self.half)).argmax(dim=-1, keepdim=True)
        return torch.zeros_like(points).scatter(-1, axis, points.gather(-1, axis).sign())

    def signed_distance(self, points: Tensor) -> Tensor:
        return corner_distance(points.abs() - points.new_tensor(self.half))


@dataclass(frozen=True)
class Ellipsoid(Primitive):
    """An ellipsoid with the given radii."""

    radii: tuple[float, float, float]

    @property
    def extent(self) -> tuple[float, float, float]:
        return self.radii

    @property
    def radius_around(self) -> float:
        return max(self.radii)

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        radii = origins.new_tensor(self.radii)
        stretched = directions / radii
        length = stretched.norm(dim=-1, keepdim=True)
        near, far = _ball(origins / radii, stretched / length, 1.0)
        return _first(near / length[:, 0], far / length[:, 0])

    def normal(self, points: Tensor) -> Tensor:
        return normalize(points / points.new_tensor(self.radii).square(), dim=-1)

    def signed_distance(self, points: Tensor) -> Tensor:
        """First-order estimate of the signed distance; exact in sign and on the surface. [N]"""
        radii = points.new_tensor(self.radii)
        scaled = (points / radii).norm(dim=-1).clamp_min(1e-6)
        slope = (points / radii.square()).norm(dim=-1).clamp_min(1e-6 / min(self.radii))
        return scaled * (scaled - 1) / slope


@dataclass(frozen=True)
class Cylinder(Primitive):
    """A capped cylinder."""

    radius: float
    half_height: float

    @property
    def extent(self) -> tuple[float, float, float]:
        return self.radius, self.radius, self.half_height

    @property
    def radius_around(self) -> float:
        return math.hypot(self.radius, self.half_height)

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        return _first(*cylinder_span(origins, directions, self.radius, self.half_height))

    def normal(self, points: Tensor) -> Tensor:
        side = points[:, :2].norm(dim=-1) - self.radius
        on_cap = (points[:, 2].abs() - self.half_height > side)[:, None]
        flat = points * points.new_tensor([1.0, 1.0, 0.0])
        cap = points.sign() * points.new_tensor([0.0, 0.0, 1.0])
        return torch.where(on_cap, cap, normalize(flat, dim=-1))

    def signed_distance(self, points: Tensor) -> Tensor:
        side = points[:, :2].norm(dim=-1) - self.radius
        return corner_distance(torch.stack([side, points[:, 2].abs() - self.half_height], dim=-1))


@dataclass(frozen=True)
class Capsule(Primitive):
    """A cylinder of the given half height with hemispheres at both ends."""

    radius: float
    half_height: float

    @property
    def extent(self) -> tuple[float, float, float]:
        return self.radius, self.radius, self.half_height + self.radius

    @property
    def radius_around(self) -> float:
        return self.half_height + self.radius

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        near, far = cylinder_span(origins, directions, self.radius, self.half_height)
        for end in (-self.half_height, self.half_height):
            centre = origins.new_tensor([0.0, 0.0, end])
            enter, leave = _ball(origins - centre, directions, self.radius)
            near, far = torch.minimum(near, enter), torch.maximum(far, leave)
        return _first(near, far)

    def normal(self, points: Tensor) -> Tensor:
        return normalize(self._from_axis(points), dim=-1)

    def signed_distance(self, points: Tensor) -> Tensor:
        return self._from_axis(points).norm(dim=-1) - self.radius

    def _from_axis(self, points: Tensor) -> Tensor:
        along = points[:, 2].clamp(-self.half_height, self.half_height)
        return torch.cat([points[:, :2], (points[:, 2] - along)[:, None]], dim=-1)


def _first(near: Tensor, far: Tensor) -> Tensor:
    """First crossing in front of a ray that is inside a convex shape from near to far. [N]"""
    ahead = torch.where(near > 0, near, far)
    return torch.where((near <= far) & (ahead > 0), ahead, MISS)


def _slab(origins: Tensor, directions: Tensor, half: float) -> tuple[Tensor, Tensor]:
    """Near and far of rays in the slab from -half to half of one axis. [N], [N]"""
    tiny = directions.abs() < 1e-12
    inverse = 1 / directions.masked_fill(tiny, 1e-12)
    middle, reach = -origins * inverse, half * inverse.abs()
    return middle - reach, middle + reach


def _ball(origins: Tensor, directions: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Near and far of rays in a sphere; inf and -inf for a miss. [N], [N]"""
    along = (origins * directions).sum(dim=-1)
    # Measured from the foot of the perpendicular: |o|^2 - r^2 would lose precision far away.
    foot = origins - along[:, None] * directions
    spare = radius * radius - foot.square().sum(dim=-1)
    reach = spare.clamp_min(0).sqrt()
    hit = spare >= 0
    return torch.where(hit, -along - reach, MISS), torch.where(hit, -along + reach, -MISS)


def cylinder_span(
    origins: Tensor, directions: Tensor, radius: float, half_height: float
) -> tuple[Tensor, Tensor]:
    """Near and far of rays in a capped cylinder; inf and -inf for a miss. [N], [N]"""
    flat, flat_origins = directions[:, :2], origins[:, :2]
    square = flat.square().sum(dim=-1)
    upright = square < 1e-12
    square = square.masked_fill(upright, 1.0)
    along = ((flat_origins * flat).sum(dim=-1) / square).masked_fill(upright, 0.0)
    foot = flat_origins - along[:, None] * flat
    spare = radius * radius - foot.square().sum(dim=-1)
    reach = (spare.clamp_min(0) / square).sqrt().masked_fill(upright, MISS)
    near, far = _slab(origins[:, 2], directions[:, 2], half_height)
    near, far = torch.maximum(near, -along - reach), torch.minimum(far, -along + reach)
    hit = (spare >= 0) & (near <= far)
    return torch.where(hit, near, MISS), torch.where(hit, far, -MISS)


def corner_distance(out: Tensor) -> Tensor:
    """Signed distance from the signed excess along orthogonal directions. [N]"""
    return out.clamp_min(0).norm(dim=-1) + out.amax(dim=-1).clamp_max(0)


Colour = tuple[float, float, float]


def rgb(code: str) -> Colour:
    """The colour of an HTML code such as ``#f0b400``."""
    value = int(code.removeprefix("#"), 16)
    return (value >> 16 & 255) / 255, (value >> 8 & 255) / 255, (value & 255) / 255


class Surface(ABC):
    """A colour for every point of a part."""

    lit: ClassVar[bool] = True
    """Whether the light shades it."""

    def at(self, time: float) -> Self:
        """The surface at ``time``; a constant surface returns itself."""
        return self

    @abstractmethod
    def colour(self, points: Tensor) -> Tensor:
        """Colours at points in the part's own coordinates. [N, 3]"""


@dataclass(frozen=True)
class Plain(Surface):
    """One colour, modulated by smooth waves of the given strength and wave length."""

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
    """Bands of equal width along one axis (0, 1, 2), with alternating colours."""

    paints: tuple[Colour, ...]
    axis: int
    width: float
    shift: float = 0.0

    def colour(self, points: Tensor) -> Tensor:
        return _pick(self.paints, _cell(points[:, self.axis] + self.shift, self.width))


@dataclass(frozen=True)
class Checker(Surface):
    """A checkerboard of cubes, with alternating colours."""

    paints: tuple[Colour, ...]
    cell: tuple[float, float, float]

    def colour(self, points: Tensor) -> Tensor:
        cells = sum(_cell(points[:, axis], size) for axis, size in enumerate(self.cell))
        return _pick(self.paints, torch.as_tensor(cells))


@dataclass(frozen=True)
class Sectors(Surface):
    """Sectors around the z axis, with alternating colours."""

    paints: tuple[Colour, ...]
    count: int

    def colour(self, points: Tensor) -> Tensor:
        turn = torch.atan2(points[:, 1], points[:, 0]) / (2 * math.pi) + 0.5
        return _pick(self.paints, (turn * self.count).floor())


@dataclass(frozen=True)
class Bricks(Surface):
    """Rows of bricks with joints between them and a random tone for each brick.

    Attributes:
        paint: Colour of the bricks.
        joint_paint: Colour of the joints.
        length: Length of a brick.
        height: Height of a row, along z.
        joint: Width of the joints.
        around: Radius of a round wall around z; 0 for straight walls.
        tone: Amplitude of the variation between bricks.
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
            # On a face of constant x or y, the sum varies along the wall.
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


@dataclass(frozen=True)
class Derived(Surface):
    """A surface with the colours of another one."""

    base: Surface

    def at(self, time: float) -> Self:
        return replace(self, base=self.base.at(time))

    def colour(self, points: Tensor) -> Tensor:
        return self.base.colour(points)


@dataclass(frozen=True)
class Unlit(Derived):
    """A surface without shading."""

    lit: ClassVar[bool] = False


@dataclass(frozen=True)
class Translucent(Derived):
    """A thin semi-transparent shell around a homogeneous absorbing medium.

    Attributes:
        base: Colours of shell and medium.
        shell: Opacity of the shell at normal incidence.
        density: Density of the medium, per unit length.
    """

    shell: float = 0.0
    density: float = 0.0

    def opacity(self, cosine: Tensor) -> Tensor:
        """Opacity of the shell, given cosines of the angle to the normal. [N]"""
        return 1 - (1 - self.shell) ** (1 / cosine.abs().clamp_min(0.12))


# Patterns are evaluated slightly below the surface: rounding would otherwise choose the colour of a
# face that lies exactly on the border between two cells.
_INWARD = 0.998


def _cell(values: Tensor, width: float) -> Tensor:
    return (values * (_INWARD / width)).floor()


def _pick(paints: tuple[Colour, ...], cells: Tensor) -> Tensor:
    """Colour of each cell by its index, modulo the number of colours. [N, 3]"""
    return cells.new_tensor(paints)[cells.remainder(len(paints)).long()]


_HALVINGS = 44
"""Bisection steps from a bracket no wider than the torus to the precision of float64."""


@dataclass(frozen=True)
class Torus(Primitive):
    """A torus around z: a circle of radius ``ring`` in the xy plane, with tube radius ``tube``."""

    ring: float
    tube: float

    @property
    def extent(self) -> tuple[float, float, float]:
        return self.ring + self.tube, self.ring + self.tube, self.tube

    @property
    def radius_around(self) -> float:
        return self.ring + self.tube

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        start, stop = cylinder_span(origins, directions, self.radius_around, self.tube)
        distance = torch.full_like(start, MISS)
        rays = ((start <= stop) & (stop > 0)).nonzero()[:, 0]
        # With the origin at the foot of the perpendicular, the quartic has no cubic term, and the
        # camera distance costs no precision.
        origin, direction = origins[rays].double(), directions[rays].double()
        foot = (origin * direction).sum(dim=-1)
        origin = origin - foot[:, None] * direction
        # Begin slightly before the enclosing cylinder, because it touches the torus.
        start = (start[rays].double() - 1e-6).clamp_min(0) + foot
        stop = stop[rays].double() + 1e-6 + foot
        root = _first_change(self._quartic(origin, direction), start, stop) - foot
        distance[rays] = root.to(distance)
        return distance

    def normal(self, points: Tensor) -> Tensor:
        flat = points * points.new_tensor([1.0, 1.0, 0.0])
        return normalize(points - self.ring * normalize(flat, dim=-1), dim=-1)

    def signed_distance(self, points: Tensor) -> Tensor:
        return torch.hypot(points[:, :2].norm(dim=-1) - self.ring, points[:, 2]) - self.tube

    def _quartic(self, foot: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coefficients (a, b, c) of t^4 + a t^2 + b t + c, negative inside the torus. [N] each"""
        flat, across = foot[:, :2], direction[:, :2]
        bulk = foot.square().sum(dim=-1) + self.ring**2 - self.tube**2
        four = 4 * self.ring**2
        return (
            2 * bulk - four * across.square().sum(dim=-1),
            -2 * four * (flat * across).sum(dim=-1),
            bulk.square() - four * flat.square().sum(dim=-1),
        )


def _first_change(factors: tuple[Tensor, Tensor, Tensor], start: Tensor, stop: Tensor) -> Tensor:
    """First root with a sign change of t^4 + a t^2 + b t + c in [start, stop], or inf. [N]"""
    a, b, c = factors

    def value(t: Tensor) -> Tensor:
        return ((t * t + a) * t + b) * t + c

    # The quartic is monotone between its extrema: at most one sign change in each interval.
    extrema = torch.minimum(torch.maximum(_cubic_roots(a / 2, b / 4), start), stop)
    ends = torch.cat([start[None], extrema, stop[None]])
    outside = value(ends) >= 0
    first = outside[0]
    changed = outside[1:] != first
    piece = changed.to(torch.uint8).argmax(dim=0, keepdim=True)
    low, high = ends.gather(0, piece)[0], ends.gather(0, piece + 1)[0]
    found = changed.any(dim=0).nonzero()[:, 0]
    a, b, c, first, low, high = (part[found] for part in (a, b, c, first, low, high))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        before = (value(middle) >= 0) == first
        low, high = torch.where(before, middle, low), torch.where(before, high, middle)
    return torch.full_like(start, MISS).index_copy(0, found, 0.5 * (low + high))


def _cubic_roots(p: Tensor, q: Tensor) -> Tensor:
    """Real roots of t^3 + p t + q in ascending order; a single root is repeated. [3, N]"""
    spare = (q / 2).square() + (p / 3) ** 3
    # One root: Cardano's formula, in the form without cancellation.
    cube = -torch.copysign(q.abs() / 2 + spare.clamp_min(0).sqrt(), q)
    large = torch.copysign(cube.abs() ** (1 / 3), cube)
    single = large - torch.where(large == 0, 0.0, p / (3 * large))
    # Three roots: Viete's cosines.
    reach = 2 * (-p / 3).clamp_min(0).sqrt()
    turn = (3 * q / (p * reach)).nan_to_num(0.0).clamp(-1, 1).acos() / 3
    steps = torch.tensor([2.0, 1.0, 0.0], dtype=p.dtype, device=p.device)[:, None]
    three = reach * (turn - steps * (2 * math.pi / 3)).cos()
    return torch.where(spare > 0, single, three)
