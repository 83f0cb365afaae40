"""The penalty of ADMM over the iterations."""

import math
from dataclasses import dataclass

_WARM_UP = 10
_WARM_STEP = 3.0
_LARGEST = 1e6
_SPARSE_FLOOR = 0.05


@dataclass(frozen=True)
class Schedule:
    """Schedule of the penalty, and over-relaxation.

    The adaptive values minimise the iterations to a given error on feature-like matrices.

    Attributes:
        relaxation: Over-relaxation of the low-rank part; 1 is plain ADMM.
        growth: Factor on the penalty per iteration when it grows; 1 keeps it fixed.
        adaptive: Set the penalty from the iterates for ten iterations, then balance it.
        ratio: Initial target of ``penalty * |S| / |multiplier|``.
        grow_above: Grow while relative residual over relative change is above this.
        shrink_below: Shrink while it is below this.
    """

    relaxation: float = 1.0
    growth: float = 1.0
    adaptive: bool = False
    ratio: float = 1.5
    grow_above: float = 0.35
    shrink_below: float = 0.02


SCHEDULES = {
    "adaptive": Schedule(relaxation=1.6, growth=1.2, adaptive=True),
    "growing": Schedule(growth=1.2),
    "admm": Schedule(),
}


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

    def __init__(self, schedule: Schedule, start: float, norm: float) -> None:
        self.before = self.now = self.after = start
        self._schedule = schedule
        self._norm = norm
        self._rate = 1.0 if schedule.adaptive else schedule.growth
        self._growth = schedule.growth
        self._direction = 0

    def warm(self, iteration: int) -> bool:
        """Whether the penalty is still set from the norms of the iterates."""
        return self._schedule.adaptive and iteration <= _WARM_UP

    def relative(self, norms: Norms) -> tuple[float, float]:
        """Residual relative to the sparse part, and change relative to the multiplier.

        A lower bound excludes rounding errors if the sparse part is nearly zero.
        """
        primal = norms.residual / max(norms.sparse, _SPARSE_FLOOR * self._norm)
        return primal, norms.change / max(norms.multiplier, 1e-30 * self._norm)

    def balance(self, iteration: int, norms: Norms, *, feasible: bool) -> None:
        """Choose whether to grow, keep or shrink until the next check.

        Each change of direction halves the logarithmic rate, so that the penalty settles.

        Args:
            iteration: Number of this iteration.
            norms: Norms of the last iteration.
            feasible: Whether the residual is far below the tolerance (growth has no benefit).
        """
        if not self._schedule.adaptive or self.warm(iteration):
            return
        primal, dual = self.relative(norms)
        direction = 0
        if primal > self._schedule.grow_above * dual and not feasible:
            direction = 1
        elif primal < self._schedule.shrink_below * dual:
            direction = -1
        if direction * self._direction < 0:
            self._growth = math.sqrt(self._growth)
        self._direction = direction or self._direction
        self._rate = self._growth**direction

    def advance(self, iteration: int, norms: Norms) -> None:
        """Go on to the next iteration."""
        self.before, self.now = self.now, self.after
        if self.warm(iteration):
            sparse = max(norms.sparse, _SPARSE_FLOOR * self._norm)
            target = self._schedule.ratio * self.before * norms.multiplier / sparse
            self.after = min(max(target, self.now / _WARM_STEP), self.now * _WARM_STEP)
        elif self._rate != 1:
            self.after = min(self.now * self._rate, max(self.now, _LARGEST / self._norm))
