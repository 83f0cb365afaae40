"""TensorBoard scalars of training, on one step axis."""

from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.training.module import RadianceModule
from xplanes.training.regularisers import time_smoothness, total_variation


class Scalars(Callback):
    """Logs loss, rates, grid and regularisers every so many steps.

    Args:
        every: Steps between entries.
    """

    def __init__(self, every: int) -> None:
        self.every = every
        self._seen = (0.0, 0, 0)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, RadianceModule)
        self._seen = self._state(pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, RadianceModule)
        step = trainer.global_step
        if step % self.every or trainer.logger is None or "loss" not in pl_module.last:
            return
        now = self._state(pl_module)
        seconds, rays, samples = (a - b for a, b in zip(now, self._seen, strict=True))
        if not rays:
            return
        self._seen = now
        trainer.logger.log_metrics(
            {
                "train/loss": pl_module.last["loss"],
                "train/psnr_batch": pl_module.last["psnr"],
                "time/rays_per_s": rays / max(seconds, 1e-9),
                "sampler/samples_per_ray": samples / rays,
                "sampler/occupied": pl_module.grid.occupied_fraction,
                "train/steps_skipped": pl_module.unusable,
                **self._rates(pl_module),
                **self._regularisers(pl_module),
            },
            step,
        )

    @staticmethod
    def _state(module: RadianceModule) -> tuple[float, int, int]:
        return module.clock, module.counts["rays"], module.counts["samples"]

    @staticmethod
    def _rates(module: RadianceModule) -> dict[str, float]:
        optimizer: Any = module.optimizers()
        return {f"lr/{group['name']}": group["lr"] for group in optimizer.param_groups}

    @staticmethod
    @torch.no_grad()
    def _regularisers(module: RadianceModule) -> dict[str, float]:
        field = module.field
        values = {"reg/total_variation": float(total_variation(field.space, (1, 2)))}
        if field.time is not None:
            values["reg/time_smoothness"] = float(time_smoothness(field.time))
            values["reg/time_magnitude"] = float(field.time.square().mean())
            if module.product is not None:
                values["reg/sparse_product"] = module.product.value(field.time)
        return values
