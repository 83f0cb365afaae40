"""Singular value thresholding of tall matrices through their small Gram matrix."""

import torch
from torch import Tensor

_BLOCK_ELEMENTS = {"cpu": 1 << 20, "cuda": 1 << 27}
_SINGLE_PRECISION_ERROR = 3e-9


def block_rows(matrix: Tensor) -> int:
    """Rows per block, so that a block and its temporaries stay in the processor's cache."""
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
        tolerance: Relative accuracy that is wanted.
    """
    return _SINGLE_PRECISION_ERROR * largest > 0.1 * tolerance * threshold


def shrinkage_from_gram(gram: Tensor, threshold: float) -> tuple[Tensor, Tensor, Tensor]:
    """Directions kept by singular value thresholding, and the factor that shrinks each.

    Args:
        gram: Gram matrix of the columns, float64. [T, T]
        threshold: What is taken off every singular value.

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
    """Shrink the singular values: the proximal step of the nuclear norm (X-Planes, Eq. 24-25).

    Args:
        matrix: A matrix with many more rows than columns, float32 or float64. [M, T]
        threshold: What is taken off every singular value; below zero they stay at zero.
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
