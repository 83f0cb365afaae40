"""Algorithm 1 of the paper as it is printed, with a full singular value decomposition.

Slow and simple on purpose: tests compare the fused passes with it; ``method="exact"`` runs it.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from xplanes.decomposition.solver import Progress
from xplanes.decomposition.svt import singular_value_threshold


def plain_admm(
    matrix: Tensor,
    low_rank: Tensor,
    sparse: Tensor,
    *,
    sparsity_weight: float,
    penalty: float,
    tolerance: float,
    max_iterations: int,
    on_iteration: Callable[[Progress], None] | None = None,
) -> Progress:
    """Robust PCA by ADMM with a fixed penalty (X-Planes, Algorithm 1), into the given outputs.

    Args:
        matrix: Y, float32 or float64, not zero. [M, T]
        low_rank: Output L. [M, T]
        sparse: Output S. [M, T]
        sparsity_weight: Weight of the sparse part.
        penalty: The penalty, absolute.
        tolerance: Stop when ``|L + S - Y| / |Y|`` is below this.
        max_iterations: Maximum number of iterations.
        on_iteration: Called after each iteration.

    Returns:
        The final state.
    """
    norm = torch.linalg.vector_norm(matrix).item()
    progress = Progress(penalty=penalty)
    multiplier = torch.zeros_like(matrix)
    sparse.zero_()
    while progress.iterations < max_iterations:
        progress.iterations += 1
        part, progress.rank = singular_value_threshold(
            matrix - sparse - multiplier / penalty, 1 / penalty, exact=True
        )
        low_rank.copy_(part)
        argument = matrix - low_rank - multiplier / penalty
        shrunk = (argument.abs() - sparsity_weight / penalty).clamp_min(0)
        sparse.copy_(argument.sign() * shrunk)
        gap = low_rank + sparse - matrix
        multiplier += penalty * gap
        progress.residual = progress.change = torch.linalg.vector_norm(gap).item() / norm
        if on_iteration:
            on_iteration(progress)
        if progress.residual <= tolerance:
            break
    return progress
