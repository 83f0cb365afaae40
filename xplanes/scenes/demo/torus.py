"""The torus, hit by rays where a quartic polynomial first changes its sign."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from xplanes.scenes.demo.primitives import MISS, Primitive, cylinder_span

_HALVINGS = 44
"""Halvings of a bracket no wider than the torus, down to the precision of float64."""


@dataclass(frozen=True)
class Torus(Primitive):
    """A ring around z: the circle of radius ``ring`` in the xy plane, made ``tube`` thick."""

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
        # Seen from the foot of the perpendicular the quartic has no cubic term and no digits are
        # lost to the distance of the camera.
        origin, direction = origins[rays].double(), directions[rays].double()
        foot = (origin * direction).sum(dim=-1)
        origin = origin - foot[:, None] * direction
        # From a little before the cylinder around the torus, which touches it.
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
        """Factors (a, b, c) of t^4 + a t^2 + b t + c, negative inside the torus. [N] each"""
        flat, across = foot[:, :2], direction[:, :2]
        bulk = foot.square().sum(dim=-1) + self.ring**2 - self.tube**2
        four = 4 * self.ring**2
        return (
            2 * bulk - four * across.square().sum(dim=-1),
            -2 * four * (flat * across).sum(dim=-1),
            bulk.square() - four * flat.square().sum(dim=-1),
        )


def _first_change(factors: tuple[Tensor, Tensor, Tensor], start: Tensor, stop: Tensor) -> Tensor:
    """First root of t^4 + a t^2 + b t + c from start to stop that it passes through, or inf. [N]"""
    a, b, c = factors

    def value(t: Tensor) -> Tensor:
        return ((t * t + a) * t + b) * t + c

    # Between its extrema the quartic is monotone: at most one change of sign in each piece.
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
    """Rising real roots of t^3 + p t + q, a single one repeated. [3, N]"""
    spare = (q / 2).square() + (p / 3) ** 3
    # One root: Cardano's formula, by the sum that does not cancel.
    cube = -torch.copysign(q.abs() / 2 + spare.clamp_min(0).sqrt(), q)
    large = torch.copysign(cube.abs() ** (1 / 3), cube)
    single = large - torch.where(large == 0, 0.0, p / (3 * large))
    # Three roots: Viete's cosines.
    reach = 2 * (-p / 3).clamp_min(0).sqrt()
    turn = (3 * q / (p * reach)).nan_to_num(0.0).clamp(-1, 1).acos() / 3
    steps = torch.tensor([2.0, 1.0, 0.0], dtype=p.dtype, device=p.device)[:, None]
    three = reach * (turn - steps * (2 * math.pi / 3)).cos()
    return torch.where(spare > 0, single, three)
