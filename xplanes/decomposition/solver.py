"""The loop of robust PCA: passes until the residual and the change are small."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from xplanes.decomposition.schedule import Norms, Penalty, Schedule
from xplanes.decomposition.svt import (
    Step,
    Workspace,
    finish,
    iterate,
    needs_double,
    shrinkage_from_gram,
    start,
)

_CHECK_EVERY = 4
CHANGE_OVER_TOLERANCE = 10.0


@dataclass
class Progress:
    """State of the loop.

    Attributes:
        iterations: Passes made.
        rank: Rank of the low-rank part.
        penalty: Penalty of the last pass, absolute.
        residual: ``|L + S - Y| / |Y|`` at the last check, Frobenius norms.
        change: Relative step size at the last check: the larger of ``|L + S - Y| / |S|`` and the
            change of S relative to the scaled multiplier.
    """

    iterations: int = 0
    rank: int = 0
    penalty: float = 0.0
    residual: float = math.inf
    change: float = math.inf


def minimise(
    matrix: Tensor,
    low_rank: Tensor,
    sparse: Tensor,
    *,
    sparsity_weight: float,
    penalty: float,
    schedule: Schedule,
    tolerance: float,
    max_iterations: int,
    on_iteration: Callable[[Progress], None] | None = None,
) -> Progress:
    """Minimise ``|L|_* + sparsity_weight |S|_1`` subject to ``L + S = Y`` into the given outputs.

    Args:
        matrix: Y, float32 or float64, rows or columns contiguous, not zero. [M, T]
        low_rank: Output L. [M, T]
        sparse: Output S; stores the state during the iterations. [M, T]
        sparsity_weight: Weight of the sparse part.
        penalty: Penalty of the first pass, absolute.
        schedule: Schedule of the penalty.
        tolerance: Stop when the residual is below this and, for an adaptive schedule, the change
            below ten times this.
        max_iterations: Maximum number of passes, at least 1.
        on_iteration: Called after each pass.

    Returns:
        The final state; the last pass is plain ADMM and is not included in its measurements.
    """
    work = Workspace(matrix, sparse)
    gram = start(work)
    norm = gram.trace().sqrt().item()
    single = matrix.dtype == torch.float32
    path = Penalty(schedule, penalty, norm)
    progress = Progress()
    last = max_iterations == 1
    while True:
        basis, factors, singular = shrinkage_from_gram(gram, 1 / path.now)
        progress.iterations += 1
        progress.rank = len(factors)
        progress.penalty = path.now
        step = Step(
            basis,
            factors,
            old_limit=sparsity_weight / path.before,
            limit=sparsity_weight / path.now,
            rescale=path.before / path.now,
            next_rescale=path.now / path.after,
            relaxation=schedule.relaxation,
            double=not single or needs_double(singular[-1].item(), 1 / path.after, tolerance),
        )
        if last:
            finish(work, low_rank, step)
            if on_iteration:
                on_iteration(progress)
            return progress

        check = progress.iterations % _CHECK_EVERY == 0
        gram, values = iterate(work, step, norms=path.warm(progress.iterations), changes=check)
        norms = Norms(*values)
        if check:
            progress.residual = norms.residual / norm
            progress.change = max(path.relative(norms))
            feasible = progress.residual <= 0.1 * tolerance
            path.balance(progress.iterations, norms, feasible=feasible)
            last = progress.residual <= tolerance
            if schedule.adaptive:
                last = last and progress.change <= CHANGE_OVER_TOLERANCE * tolerance
        last = last or progress.iterations >= max_iterations - 1
        path.advance(progress.iterations, norms)
        if on_iteration:
            on_iteration(progress)
