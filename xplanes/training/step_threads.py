"""How many threads share a training step: the number with which it is fastest."""

import logging
import statistics
import time
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.backend import use_threads
from xplanes.errors import ConfigError

logger = logging.getLogger(__name__)

FIRST = 0.2
"""Seconds of training before the first trial, whose steps load and allocate."""

STEPS, SECONDS = 5, 0.5
"""A trial times so many steps with each number, or as many as begin in so many seconds."""

LONG = 0.1
"""Seconds from which a step is timed although the number of threads has changed just before it,
which takes a little time too."""

PAUSE, LONGEST = 4.0, 32.0
"""Seconds from a trial to the next: at first, and while nothing changes twice as many each time, up
to the second number."""

RARE = 10
"""A trial that took long is not repeated before so many times its seconds have passed."""

HOPELESS = 1.5
"""A number whose first two steps took so many times the fastest's is tried no further."""

MARGIN = 0.95
"""Share of the present number's time that another must stay below to replace it."""


class ThreadChoice:
    """Tries numbers of threads on whole steps now and then, and stays with the fastest.

    A step is hundreds of short loops. Where sleeping threads wake slowly, or other programs want
    their cores, one thread does it sooner than all.

    Args:
        most: The largest number; half of it, a quarter, ... and 1 are tried as well.

    Attributes:
        count: The number chosen last.
        medians: Seconds of a step by number of threads in the last trial; empty before the first.
    """

    def __init__(self, most: int) -> None:
        halved = (most >> shift for shift in range(most.bit_length()))
        self.numbers = sorted(halved)
        self.count = most
        self.medians: dict[int, float] = {}
        self._trial: dict[int, list[float]] | None = None
        self._number, self._settled = most, True
        self._left, self._pause = FIRST, PAUSE

    def next(self) -> int:
        """Threads for the next step."""
        return self._number

    def took(self, seconds: float) -> bool:
        """Note how long the step with `next` threads took; True where this ended a trial."""
        if self._trial is None:
            self._left -= seconds
            if self._left <= 0:
                self._trial = {number: [] for number in self.numbers}
                self._turn()
            return False
        if not self._settled and seconds < LONG:
            self._settled = True
            return False
        self._trial[self._number].append(seconds)
        if self._turn():
            return False
        self._decide(self._trial)
        return True

    def _turn(self) -> bool:
        """Go to the number that was timed least; False if all were timed enough."""
        assert self._trial is not None
        fastest = min((min(times) for times in self._trial.values() if times), default=0.0)
        timed = {
            number: len(times)
            for number, times in self._trial.items()
            if len(times) < STEPS
            and sum(times) < SECONDS
            and not (len(times) > 1 and min(times) > HOPELESS * fastest)
        }
        if not timed:
            return False
        # In turns, so that a change of the load meets all alike.
        number = min(timed, key=lambda n: timed[n])
        self._number, self._settled = number, number == self._number
        return True

    def _decide(self, trial: dict[int, list[float]]) -> None:
        self.medians = {number: statistics.median(times) for number, times in trial.items()}
        best = min(self.medians, key=lambda number: self.medians[number])
        if self.medians[best] < MARGIN * self.medians[self.count]:
            self.count, self._pause = best, PAUSE
        else:
            self._pause = min(2 * self._pause, LONGEST)
        self._number, self._trial = self.count, None
        self._left = max(self._pause, RARE * sum(map(sum, trial.values())))


class StepThreads(Callback):
    """Chooses the number of threads by timing steps: ``callbacks=threads``.

    The number of threads changes the last digits of sums, so runs with it are not deterministic.
    Does nothing on GPUs and in several processes.

    Attributes:
        count: Threads of the steps so far.
    """

    def __init__(self) -> None:
        self._all = self.count = torch.get_num_threads()
        self.choice: ThreadChoice | None = None
        self._mark = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if torch.are_deterministic_algorithms_enabled():
            raise ConfigError(
                "trainer.deterministic=true with callbacks=threads: sums differ in their last "
                "digits with another number of threads; leave one of them out"
            )
        wanted = pl_module.device.type == "cpu" and trainer.world_size == 1 and self._all > 1
        self.choice = ThreadChoice(self._all) if wanted else None
        self._mark = time.perf_counter()

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        self._mark = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self.choice is None:
            return
        took = time.perf_counter() - self._mark
        if self.choice.took(took) and self.choice.count != self.count:
            self.count = self.choice.count
            each = ", ".join(f"{1000 * s:.3g} ms with {n}" for n, s in self.choice.medians.items())
            logger.info("threads: %d from here on; a step took %s", self.count, each)
        use_threads(self.choice.next())

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        use_threads(self._all)

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        use_threads(self._all)
