"""Smoothness of planes, as gradients written straight into ``.grad``.

The loss of a step is a handful of rays, that of the planes' smoothness is every texel: through
autograd it would cost more than all else. Its gradient is a stencil, so it is added directly, every
few steps with as many times the weight.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from xplanes.fields.products import PlaneProducts

Variation = Literal["coded", "corrected"]

ROWS, COLUMNS = 2, 3
"""Axes of a plane [1, C, rows, columns]; time is along the rows."""


def total_variation(plane: Tensor, dims: tuple[int, ...]) -> Tensor:
    """Sum over ``dims`` of the mean squared difference between neighbours. [P, H, W, C] -> []"""
    terms = [plane.diff(dim=dim).square().mean() for dim in dims if plane.shape[dim] > 1]
    return torch.stack(terms).sum() if terms else plane.new_zeros(())


def time_smoothness(planes: Tensor) -> Tensor:
    """Mean squared second difference along the rows of time. [P, T, H, C] -> []"""
    return planes.diff(n=2, dim=1).square().mean() if planes.shape[1] > 2 else planes.new_zeros(())


@torch.no_grad()
def add_total_variation_gradient(
    gradient: Tensor, plane: Tensor, dims: tuple[int, ...], weight: float
) -> None:
    """Add ``weight`` times the gradient of `total_variation` to ``gradient``."""
    for dim in dims:
        length = plane.shape[dim] - 1
        if length < 1:
            continue
        difference = plane.diff(dim=dim)
        scale = 2 * weight / difference.numel()
        gradient.narrow(dim, 1, length).add_(difference, alpha=scale)
        gradient.narrow(dim, 0, length).sub_(difference, alpha=scale)


@torch.no_grad()
def add_time_smoothness_gradient(gradient: Tensor, planes: Tensor, weight: float) -> None:
    """Add ``weight`` times the gradient of `time_smoothness` to ``gradient``."""
    length = planes.shape[1] - 2
    if length < 1:
        return
    bend = planes.diff(n=2, dim=1)
    scale = 2 * weight / bend.numel()
    gradient.narrow(1, 0, length).add_(bend, alpha=scale)
    gradient.narrow(1, 1, length).add_(bend, alpha=-2 * scale)
    gradient.narrow(1, 2, length).add_(bend, alpha=scale)


@torch.no_grad()
def add_distance_gradient(gradient: Tensor, plane: Tensor, initial: Tensor, weight: float) -> None:
    """Add ``weight`` times the gradient of the mean squared distance from ``initial``."""
    gradient.add_(plane - initial, alpha=2 * weight / plane.numel())


@dataclass(frozen=True)
class PlaneTerms:
    """Weights of the terms.

    Attributes:
        total_variation: Of squared differences between neighbouring texels.
        variation: ``coded`` sums twice the mean squares along rows and columns over all planes,
            along time too, and counts space planes twice. ``corrected`` is the mean over planes of
            half that sum for space planes, and of differences along space alone for the others.
        time_smoothness: Of squared second differences along time, summed over planes.
        time_identity: Of the time planes' mean distance from 1, summed over planes.

    Source: K-Planes, released code.
    """

    total_variation: float
    variation: Variation
    time_smoothness: float
    time_identity: float

    def values(self, products: PlaneProducts) -> dict[str, Tensor]:
        """The three terms by name, without their weights. [] each"""
        planes = products.planes()
        zero = planes[0][1].new_zeros(())
        names = ("total_variation", "time_smoothness", "time_identity")
        found: dict[str, Tensor] = dict.fromkeys(names, zero)
        for name, plane in planes:
            dims, factor = self._variation(name, len(planes))
            term = factor * total_variation(plane, dims)
            found["total_variation"] = found["total_variation"] + term
            if "t" in name:
                found["time_smoothness"] = found["time_smoothness"] + time_smoothness(plane[0])
                found["time_identity"] = found["time_identity"] + (1 - plane).abs().mean()
        return found

    @torch.no_grad()
    def add_gradients(self, products: PlaneProducts) -> None:
        """Add the weighted terms' gradients to those of the planes."""
        if not (self.total_variation or self.time_smoothness or self.time_identity):
            return
        planes = products.planes()
        for name, plane in planes:
            if plane.grad is None:
                plane.grad = torch.zeros_like(plane)
            if weight := self.total_variation:
                dims, factor = self._variation(name, len(planes))
                add_total_variation_gradient(plane.grad, plane, dims, weight * factor)
            if "t" not in name:
                continue
            if weight := self.time_smoothness:
                add_time_smoothness_gradient(plane.grad[0], plane[0], weight)
            if weight := self.time_identity:
                plane.grad.add_((plane - 1).sign(), alpha=weight / plane.numel())

    def _variation(self, name: str, count: int) -> tuple[tuple[int, ...], float]:
        """Axes along which a plane's differences count, and their factor."""
        if self.variation == "coded":
            return (ROWS, COLUMNS), 2.0 if "t" in name else 4.0
        if "t" in name:
            return (COLUMNS,), 1 / count
        return (ROWS, COLUMNS), 0.5 / count
