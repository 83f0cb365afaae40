"""The regulariser L_r: products of time planes stay near the sparse part (X-Planes, Eq. 17)."""

import copy
from collections.abc import Sequence

import torch
from torch import Tensor

from xplanes.decomposition.conversion import frame_profiles
from xplanes.fields.lookup import Rows
from xplanes.scenes.views import spread

REDUCTIONS = ("mean", "sum")


def sparse_product_loss(
    time_planes: Tensor, sparse: Tensor, frames: Tensor, *, rows: Rows
) -> Tensor:
    """Mean squared error between products of time planes and the sparse part at given frames.

    For uniformly drawn frames, the loss is an unbiased estimate of the mean over all frames. Planes
    are sampled separably, first in time, then in space; only the outer product has the size of a
    triplane.

    Args:
        time_planes: Time planes of any resolution. [P, Rt, R, C]
        sparse: The sparse part of all frames, the target. [T, 3, C, H, W]
        frames: Indices of the frames, from 0 to T - 1; may repeat. int64 [B]
        rows: For each of xy, xz and yz, the indices of the two time planes that are multiplied,
            first axis first: ``PLANE_SETS[plane_set]``.

    Returns:
        The loss, differentiable with respect to the time planes. []

    Source: X-Planes, Eq. 17, with a mean in place of the sum.
    """
    frames = frames.to(sparse.device, non_blocking=True)
    target = sparse[frames].to(time_planes.dtype)
    count, (height, width) = len(sparse), sparse.shape[-2:]
    wide = frame_profiles(time_planes, frames, count, width)
    tall = wide if height == width else frame_profiles(time_planes, frames, count, height)
    total = time_planes.new_zeros(())
    for index, (first, second) in enumerate(rows):
        # [B, C, H, 1] times [B, C, 1, W]
        product = tall[second].mT[..., None] * wide[first].mT[..., None, :]
        total = total + (target[:, index] - product).square().sum()
    return total / target.numel()


@torch.no_grad()
def unexplained_energy(time_planes: Tensor, sparse: Tensor, *, rows: Rows) -> float:
    """Fraction of the sparse part's energy that products of time planes do not explain.

    Args:
        time_planes: Time planes. [P, Rt, R, C]
        sparse: The sparse part. [T, 3, C, H, W]
        rows: As for ``sparse_product_loss``.

    Returns:
        0 for an exact fit, 1 for planes of zeros; 0 if the sparse part is zero.
    """
    left = energy = 0.0
    for frame in range(len(sparse)):
        chosen = torch.tensor([frame])
        left += sparse_product_loss(time_planes, sparse, chosen, rows=rows).item()
        energy += sparse[frame].to(time_planes.dtype).square().mean().item()
    return left / energy if energy else 0.0


class SparseProduct:
    """The regulariser L_r, at a few random frames per step or at all of them.

    With |S - b a^T|^2 = |S|^2 - 2 b^T S a + |a|^2 |b|^2, for profiles a and b of two time planes,
    the gradient needs only matrix-vector products, without temporaries of the size of S.
    `sparse_product_loss` is the reference implementation.

    It is not a module: the sparse part is large, can be recomputed, and must not be written to
    checkpoints. Copies share it.

    Args:
        sparse: The sparse part of all frames. [T, 3, C, H, W]
        rows: For xy, xz and yz: indices of their two time planes.
        count: Frames per step; None for all.
        reduction: "mean" over all entries of the sparse part, or their "sum", as in Eq. 17.

    Raises:
        ValueError: For another reduction.
    """

    def __init__(
        self, sparse: Tensor, rows: Rows, count: int | None, *, reduction: str = "mean"
    ) -> None:
        if reduction not in REDUCTIONS:
            raise ValueError(f"reduction is {reduction!r}: allowed are {', '.join(REDUCTIONS)}")
        self.sparse, self.rows, self.count = sparse.contiguous(), rows, count
        self.factor = sparse.numel() if reduction == "sum" else 1

    def __deepcopy__(self, memo: dict[int, object]) -> "SparseProduct":
        return copy.copy(self)

    def add_gradient(
        self, gradient: Tensor, planes: Tensor, weight: float, generator: torch.Generator
    ) -> None:
        """Add ``weight`` times the gradient, or an unbiased estimate of it from random frames.

        Args:
            gradient: Changed in place. [P, Rt, R, C]
            planes: Time planes. [P, Rt, R, C]
            weight: Weight of the regulariser.
            generator: Generator that draws the frames, on the CPU.
        """
        self._follow(planes)
        frames, target = torch.arange(len(self.sparse)), self.sparse
        if self.count is not None:
            frames = torch.randint(len(self.sparse), (self.count,), generator=generator)
            target = self.sparse[frames.to(planes.device, non_blocking=True)]
        with torch.enable_grad():
            leaf = planes.detach().requires_grad_()
            loss = self._varying(leaf, target, frames)
        scale = weight * self.factor / target.numel()
        gradient.add_(torch.autograd.grad(loss, leaf)[0], alpha=scale)

    @torch.no_grad()
    def value(self, planes: Tensor) -> float:
        """The loss, estimated from ``count`` evenly spaced frames; deterministic."""
        self._follow(planes)
        total = len(self.sparse)
        frames = torch.tensor(spread(self.count or total, total))
        # One frame at a time: the errors of all would have the size of the sparse part.
        errors = [
            sparse_product_loss(planes, self.sparse, frame, rows=self.rows)
            for frame in frames.split(1)
        ]
        return self.factor * float(torch.stack(errors).mean())

    def _follow(self, planes: Tensor) -> None:
        """Move the sparse part to the device of the planes."""
        self.sparse = self.sparse.to(planes.device, planes.dtype)

    def _varying(self, planes: Tensor, target: Tensor, frames: Tensor) -> Tensor:
        """Sum of squared errors at frames, minus the constant sum of the target's squares. []"""
        count, (height, width) = len(self.sparse), target.shape[-2:]
        wide = frame_profiles(planes, frames, count, width)
        tall = wide if height == width else frame_profiles(planes, frames, count, height)
        first, second = zip(*self.rows, strict=True)
        wide, tall = _per_slice(wide, first), _per_slice(tall, second)
        met = torch.bmm(target.flatten(0, 2), wide[..., None])[..., 0]
        products = wide.square().sum(dim=-1) * tall.square().sum(dim=-1)
        return products.sum() - 2 * (tall * met).sum()


def _per_slice(profiles: Tensor, places: Sequence[int]) -> Tensor:
    """Profiles of some planes in the order of a triplane's slices. [P, B, N, C] -> [B 3 C, N]"""
    return torch.stack([profiles[place].mT for place in places], dim=1).flatten(0, 2)
