"""Deformable solids as implicit functions, intersected by sphere tracing."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.nn.functional import normalize

from xplanes.synthetic.demo.geometry import (
    MISS,
    Box,
    Colour,
    Primitive,
    Surface,
    corner_distance,
)
from xplanes.synthetic.demo.motions import Motion

STEPS = 48
"""Steps of sphere tracing; grazing rays need more."""

SAMPLES = 256
"""Even samples along the rest of a grazing ray."""

HALVINGS = 10
"""Bisections between two of these samples."""

NEAR = 5e-5
"""Distance bound below which a ray hits."""


@dataclass(frozen=True)
class Implicit(Primitive):
    """A solid in which a function of position and time is negative.

    Attributes:
        time: Timestep of the shape, in [0, 1].
    """

    quick: ClassVar[bool] = False

    time: float = 0.0

    def at(self, time: float) -> Self:
        return replace(self, time=time)

    @abstractmethod
    def value(self, points: Tensor) -> Tensor:
        """Negative inside; outside, positive and at most the distance to the surface. [N]"""

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        half = self.extent
        entry = Box(half).hit(origins, directions)
        inside = (origins.abs() <= origins.new_tensor(half)).all(dim=-1)
        travelled = torch.where(inside, 0.0, entry)
        leaves = torch.full_like(travelled, MISS)
        rays = travelled.isfinite().nonzero()[:, 0]
        starts = origins[rays] + travelled[rays, None] * directions[rays]
        # From slightly inside, the next hit of the box is its exit.
        step = 1e-4 * directions[rays]
        leaves[rays] = travelled[rays] + Box(half).hit(starts + step, directions[rays]) + 1e-4
        distance = torch.full_like(travelled, MISS)
        origins, directions = origins[rays], directions[rays]
        travelled, leaves = travelled[rays], leaves[rays]
        # A ray that starts inside hits where it leaves.
        sign = self.value(starts).sign()
        active = travelled < leaves
        for _ in range(STEPS):
            remaining = int(active.sum())
            if remaining == 0:
                break
            # Compaction costs more than a few steps of finished rays.
            if remaining < 0.7 * len(rays):
                rays, origins, directions, travelled, leaves, sign = (
                    kept[active] for kept in (rays, origins, directions, travelled, leaves, sign)
                )
                active = torch.ones_like(rays, dtype=torch.bool)
            gap = self.value(origins + travelled[:, None] * directions) * sign
            arrived = (active & (gap < NEAR)).nonzero()[:, 0]
            distance[rays[arrived]] = travelled[arrived]
            travelled = travelled + gap.clamp_min(NEAR)
            active &= (gap >= NEAR) & (travelled < leaves)
        if active.any():
            rays, origins, directions, travelled, leaves, sign = (
                kept[active] for kept in (rays, origins, directions, travelled, leaves, sign)
            )
            leaves = torch.minimum(leaves, travelled + 2 * self.radius_around)
            distance[rays] = self._search(origins, directions, travelled, leaves, sign)
        return torch.where(distance > 0, distance, MISS)

    def _search(
        self, origins: Tensor, directions: Tensor, start: Tensor, stop: Tensor, sign: Tensor
    ) -> Tensor:
        """First change of sign between two distances, inf where there is none. [N]"""

        def passed(distance: Tensor) -> Tensor:
            return self.value(origins + distance[:, None] * directions) * sign < 0

        shares = torch.linspace(0, 1, SAMPLES, dtype=start.dtype, device=start.device)
        grid = start[:, None] + shares * (stop - start)[:, None]
        points = origins[:, None] + grid[..., None] * directions[:, None]
        beyond = self.value(points.flatten(0, 1)).reshape(grid.shape) * sign[:, None] < 0
        last = beyond.to(torch.uint8).argmax(dim=1, keepdim=True)
        high, low = grid.gather(1, last)[:, 0], grid.gather(1, (last - 1).clamp_min(0))[:, 0]
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            after = passed(middle)
            low, high = torch.where(after, low, middle), torch.where(after, middle, high)
        return torch.where(beyond.any(dim=1), low, MISS)

    def normal(self, points: Tensor) -> Tensor:
        gradient = torch.zeros_like(points)
        for corner in ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1)):
            way = points.new_tensor(corner)
            gradient += way * self.value(points + 5e-4 * way)[:, None]
        return normalize(gradient, dim=-1)

    def signed_distance(self, points: Tensor) -> Tensor:
        """A lower bound of the distance; the sign is exact. [N]"""
        return self.value(points)


@dataclass(frozen=True)
class Drop:
    """A ball with a moving centre and a changing radius.

    Attributes:
        centre: Centre at rest.
        radius: Radius at rest.
        x: Offset along x over time; None for none. Likewise y and z.
        y: Offset along y.
        z: Offset along z.
        size: Factor of the radius over time.
    """

    centre: tuple[float, float, float]
    radius: float
    x: Motion | None = None
    y: Motion | None = None
    z: Motion | None = None
    size: Motion | None = None

    def at(self, time: float) -> tuple[float, float, float, float]:
        """Centre and radius at ``time``."""
        ways = (0.0 if way is None else way.at(time) for way in (self.x, self.y, self.z))
        x, y, z = (place + way for place, way in zip(self.centre, ways, strict=True))
        return x, y, z, self.radius * (1.0 if self.size is None else self.size.at(time))


@dataclass(frozen=True, kw_only=True)
class Fluid(Implicit):
    """Metaballs: a smooth union of balls, which merge and separate.

    Attributes:
        drops: The balls.
        blend: Width of the smooth transition.
        half: Half sides of a box that contains the balls at all times.
    """

    drops: tuple[Drop, ...]
    blend: float
    half: tuple[float, float, float]

    @property
    def extent(self) -> tuple[float, float, float]:
        return self.half

    def value(self, points: Tensor) -> Tensor:
        return -self.blend * (-self._gaps(points) / self.blend).logsumexp(dim=-1)

    def shares(self, points: Tensor) -> Tensor:
        """Weight of each ball at points. [N, drops]"""
        return (-self._gaps(points) / self.blend).softmax(dim=-1)

    def _gaps(self, points: Tensor) -> Tensor:
        balls = points.new_tensor([drop.at(self.time) for drop in self.drops])
        # Expanded squares need no [N, drops, 3] tensor of differences.
        squares = (
            points.square().sum(dim=-1, keepdim=True)
            - 2 * points @ balls[:, :3].T
            + balls[:, :3].square().sum(dim=-1)
        )
        return squares.clamp_min(1e-12).sqrt() - balls[:, 3]


@dataclass(frozen=True)
class Blend(Surface):
    """The colours of metaballs, mixed by their weights."""

    fluid: Fluid
    paints: tuple[Colour, ...]

    def at(self, time: float) -> "Blend":
        return replace(self, fluid=self.fluid.at(time))

    def colour(self, points: Tensor) -> Tensor:
        return self.fluid.shares(points) @ points.new_tensor(self.paints)


@dataclass(frozen=True, kw_only=True)
class Twisted(Implicit):
    """A column of rounded rectangular section, twisted about z.

    Attributes:
        half: Half sides before the twist.
        rounding: Radius of the edges.
        twist: Degrees from the middle to the top, over time.
    """

    half: tuple[float, float, float]
    rounding: float
    twist: Motion

    @property
    def extent(self) -> tuple[float, float, float]:
        reach = math.hypot(*self.half[:2])
        return reach, reach, self.half[2]

    def material(self, points: Tensor) -> Tensor:
        angle = self._rate() * points[:, 2].clamp(-self.half[2], self.half[2])
        cosine, sine = angle.cos(), angle.sin()
        x, y, z = points.unbind(dim=-1)
        return torch.stack([cosine * x + sine * y, cosine * y - sine * x, z], dim=-1)

    def value(self, points: Tensor) -> Tensor:
        gap = _rounded_box(self.material(points), self.half, self.rounding)
        # The corners of the bounding box have the largest distance to the axis.
        return gap / _shear(abs(self._rate()) * math.sqrt(2) * math.hypot(*self.half[:2]))

    def _rate(self) -> float:
        return math.radians(self.twist.at(self.time)) / self.half[2]


@dataclass(frozen=True, kw_only=True)
class Bent(Implicit):
    """A round stalk from the origin along z, bent to a circular arc in the xz plane.

    Attributes:
        length: Length of its axis, which bending preserves.
        radius: Radius at the origin.
        tip: Radius at the other end.
        bend: Degrees by which the other end is turned towards x, over time; less than 360.
    """

    length: float
    radius: float
    tip: float
    bend: Motion

    @property
    def extent(self) -> tuple[float, float, float]:
        thick, angle = max(self.radius, self.tip), self._angle()
        centre = self.length / abs(angle)
        aside = centre * (1 - math.cos(min(abs(angle), math.pi)))
        return aside + thick, thick, centre * math.sin(min(abs(angle), 0.5 * math.pi)) + thick

    def material(self, points: Tensor) -> Tensor:
        return self._straight(points)[0]

    def value(self, points: Tensor) -> Tensor:
        straight, along = self._straight(points)
        radius = self.radius + (self.tip - self.radius) * along / self.length
        away = torch.stack([straight[:, 0], straight[:, 1], straight[:, 2] - along], dim=-1)
        gap = away.norm(dim=-1) - radius
        # The other end may be nearer if it is thicker.
        angle = self._angle()
        reach = self.length / angle
        top = points.new_tensor([reach * (1 - math.cos(angle)), 0.0, reach * math.sin(angle)])
        gap = torch.minimum(gap, points.norm(dim=-1) - self.radius)
        gap = torch.minimum(gap, (points - top).norm(dim=-1) - self.tip)
        # Arc length changes faster near the centre of the circle.
        centre, thick = abs(reach), max(self.radius, self.tip)
        nearest = torch.hypot(points[:, 0] - reach, points[:, 2]).clamp_max(centre - thick)
        taper = (self.tip - self.radius) / self.length * centre / nearest.clamp_min(0.05 * centre)
        return gap / torch.hypot(torch.ones_like(taper), taper)

    def _angle(self) -> float:
        # float32 cannot represent the circle of an almost straight stalk.
        angle = math.radians(self.bend.at(self.time))
        return math.copysign(max(abs(angle), 0.01), angle)

    def _straight(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Undeformed points, and arc length of the nearest point on the axis. [N, 3], [N]"""
        angle = self._angle()
        centre, sign = self.length / angle, math.copysign(1.0, angle)
        x, y, z = points.unbind(dim=-1)
        turn = sign * torch.atan2(sign * z, sign * (centre - x))
        # The angle wraps where both ends are equally far.
        jump = 0.5 * abs(angle) - math.pi
        turn = sign * torch.where(turn < jump, turn + 2 * math.pi, turn)
        along = (turn * centre).clamp(0, self.length)
        bent = along / centre
        axis = torch.stack([2 * centre * (0.5 * bent).sin().square(), centre * bent.sin()], dim=-1)
        away = torch.stack([x, z], dim=-1) - axis
        outward = away[:, 0] * bent.cos() - away[:, 1] * bent.sin()
        forward = away[:, 0] * bent.sin() + away[:, 1] * bent.cos()
        return torch.stack([outward, y, along + forward], dim=-1), along


@dataclass(frozen=True, kw_only=True)
class Waving(Implicit):
    """A sheet in the xz plane with waves that travel along x; fixed at its left edge.

    Attributes:
        half: Half sides: length, thickness, height.
        reach: Amplitude along y at the free edge.
        waves: Number of waves over its length.
        phase: Phase of the wave in cycles, over time.
    """

    half: tuple[float, float, float]
    reach: float
    waves: float
    phase: Motion

    @property
    def extent(self) -> tuple[float, float, float]:
        return self.half[0], self.half[1] + self.reach, self.half[2]

    def material(self, points: Tensor) -> Tensor:
        x, y, z = points.unbind(dim=-1)
        share = ((x + self.half[0]) / (2 * self.half[0])).clamp(0, 1)
        angle = 2 * math.pi * (self.waves * share - self.phase.at(self.time))
        return torch.stack([x, y - self.reach * share * angle.sin(), z], dim=-1)

    def value(self, points: Tensor) -> Tensor:
        gap = _rounded_box(self.material(points), self.half, 0.8 * self.half[1])
        return gap / _shear(self.reach * (2 * math.pi * self.waves + 1) / (2 * self.half[0]))


@dataclass(frozen=True, kw_only=True)
class Lobed(Implicit):
    """A ball with lobes around z whose height changes; stretching preserves the volume.

    Attributes:
        radius: Radius of the ball.
        lobes: Number of lobes around z.
        swell: Height of the lobes over time, in radii.
        most: Maximum absolute value of ``swell``.
        stretch: Factor of the extent along z over time.
        tallest: Minimum and maximum of ``stretch``.
    """

    radius: float
    lobes: int
    swell: Motion
    most: float
    stretch: Motion
    tallest: tuple[float, float] = (1.0, 1.0)

    @property
    def extent(self) -> tuple[float, float, float]:
        largest = self.radius * (1 + self.most)
        girth = largest / math.sqrt(self.tallest[0])
        return girth, girth, largest * self.tallest[1]

    def material(self, points: Tensor) -> Tensor:
        height = self.stretch.at(self.time)
        factors = points.new_tensor([math.sqrt(height), math.sqrt(height), 1 / height])
        return points * factors

    def value(self, points: Tensor) -> Tensor:
        height = self.stretch.at(self.time)
        x, y, z = self.material(points).unbind(dim=-1)
        flat = torch.hypot(x, y).clamp_min(1e-6)
        length = torch.hypot(flat, z)
        sine = flat / length.clamp_min(1e-6)
        lobes = sine.square() * (self.lobes * torch.atan2(y, x)).cos()
        swell = self.swell.at(self.time)
        gap = length - self.radius * (1 + swell * lobes)
        # The bound may fail near the centre, which lies deep inside.
        slope = math.hypot(1.0, abs(swell) * (self.lobes + 2) / (1 - abs(swell)))
        return gap / (slope * max(math.sqrt(height), 1 / height))


def _rounded_box(points: Tensor, half: Sequence[float], rounding: float) -> Tensor:
    """Signed distance to a box with rounded edges. [N]"""
    inner = points.new_tensor([side - rounding for side in half])
    return corner_distance(points.abs() - inner) - rounding


def _shear(slope: float) -> float:
    """Largest singular value of a shear."""
    return 0.5 * slope + math.hypot(1.0, 0.5 * slope)
