"""TensorBoard scalars of training, on one step axis."""

from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.training.module import RadianceModule


class Scalars(Callback):
    """Logs loss, rates, sampler and regularisers every so many steps.

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
        if step % self.every or trainer.logger is None or not pl_module.between_updates:
            return
        if "loss" not in pl_module.last:
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
                "train/steps_skipped": pl_module.unusable,
                **self._rates(pl_module),
                **pl_module.sampling.scalars(),
                **pl_module.method.scalars(),
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
