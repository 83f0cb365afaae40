"""L_r: the loss that ties products of time planes to the sparse part (X-Planes, Eq. 17)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from xplanes.decomposition.conversion import frame_profiles

Rows = Sequence[tuple[int, int]]


def sparse_product_loss(
    time_planes: Tensor, sparse: Tensor, frames: Tensor, *, rows: Rows
) -> Tensor:
    """Mean squared difference of the sparse part and the planes' products at some frames.

    Frames drawn uniformly make it an unbiased estimate of the mean over all frames. The planes are
    sampled along time and space one after the other, on 1D profiles; only the outer product has the
    size of a triplane.

    Args:
        time_planes: Time planes of any resolution. [P, Rt, R, C]
        sparse: The sparse part of all frames, held fixed. [T, 3, C, H, W]
        frames: Numbers of the frames to use, repeats allowed. [B]
        rows: For xy, xz and yz the positions of the time planes of its first and second axis:
            ``PLANE_SETS[plane_set]``.

    Returns:
        The loss, differentiable with respect to the time planes. []
    """
    target = sparse[frames.to(sparse.device)].to(time_planes.dtype)
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
    """Share of the energy of the sparse part that the planes' products leave, over all frames.

    Args:
        time_planes: Time planes. [P, Rt, R, C]
        sparse: The sparse part. [T, 3, C, H, W]
        rows: As for ``sparse_product_loss``.

    Returns:
        0 for a perfect start, 1 for planes of zeros; 0 also where nothing moves.
    """
    left = energy = 0.0
    for frame in range(len(sparse)):
        chosen = torch.tensor([frame])
        left += sparse_product_loss(time_planes, sparse, chosen, rows=rows).item()
        energy += sparse[frame].to(time_planes.dtype).square().mean().item()
    return left / energy if energy else 0.0


class SparseProduct:
    """Holds the sparse part, and adds the gradient of L_r at a few random frames.

    It is no module: the sparse part is large, can be had again from its source, and belongs in no
    checkpoint.

    Args:
        sparse: The sparse part of all frames. [T, 3, C, H, W]
        rows: For xy, xz and yz the positions of their two time planes.
        count: Frames per application.
    """

    def __init__(self, sparse: Tensor, rows: Rows, count: int) -> None:
        self.sparse, self.rows, self.count = sparse, rows, count

    def add_gradient(
        self, gradient: Tensor, planes: Tensor, weight: float, generator: torch.Generator
    ) -> None:
        """Add ``weight`` times the gradient at random frames, an unbiased estimate of the whole.

        Args:
            gradient: Changed in place. [P, Rt, R, C]
            planes: Time planes. [P, Rt, R, C]
            weight: Factor.
            generator: Source of the frames, on the CPU.
        """
        frames = torch.randint(len(self.sparse), (self.count,), generator=generator)
        with torch.enable_grad():
            leaf = planes.detach().requires_grad_()
            loss = self._loss(leaf, frames)
        gradient.add_(torch.autograd.grad(loss, leaf)[0], alpha=weight)

    @torch.no_grad()
    def value(self, planes: Tensor) -> float:
        """The loss at frames spread evenly, the same at each call."""
        return float(self._loss(planes, _spread(self.count, len(self.sparse))))

    def _loss(self, planes: Tensor, frames: Tensor) -> Tensor:
        if self.sparse.device != planes.device:
            self.sparse = self.sparse.to(planes.device)
        return sparse_product_loss(planes, self.sparse, frames, rows=self.rows)


def _spread(count: int, total: int) -> Tensor:
    """``count`` frames spread evenly over ``total``, both ends included."""
    if count >= total:
        return torch.arange(total)
    return torch.linspace(0, total - 1, count).round().long()
