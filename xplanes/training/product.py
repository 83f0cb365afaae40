"""L_r in training: products of time planes are tied to the sparse part (X-Planes, Eq. 17)."""

import torch
from torch import Tensor

from xplanes.decomposition import sparse_product_loss
from xplanes.decomposition.sparse_loss import Rows
from xplanes.training.scoring import spread


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
        return float(self._loss(planes, torch.tensor(spread(self.count, len(self.sparse)))))

    def _loss(self, planes: Tensor, frames: Tensor) -> Tensor:
        if self.sparse.device != planes.device:
            self.sparse = self.sparse.to(planes.device)
        return sparse_product_loss(planes, self.sparse, frames, rows=self.rows)
