"""The loop of robust PCA: which penalty, how many passes, when to stop."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from xplanes.decomposition.passes import Step, Workspace, finish, iterate, start
from xplanes.decomposition.svt import needs_double, shrinkage_from_gram

_WARM_UP = 10
_CHECK_EVERY = 4
_LARGEST_PENALTY = 1e6


@dataclass(frozen=True)
class Schedule:
    """How the penalty moves and how far each step is stretched.

    Attributes:
        relaxation: Over-relaxation of the low-rank part; 1 is plain ADMM.
        growth: Factor on the penalty per iteration where it grows; 1 keeps it fixed.
        adaptive: Set the penalty from the iterates for ten iterations, then let it grow only
            while the residual is large beside the change; also wait for the change at the end.
        ratio: What ``penalty * |S| / |multiplier|`` is brought to at first.
        balance: Grow while ``|L + S - Y| / |S|`` exceeds this many times the relative change.
    """

    relaxation: float = 1.0
    growth: float = 1.0
    adaptive: bool = False
    ratio: float = 1.5
    balance: float = 0.35


SCHEDULES = {
    "adaptive": Schedule(relaxation=1.6, growth=1.2, adaptive=True),
    "growing": Schedule(growth=1.2),
    "admm": Schedule(),
}


@dataclass
class Progress:
    """Where the loop stands.

    Attributes:
        iterations: Passes made.
        rank: Rank of the low-rank part.
        penalty: Penalty of the last pass, absolute.
        residual: ``|L + S - Y| / |Y|`` at the last check, Frobenius norms.
        change: The larger of ``|L + S - Y| / |S|`` and the change of S over the scaled
            multiplier at the last check: the size of the step still being taken.
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
        low_rank: Where L goes. [M, T]
        sparse: Where S goes; holds the state of the iteration meanwhile. [M, T]
        sparsity_weight: Weight of the sparse part.
        penalty: Penalty of the first pass, absolute.
        schedule: How the penalty moves.
        tolerance: Stop when the residual is below this and, for an adaptive schedule, the change
            below ten times this.
        max_iterations: Limit on the passes, at least 1.
        on_iteration: Called after each pass.

    Returns:
        The state at the end; the last pass is plain ADMM and is not measured here.
    """
    work = Workspace(matrix, sparse)
    gram = start(work)
    norm = gram.trace().sqrt().item()
    single = matrix.dtype == torch.float32
    progress = Progress()
    before = now = after = penalty
    growing = schedule.growth > 1 and not schedule.adaptive
    last = max_iterations == 1
    while True:
        basis, factors, singular = shrinkage_from_gram(gram, 1 / now)
        largest = singular[-1].item()
        progress.iterations += 1
        progress.rank = len(factors)
        progress.penalty = now
        step = Step(
            basis,
            factors,
            old_limit=sparsity_weight / before,
            limit=sparsity_weight / now,
            rescale=before / now,
            next_rescale=now / after,
            relaxation=schedule.relaxation,
            double=not single or needs_double(largest, 1 / after),
        )
        if last:
            finish(work, low_rank, step)
            if on_iteration:
                on_iteration(progress)
            return progress

        warm = schedule.adaptive and progress.iterations <= _WARM_UP
        check = progress.iterations % _CHECK_EVERY == 0
        gram, norms = iterate(work, step, norms=warm, changes=check)
        sparse_norm, multiplier_norm, sparse_change, residual_norm = norms
        if check:
            primal = residual_norm / max(sparse_norm, 1e-3 * norm)
            dual = sparse_change / max(multiplier_norm, 1e-30 * norm)
            progress.residual = residual_norm / norm
            progress.change = max(primal, dual)
            last = progress.residual <= tolerance
            if schedule.adaptive:
                growing = primal > schedule.balance * dual
                last = last and progress.change <= 10 * tolerance
        last = last or progress.iterations >= max_iterations - 1
        if on_iteration:
            on_iteration(progress)

        before, now = now, after
        if warm:
            target = schedule.ratio * before * multiplier_norm / max(sparse_norm, 1e-3 * norm)
            after = min(max(target, now / 3), now * 3)
        elif growing:
            after = min(now * schedule.growth, max(now, _LARGEST_PENALTY / norm))
