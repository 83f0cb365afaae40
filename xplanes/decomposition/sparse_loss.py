"""The regulariser L_r: products of time planes stay near the sparse part (X-Planes, Eq. 17)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from xplanes.decomposition.conversion import frame_profiles

Rows = Sequence[tuple[int, int]]

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

    It is not a module: the sparse part is large, can be recomputed, and must not be written to
    checkpoints.

    Args:
        sparse: The sparse part of all frames. [T, 3, C, H, W]
        rows: For xy, xz and yz: indices of their two time planes.
        count: Frames per step; None for all.
        reduction: "mean" over all entries of the sparse part, or their "sum", as Eq. 17 has it.

    Raises:
        ValueError: For another reduction.
    """

    def __init__(
        self, sparse: Tensor, rows: Rows, count: int | None, *, reduction: str = "mean"
    ) -> None:
        if reduction not in REDUCTIONS:
            raise ValueError(f"reduction is {reduction!r}: allowed are {', '.join(REDUCTIONS)}")
        self.sparse, self.rows, self.count = sparse, rows, count
        self.factor = sparse.numel() if reduction == "sum" else 1

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
        frames = torch.arange(len(self.sparse))
        if self.count is not None:
            frames = torch.randint(len(self.sparse), (self.count,), generator=generator)
        with torch.enable_grad():
            leaf = planes.detach().requires_grad_()
            loss = self._loss(leaf, frames)
        gradient.add_(torch.autograd.grad(loss, leaf)[0], alpha=weight)

    @torch.no_grad()
    def value(self, planes: Tensor) -> float:
        """The loss, estimated from ``count`` evenly spaced frames; deterministic."""
        total = len(self.sparse)
        return float(self._loss(planes, _spread(self.count or total, total)))

    def _loss(self, planes: Tensor, frames: Tensor) -> Tensor:
        if self.sparse.device != planes.device:
            self.sparse = self.sparse.to(planes.device)
        return self.factor * sparse_product_loss(planes, self.sparse, frames, rows=self.rows)


def _spread(count: int, total: int) -> Tensor:
    """``count`` frames spread evenly over ``total``, both ends included."""
    if count >= total:
        return torch.arange(total)
    return torch.linspace(0, total - 1, count).round().long()
