"""Training that has converged stops."""

import math
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.errors import ConfigError
from xplanes.training.module import RadianceModule

BLOCK = 50
"""Batches whose mean error is remembered."""

LEAST = 20
"""Blocks before which nothing is judged."""

COOLING = 0.25
"""Steps of falling learning rates at the end, as a share of those before."""


class PlateauStop(Callback):
    """Ends training once doubling its steps has gained little PSNR on the training rays.

    Scored views are not used. The learning rates then decay over a last quarter, because ending at
    full rates would lose quality.

    Args:
        gain: Gain in dB below which training ends; None: it never ends early.

    Attributes:
        ending: Step and progress at which training was told to end early, and the step of the end.
    """

    def __init__(self, gain: float | None = None) -> None:
        if gain is not None and not gain > 0:
            raise ConfigError(f"gain={gain}: must be above 0, or null for no early end")
        self.gain = gain
        self.ending: tuple[int, float, int] | None = None
        self._errors: list[float] = []
        self._block: list[float] = []
        self._step = 0

    @property
    def progress(self) -> float:
        """Share of training that is done, once it was told to end; 0 before."""
        if self.ending is None:
            return 0.0
        begin, done, end = self.ending
        return done + (1 - done) * (self._step - begin) / (end - begin)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._step = trainer.global_step
        if self.progress >= 1:
            trainer.should_stop = True

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, RadianceModule)
        self._step = trainer.global_step
        if self.gain is None:
            return
        if self.ending is not None:
            trainer.should_stop |= self.progress >= 1
            return
        self._block.append(10 ** (-0.1 * pl_module.last.get("psnr", 0.0)))
        if len(self._block) < BLOCK:
            return
        error = torch.tensor(sum(self._block) / BLOCK, device=pl_module.device)
        if trainer.world_size > 1:
            # All ranks must agree on the end.
            error = torch.as_tensor(trainer.strategy.reduce(error, reduce_op="mean"))
        self._errors.append(float(error))
        self._block = []
        if converged(self._errors, self.gain):
            steps = max(1, round(COOLING * self._step))
            self.ending = (self._step, pl_module.progress, self._step + steps)

    def state_dict(self) -> dict[str, Any]:
        return {"errors": self._errors, "block": self._block, "ending": self.ending}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._errors, self._block = list(state_dict["errors"]), list(state_dict["block"])
        # A run that continues without the rule trains through its budget.
        ending = None if self.gain is None else state_dict["ending"]
        self.ending = None if ending is None else tuple(ending)


def converged(errors: list[float], gain: float) -> bool:
    """Whether the second half of training gained less than ``gain`` dB on its second quarter.

    Args:
        errors: Mean squared errors of equally many batches each, in order.
        gain: In dB.
    """
    count = len(errors)
    if count < LEAST or count % 2:
        return False
    half = count // 2
    before, after = errors[half // 2 : half], errors[half:]
    ratio = (sum(before) / len(before)) / max(sum(after) / len(after), 1e-12)
    return 10 * math.log10(max(ratio, 1e-12)) < gain
