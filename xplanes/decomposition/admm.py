"""The iterations of robust PCA: ADMM in fused passes over blocks of rows.

Singular values of tall matrices are shrunk through their small Gram matrix.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

_BLOCK_ELEMENTS = {"cpu": 1 << 20, "cuda": 1 << 27}  # Matrix entries per block.
_SINGLE_PRECISION_ERROR = 3e-9  # See `needs_double`.
_NARROW_FROM_COLUMNS = 96  # Columns from which two thin products may be faster.
_LARGEST = 1e6  # Maximum of penalty * |Y|.
_SPARSE_FLOOR = 0.05  # Least |S| / |Y| in relative residuals.
_CHECK_EVERY = 4  # Iterations between checks of convergence.
CHANGE_OVER_TOLERANCE = 10.0  # Ratio of the bounds on relative change and residual.

# The adaptive penalty: these values minimise the iterations on matrices like LRM features.
_RELAXATION = 1.6
"""Over-relaxation of the low-rank part; 1 is plain ADMM."""
_WARM_UP, _WARM_STEP = 10, 3.0
"""Iterations that set the penalty from the norms, and its largest factor per iteration."""
_RATIO = 1.5
"""Target of ``penalty * |S| / |multiplier|`` in these iterations."""
_GROWTH = 1.2
"""Factor on the penalty per iteration afterwards, when it grows."""
_GROW_ABOVE, _SHRINK_BELOW = 0.35, 0.02
"""Grow or shrink while relative residual over relative change is above or below these."""


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

    Squaring gives an error of about 1e-8 times the largest SQUARED singular value (rounding within
    a block; the sum over blocks is float64). Relative to the thresholded matrix, measurements gave
    3e-9 to 1e-8 ``largest / threshold``; the smaller value must be below a tenth of the tolerance.

    Args:
        largest: Largest singular value.
        threshold: Threshold of the singular values, in the same unit.
        tolerance: Required relative accuracy.
    """
    return _SINGLE_PRECISION_ERROR * largest > 0.1 * tolerance * threshold


def shrinkage_from_gram(gram: Tensor, threshold: float) -> tuple[Tensor, Tensor, Tensor]:
    """Singular directions kept by thresholding, and the shrinkage factor of each.

    Thresholding is the proximal operator of the nuclear norm (X-Planes, Eq. 24-25).

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
    """Make one iteration without relaxation; write L to ``low_rank`` and S over the state.

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


@dataclass(frozen=True)
class Norms:
    """Frobenius norms after an iteration.

    Attributes:
        sparse: The sparse part.
        multiplier: The multiplier over the penalty.
        change: The change of the sparse part.
        residual: ``L + S - Y``.
    """

    sparse: float
    multiplier: float
    change: float
    residual: float


class Penalty:
    """The penalty of this iteration, the one before and the one after.

    A pass prepares the next one, so its measurements change the penalty of the pass after that.
    """

    def __init__(self, start: float, norm: float, *, adaptive: bool) -> None:
        self.before = self.now = self.after = start
        self._norm, self._adaptive = norm, adaptive
        self._rate, self._growth, self._direction = 1.0, _GROWTH, 0

    def warm(self, iteration: int) -> bool:
        """Whether the penalty is still set from the norms of the iterates."""
        return self._adaptive and iteration <= _WARM_UP

    def relative(self, norms: Norms) -> tuple[float, float]:
        """Residual relative to the sparse part, and change relative to the multiplier.

        A lower bound excludes rounding errors if the sparse part is nearly zero.
        """
        primal = norms.residual / max(norms.sparse, _SPARSE_FLOOR * self._norm)
        return primal, norms.change / max(norms.multiplier, 1e-30 * self._norm)

    def balance(self, iteration: int, norms: Norms, *, feasible: bool) -> None:
        """Choose whether the penalty grows, stays or shrinks until the next check.

        Each change of direction halves the logarithmic rate, so that the penalty settles.

        Args:
            iteration: Number of this iteration.
            norms: Norms of the last iteration.
            feasible: Whether the residual is far below the tolerance (growth has no benefit).
        """
        if not self._adaptive or self.warm(iteration):
            return
        primal, dual = self.relative(norms)
        direction = 0
        if primal > _GROW_ABOVE * dual and not feasible:
            direction = 1
        elif primal < _SHRINK_BELOW * dual:
            direction = -1
        if direction * self._direction < 0:
            self._growth = math.sqrt(self._growth)
        self._direction = direction or self._direction
        self._rate = self._growth**direction

    def advance(self, iteration: int, norms: Norms) -> None:
        """Advance to the next iteration."""
        self.before, self.now = self.now, self.after
        if self.warm(iteration):
            sparse = max(norms.sparse, _SPARSE_FLOOR * self._norm)
            target = _RATIO * self.before * norms.multiplier / sparse
            self.after = min(max(target, self.now / _WARM_STEP), self.now * _WARM_STEP)
        elif self._rate != 1:
            self.after = min(self.now * self._rate, max(self.now, _LARGEST / self._norm))


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
    adaptive: bool,
    tolerance: float,
    max_iterations: int,
    on_iteration: Callable[[Progress], None],
) -> Progress:
    """Minimise ``|L|_* + sparsity_weight |S|_1`` subject to ``L + S = Y`` into the given outputs.

    Args:
        matrix: Y, float32 or float64, rows or columns contiguous, not zero. [M, T]
        low_rank: Output L. [M, T]
        sparse: Output S; stores the state during the iterations. [M, T]
        sparsity_weight: Weight of the sparse part.
        penalty: Penalty of the first pass, absolute.
        adaptive: Over-relax, set the penalty from the iterates for ten iterations, then balance it
            between residual and change; otherwise it is constant.
        tolerance: Stop when the residual is below this and, if adaptive, the change below ten times
            this.
        max_iterations: Maximum number of passes, at least 1.
        on_iteration: Called after each pass.

    Returns:
        The final state; the last pass is plain ADMM and is not included in its measurements.
    """
    work = Workspace(matrix, sparse)
    gram = start(work)
    norm = gram.trace().sqrt().item()
    single = matrix.dtype == torch.float32
    path = Penalty(penalty, norm, adaptive=adaptive)
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
            relaxation=_RELAXATION if adaptive else 1.0,
            double=not single or needs_double(singular[-1].item(), 1 / path.after, tolerance),
        )
        if last:
            finish(work, low_rank, step)
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
            if adaptive:
                last = last and progress.change <= CHANGE_OVER_TOLERANCE * tolerance
        last = last or progress.iterations >= max_iterations - 1
        path.advance(progress.iterations, norms)
        on_iteration(progress)
