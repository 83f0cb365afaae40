"""The LightningModule that trains a small LRM on points and rays of procedural objects."""

import copy
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from xplanes.errors import ConfigError
from xplanes.files import replacing
from xplanes.lrm.canonical import canonical_vector
from xplanes.lrm.openlrm import OpenLRM
from xplanes.streams import Stream, step_generator
from xplanes.synthetic.pretraining.losses import (
    colour_loss,
    composite,
    occupancy_loss,
    ray_samples,
    triplane_logits,
)
from xplanes.synthetic.pretraining.pool import PretrainingBatch
from xplanes.synthetic.pretraining.quick import QuickLook
from xplanes.synthetic.pretraining.settings import BatchSettings, ScheduleSettings

PATIENCE = 20
"""Consecutive steps with a non-finite loss after which training stops."""


class PretrainingModule(LightningModule):
    """Trains a model on procedural objects with known occupancy and colour.

    Optimisation is manual: Muon for the blocks' matrices, AdamW for all other parameters. The
    budget is a number of steps or seconds of training, whichever is reached first.

    Args:
        model: The model, initialised by `init_model`.
        batch: Numbers of objects, points and rays per step.
        schedule: Budget, optimisers and loss weights.
        seed: The run's seed.
        bf16: Whether blocks and decoder compute in bfloat16.
    """

    def __init__(
        self,
        model: OpenLRM,
        batch: BatchSettings,
        schedule: ScheduleSettings,
        seed: int,
        *,
        bf16: bool,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.model, self.average = model, copy.deepcopy(model).requires_grad_(False)
        self.batch, self.schedule, self.seed, self.bf16 = batch, schedule, seed, bf16
        self.camera = canonical_vector(model.view)
        # Steps done, seconds of training, and consecutive steps that were skipped.
        self.steps, self.clock, self.unusable = 0, 0.0, 0
        self.last: dict[str, float | Tensor] = {}

    @property
    def progress(self) -> float:
        """Share of the budget that is used, in [0, 1]: of steps or seconds, whichever is larger."""
        share = self.steps / self.schedule.max_steps
        if self.schedule.max_seconds is not None:
            share = max(share, self.clock / self.schedule.max_seconds)
        return min(1.0, share)

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        matrices, others = [], []
        for name, parameter in self.model.named_parameters():
            inner = "blocks." in name and parameter.ndim == 2 and "modulation" not in name
            (matrices if inner else others).append(parameter)
        options = self.schedule
        return [
            torch.optim.Muon(
                matrices,
                lr=options.muon_lr,
                weight_decay=options.weight_decay,
                adjust_lr_fn="match_rms_adamw",
            ),
            torch.optim.AdamW(
                others,
                lr=options.adam_lr,
                betas=(0.9, 0.98),
                weight_decay=options.weight_decay,
                fused=True,
            ),
        ]

    def training_step(self, batch: PretrainingBatch, batch_idx: int) -> None:
        optimizers = self.optimizers()
        assert isinstance(optimizers, list)
        peaks = self.schedule.muon_lr, self.schedule.adam_lr
        for optimizer, peak in zip(optimizers, peaks, strict=True):
            for group in optimizer.param_groups:
                group["lr"] = self.rate * peak
        loss, parts = self.losses(batch)
        self.manual_backward(loss)
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.schedule.clip)
        usable = math.isfinite(float(loss.detach()) + float(norm))
        for optimizer in optimizers:
            if usable:
                optimizer.step()
            optimizer.zero_grad()
        if not usable:
            self.unusable += 1
            if self.unusable < PATIENCE:
                return
            raise ConfigError(
                f"the loss was {float(loss.detach())} and its gradient's norm {float(norm)} for "
                f"{PATIENCE} steps in a row, at step {self.steps}: lower schedule.muon_lr="
                f"{self.schedule.muon_lr} and schedule.adam_lr={self.schedule.adam_lr}, and begin "
                "again"
            )
        self.unusable = 0
        self.steps += 1
        keep = min(self.schedule.average, (1 + self.steps) / (10 + self.steps))
        get_ema_multi_avg_fn(keep)([*self.average.parameters()], [*self.model.parameters()], 0)
        self.last = {**parts, "gradient": norm, "rate": self.rate}

    def losses(self, batch: PretrainingBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of a batch, and its terms by name."""
        options, decoder = self.schedule, self.model.decoder
        with torch.autocast(batch.images.device.type, torch.bfloat16, enabled=self.bf16):
            camera = self.camera.to(batch.images).expand(len(batch.images), -1)
            planes = self.model.triplanes(batch.images, camera).float()
            count = batch.points.shape[1]
            points = torch.cat([batch.points, batch.surface], dim=1)
            logits = triplane_logits(planes, decoder, points).float()
        occupancy = occupancy_loss(logits[:, :count], batch.inside)
        colour = colour_loss(logits[:, count:], batch.colours, decoder.colour_margin)
        loss = occupancy + options.colour_weight * colour
        parts = {"occupancy": occupancy.detach(), "colour": colour.detach()}
        if self.batch.rays and self.progress >= options.render_from:
            rendered, seen = self._rendered(planes, batch)
            error = (rendered - batch.ray_colours).square().mean()
            opacity = (seen - batch.ray_alpha).square().mean()
            loss = loss + options.render_weight * (error + 0.3 * opacity)
            parts |= {"render": error.detach(), "opacity": opacity.detach()}
        return loss, parts

    def _rendered(self, planes: Tensor, batch: PretrainingBatch) -> tuple[Tensor, Tensor]:
        shape = (*batch.ray_hits.shape, self.batch.samples)
        random = step_generator(self.seed, self.steps, Stream.PRETRAINING, planes.device)
        jitter = torch.rand(shape, generator=random, device=planes.device)
        rays = (batch.origins, batch.directions, batch.ray_hits)
        distances, lengths = ray_samples(*rays, half_side=self.model.half_side, jitter=jitter)
        points = batch.origins[:, :, None] + distances[..., None] * batch.directions[:, :, None]
        with torch.autocast(planes.device.type, torch.bfloat16, enabled=self.bf16):
            logits = triplane_logits(planes, self.model.decoder, points.flatten(1, 2))
        colours, density = self.model.decoder.activate(logits.flatten(0, 1))
        return composite(density.unflatten(0, shape), colours.unflatten(0, shape), lengths)

    @property
    def rate(self) -> float:
        """Learning rate schedule in [0, 1]: linear warm-up, constant, linear decay to zero."""
        warm = min(1.0, (self.steps + 1) / max(1, self.schedule.warmup_steps))
        left = (1 - self.progress) / max(self.schedule.decay_share, 1e-9)
        return warm * min(1.0, left)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["progress"] = {"steps": self.steps, "clock": self.clock}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        progress = checkpoint["progress"]
        self.steps, self.clock = progress["steps"], progress["clock"]


LONGEST = 10.0
"""Upper bound in seconds on the time counted for one step, in case the process was suspended."""


class Upkeep(Callback):
    """Training clock, logging, scores and checkpoints.

    Args:
        path: The checkpoint, written atomically.
        schedule: Intervals of logging, scores and checkpoints.
        look: Computes scores on held-out objects.
        announce: Receives progress messages.
    """

    def __init__(
        self,
        path: Path,
        schedule: ScheduleSettings,
        look: QuickLook,
        announce: Callable[[str], None],
    ) -> None:
        self.path, self.schedule, self.look, self.announce = path, schedule, look, announce
        self.started = 0.0
        self.since = {"checkpoint": 0.0, "score": 0.0}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, PretrainingModule)
        self.since = dict.fromkeys(self.since, pl_module.clock)
        self.started = time.perf_counter()
        trainer.should_stop = pl_module.progress >= 1

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        assert isinstance(pl_module, PretrainingModule)
        pl_module.clock += min(time.perf_counter() - self.started, LONGEST)
        done = pl_module.progress >= 1
        if pl_module.steps % self.schedule.log_every == 0 or done:
            self._log(trainer, pl_module, pl_module.last)
        scores = done or self._due("score", pl_module.clock, self.schedule.score_seconds)
        kept = self._due("checkpoint", pl_module.clock, self.schedule.checkpoint_seconds)
        if done or scores or kept:
            self.save(trainer)  # First: a score that fails must not lose the training.
        if scores:
            self._log(trainer, pl_module, self.look.scores(pl_module.average))
        trainer.should_stop = done
        self.started = time.perf_counter()

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        if isinstance(exception, KeyboardInterrupt):
            self.save(trainer)
            self.announce(f"stopped; run the same command to resume from {self.path}")

    def save(self, trainer: Trainer) -> None:
        """Write the checkpoint."""
        with replacing(self.path) as temporary:
            trainer.save_checkpoint(temporary)

    def _due(self, what: str, clock: float, every: float) -> bool:
        if clock - self.since[what] < every:
            return False
        self.since[what] = clock
        return True

    def _log(
        self, trainer: Trainer, module: PretrainingModule, found: Mapping[str, float | Tensor]
    ) -> None:
        logger, values = trainer.logger, {name: float(value) for name, value in found.items()}
        assert isinstance(logger, TensorBoardLogger)
        logger.log_metrics({**values, "seconds": module.clock}, step=module.steps)
        shown = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        self.announce(f"step {module.steps}  {module.clock:.0f} s  {shown}")
