"""Singular value thresholding of tall matrices through their small Gram matrix."""

from dataclasses import dataclass

import torch
from torch import Tensor

_BLOCK_ELEMENTS = {"cpu": 1 << 20, "cuda": 1 << 27}
_SINGLE_PRECISION_ERROR = 3e-9


def block_rows(matrix: Tensor) -> int:
    """Rows per block, so that a block and its temporaries fit in the cache."""
    elements = _BLOCK_ELEMENTS.get(matrix.device.type, _BLOCK_ELEMENTS["cuda"])
    return max(64, elements // max(1, matrix.shape[1]))


def add_gram(total: Tensor, block: Tensor, *, double: bool) -> None:
    """Add ``block^T block`` to a running sum held in float64.

    Args:
        total: Running sum, changed in place, float64. [T, T]
        block: Rows of the matrix. [B, T]
        double: Multiply in float64 too. Otherwise only the sum over blocks is float64.
    """
    if double and block.dtype != torch.float64:
        block = block.double()
    total += block.mT @ block


def needs_double(largest: float, threshold: float, tolerance: float) -> bool:
    """Whether a float32 Gram matrix is too coarse for this threshold.

    Squaring leaves an error of about 1e-8 times the largest SQUARED singular value (rounding within
    a block; the sum over blocks is float64). Relative to the thresholded matrix it was measured as
    3e-9 to 1e-8 ``largest / threshold``; a tenth of the tolerance is left to the smaller figure.

    Args:
        largest: Largest singular value.
        threshold: Threshold of the singular values, in the same unit.
        tolerance: Required relative accuracy.
    """
    return _SINGLE_PRECISION_ERROR * largest > 0.1 * tolerance * threshold


def shrinkage_from_gram(gram: Tensor, threshold: float) -> tuple[Tensor, Tensor, Tensor]:
    """Directions kept by singular value thresholding, and the factor that shrinks each.

    Args:
        gram: Gram matrix of the columns, float64. [T, T]
        threshold: Value subtracted from every singular value.

    Returns:
        Right singular vectors above the threshold, their factors ``1 - threshold / s`` (all in
        float64), and all singular values in ascending order. [T, K], [K], [T]
    """
    values, vectors = torch.linalg.eigh(gram)
    singular = values.clamp_min(0).sqrt()
    kept = singular > threshold
    factors = 1 - threshold / singular[kept]
    return vectors[:, kept], factors, singular


def singular_value_threshold(
    matrix: Tensor, threshold: float, *, exact: bool = False
) -> tuple[Tensor, int]:
    """Shrink the singular values: the proximal operator of the nuclear norm (X-Planes, Eq. 24-25).

    Args:
        matrix: A matrix with many more rows than columns, float32 or float64. [M, T]
        threshold: Value subtracted from every singular value; negative results become zero.
        exact: Use a full singular value decomposition instead of the Gram matrix.

    Returns:
        The shrunk matrix and its rank. [M, T]
    """
    if exact:
        left, singular, right = torch.linalg.svd(matrix, full_matrices=False)
        shrunk = (singular - threshold).clamp_min(0)
        return (left * shrunk) @ right, int((shrunk > 0).sum())
    gram = torch.zeros(matrix.shape[1], matrix.shape[1], dtype=torch.float64, device=matrix.device)
    for block in matrix.split(block_rows(matrix)):
        add_gram(gram, block, double=True)
    basis, factors, _ = shrinkage_from_gram(gram, threshold)
    weights = ((basis * factors) @ basis.mT).to(matrix.dtype)
    return matrix @ weights, len(factors)


_NARROW_FROM_COLUMNS = 96


@dataclass(frozen=True)
class Step:
    """Parameters of one iteration.

    Attributes:
        basis: Right singular vectors kept, float64. [T, K]
        factors: Their shrinkage factors, float64. [K]
        old_limit: Clip limit with which the stored Z was computed.
        limit: Clip limit of this iteration.
        rescale: Ratio of the previous penalty to this one.
        next_rescale: Ratio of this penalty to the next one.
        relaxation: Over-relaxation of the low-rank part.
        double: Multiply the Gram matrix in float64.
    """

    basis: Tensor
    factors: Tensor
    old_limit: float
    limit: float
    rescale: float
    next_rescale: float = 1.0
    relaxation: float = 1.0
    double: bool = True


class Workspace:
    """The matrix and its state as row blocks, with four block-sized buffers."""

    def __init__(self, matrix: Tensor, state: Tensor) -> None:
        self.rows = min(block_rows(matrix), len(matrix))
        self.matrix = matrix
        self.blocks = list(zip(matrix.split(self.rows), state.split(self.rows), strict=True))
        columns = matrix.shape[1]
        by_column = matrix.stride(0) == 1
        shape = (4, columns, self.rows) if by_column else (4, self.rows, columns)
        buffers = torch.empty(shape, dtype=matrix.dtype, device=matrix.device)
        self._buffers = (buffers.mT if by_column else buffers).unbind(0)

    def buffers(self, count: int) -> list[Tensor]:
        return [buffer[:count] for buffer in self._buffers]


def start(work: Workspace) -> Tensor:
    """Clear the state and return the Gram matrix of Y, in float64 on the CPU. [T, T]"""
    columns = work.matrix.shape[1]
    gram = torch.zeros(columns, columns, dtype=torch.float64, device=work.matrix.device)
    for block, state in work.blocks:
        add_gram(gram, block, double=True)
        state.zero_()
    return gram.cpu()


def iterate(
    work: Workspace, step: Step, *, norms: bool, changes: bool
) -> tuple[Tensor, list[float]]:
    """Make one iteration in place.

    Args:
        work: The blocks; their state is overwritten.
        step: Parameters of the iteration.
        norms: Measure the norms of the sparse part and of the multiplier over the penalty.
        changes: Also measure the change of the sparse part and ``|L + S - Y|``.

    Returns:
        The Gram matrix of the next X, in float64 on the CPU, and the four norms (zero if not
        measured). Both need a single transfer from the device. [T, T]
    """
    matrix, alpha = work.matrix, step.relaxation
    columns, kept = step.basis.shape
    totals = torch.zeros(columns * columns + 4, dtype=torch.float64, device=matrix.device)
    gram = totals[4:].view(columns, columns)
    forward = (step.basis * (alpha * step.factors)).to(matrix)
    backward = step.basis.mT.to(matrix)
    # Two thin products are faster than one square product only if few directions are kept.
    narrow = columns >= _NARROW_FROM_COLUMNS and 4 * kept <= columns
    weights = (
        forward if narrow else ((step.basis * (alpha * step.factors)) @ step.basis.mT).to(matrix)
    )
    if not narrow:
        weights.diagonal().sub_(alpha - 1)

    for y, z in work.blocks:
        clipped, x, next_clipped, change = work.buffers(len(y))
        torch.clamp(z, -step.old_limit, step.old_limit, out=clipped)
        if changes:
            torch.sub(z, clipped, out=change)
        torch.sub(y, z, out=x)
        x.add_(clipped, alpha=1 + step.rescale)
        # Z = Y - relaxed L - multiplier, where relaxed L = alpha X W + (1 - alpha) (Y - sparse).
        torch.add(y, clipped, alpha=(2 - alpha) * step.rescale, out=z)
        if narrow:
            z.add_(x, alpha=alpha - 1)
            z.addmm_(x @ forward, backward, alpha=-1)
        else:
            z.addmm_(x, weights, alpha=-1)
        torch.clamp(z, -step.limit, step.limit, out=next_clipped)
        if norms or changes:
            torch.sub(z, next_clipped, out=x)
            totals[0] += _squared(x)
            totals[1] += _squared(next_clipped)
        if changes:
            change.sub_(x)
            totals[2] += _squared(change)
            # Undo the relaxation: L + S - Y from the step of the multiplier and the change of S.
            clipped.mul_(step.rescale).sub_(next_clipped).add_(change, alpha=1 - alpha)
            totals[3] += _squared(clipped) / alpha**2
        torch.sub(y, z, out=x)
        x.add_(next_clipped, alpha=1 + step.next_rescale)
        add_gram(gram, x, double=step.double)

    totals = totals.cpu()
    return totals[4:].view(columns, columns), totals[:4].sqrt().tolist()


def finish(work: Workspace, low_rank: Tensor, step: Step) -> None:
    """Make one plain iteration; write L to ``low_rank`` and overwrite the state with S.

    Args:
        work: The blocks; their state becomes the sparse part.
        low_rank: Output L. [M, T]
        step: Parameters of the iteration.
    """
    weights = ((step.basis * step.factors) @ step.basis.mT).to(work.matrix)
    for (y, z), low in zip(work.blocks, low_rank.split(work.rows), strict=True):
        clipped, x, next_clipped, _ = work.buffers(len(y))
        torch.clamp(z, -step.old_limit, step.old_limit, out=clipped)
        torch.sub(y, z, out=x)
        x.add_(clipped, alpha=1 + step.rescale)
        torch.mm(x, weights, out=low)
        torch.sub(y, low, out=z)
        z.add_(clipped, alpha=step.rescale)
        torch.clamp(z, -step.limit, step.limit, out=next_clipped)
        z.sub_(next_clipped)


def _squared(block: Tensor) -> Tensor:
    return torch.linalg.vector_norm(block).double().square()
