"""Training that has converged stops."""

import math
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.training.module import RadianceModule

BLOCK = 50
"""Batches whose mean error is remembered."""

LEAST = 20
"""Blocks before which nothing is judged."""

COOLING = 0.25
"""Steps of falling learning rates at the end, as a share of those before."""


class PlateauStop(Callback):
    """Ends training once the last doubling of its batches has gained little on their own rays.

    No scored view is looked at. The learning rates then fall over a last quarter, because an end at
    full rates would be worth less than training had reached.

    Args:
        gain: PSNR in dB below which a doubling counts as little.
    """

    def __init__(self, gain: float) -> None:
        self.gain = gain
        self._errors: list[float] = []
        self._block: list[float] = []

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        if pl_module.ending is not None and pl_module.progress >= 1:
            trainer.should_stop = True

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, RadianceModule)
        if pl_module.ending is not None:
            trainer.should_stop |= pl_module.progress >= 1
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
            pl_module.end_after(max(1, round(COOLING * trainer.global_step)))

    def state_dict(self) -> dict[str, Any]:
        return {"errors": list(self._errors), "block": list(self._block)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._errors, self._block = list(state_dict["errors"]), list(state_dict["block"])


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
