"""Solid shapes that rays can hit: box, ellipsoid, cylinder and capsule (the torus is in torus.py).

Every shape is centred on the origin of its own coordinates; round shapes have their axis along z.
Distances are exact, so a picture of a scene is ground truth for what lies where.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

MISS = math.inf


class Primitive(ABC):
    """A closed solid; ``inside`` is strict, the surface itself is outside."""

    @property
    @abstractmethod
    def extent(self) -> tuple[float, float, float]:
        """Half sides of the tightest box around the shape, along its own axes."""

    @property
    @abstractmethod
    def radius_around(self) -> float:
        """Radius of the smallest ball around the shape's centre that holds it."""

    @abstractmethod
    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Distance along each ray to the surface, inf where the ray misses.

        Args:
            origins: Where the rays start; from inside, the ray hits where it leaves. [N, 3]
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

    def inside(self, points: Tensor) -> Tensor:
        """Whether points lie inside. bool [N]"""
        return self.signed_distance(points) < 0

    def intersect(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """First hit of each ray: distance (inf where missed) and normal (0 where missed).

        Args:
            origins: Where the rays start. [N, 3]
            directions: Unit directions. [N, 3]

        Returns:
            Distances and outward unit normals. [N], [N, 3]
        """
        distance = self.hit(origins, directions)
        found = distance.isfinite()
        normal = torch.zeros_like(directions)
        points = origins[found] + distance[found, None] * directions[found]
        normal[found] = self.normal(points)
        return distance, normal


@dataclass(frozen=True)
class Box(Primitive):
    """A box with the given half sides."""

    half: tuple[float, float, float]

    @property
    def extent(self) -> tuple[float, float, float]:
        return self.half

    @property
    def radius_around(self) -> float:
        return math.hypot(*self.half)

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        near, far = zip(
            *(
                _slab(origins[:, axis], directions[:, axis], half)
                for axis, half in enumerate(self.half)
            ),
            strict=True,
        )
        return _first(
            torch.maximum(torch.maximum(near[0], near[1]), near[2]),
            torch.minimum(torch.minimum(far[0], far[1]), far[2]),
        )

    def normal(self, points: Tensor) -> Tensor:
        axis = (points.abs() - points.new_tensor(self.half)).argmax(dim=-1, keepdim=True)
        return torch.zeros_like(points).scatter(-1, axis, points.gather(-1, axis).sign())

    def signed_distance(self, points: Tensor) -> Tensor:
        return _corner_distance(points.abs() - points.new_tensor(self.half))


@dataclass(frozen=True)
class Ellipsoid(Primitive):
    """An ellipsoid with the given radii; equal radii make a ball."""

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
        """Sign and zero are exact, elsewhere a first-order estimate of the distance. [N]"""
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
        return _corner_distance(torch.stack([side, points[:, 2].abs() - self.half_height], dim=-1))


@dataclass(frozen=True)
class Capsule(Primitive):
    """A cylinder of the given half height with half balls on both ends."""

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
    """The first crossing ahead of a ray that is inside a convex shape from near to far. [N]"""
    ahead = torch.where(near > 0, near, far)
    return torch.where((near <= far) & (ahead > 0), ahead, MISS)


def _slab(origins: Tensor, directions: Tensor, half: float) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave the layer between -half and half of one axis. [N], [N]"""
    tiny = directions.abs() < 1e-12
    inverse = 1 / directions.masked_fill(tiny, 1e-12)
    middle, reach = -origins * inverse, half * inverse.abs()
    return middle - reach, middle + reach


def _ball(origins: Tensor, directions: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a ball; inf and -inf where they miss it. [N], [N]"""
    along = (origins * directions).sum(dim=-1)
    # The foot of the perpendicular keeps the digits that |o|^2 - r^2 would lose far away.
    foot = origins - along[:, None] * directions
    spare = radius * radius - foot.square().sum(dim=-1)
    reach = spare.clamp_min(0).sqrt()
    hit = spare >= 0
    return torch.where(hit, -along - reach, MISS), torch.where(hit, -along + reach, -MISS)


def cylinder_span(
    origins: Tensor, directions: Tensor, radius: float, half_height: float
) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a capped cylinder; inf and -inf where they miss it. [N], [N]"""
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


def _corner_distance(out: Tensor) -> Tensor:
    """Signed distance from how far a point sticks out along orthogonal directions. [N]"""
    return out.clamp_min(0).norm(dim=-1) + out.amax(dim=-1).clamp_max(0)
