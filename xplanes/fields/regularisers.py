"""Smoothness of planes, as gradients added directly to ``.grad``.

A training step renders few rays, but smoothness involves every texel: through autograd it would
cost more than the rest of the step. Its gradient is a simple stencil, which is added every few
steps, with a correspondingly larger weight.
"""

import torch
from torch import Tensor

from xplanes.backend import compiled, cpu_loops


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
    like = plane.is_contiguous() and gradient.is_contiguous() and gradient.dtype == plane.dtype
    if set(dims) <= {1, 2} and like and cpu_loops(plane):
        counts = [plane.narrow(dim, 0, plane.shape[dim] - 1).numel() for dim in (1, 2)]
        values, target = (each.detach().flatten(2).numpy() for each in (plane, gradient))
        factors = (
            values.dtype.type(2 * weight / count if dim in dims and count else 0)
            for dim, count in enumerate(counts, start=1)
        )
        cpu = compiled("xplanes.fields.lookup_numba")
        cpu.add_variation(values, plane.shape[3], *factors, target)
        return
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
