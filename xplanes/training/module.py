"""The LightningModule: one field, trained on rays."""

import math
from typing import Any

import torch
from lightning import LightningModule
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from xplanes.config import LossConfig, SamplerConfig, TrainerConfig
from xplanes.fields import XPlanes
from xplanes.rendering.renderer import Renderer
from xplanes.scenes.batches import Batch, step_generator
from xplanes.training.product import SparseProduct
from xplanes.training.regularisers import (
    add_time_smoothness_gradient,
    add_total_variation_gradient,
)

GRID_STREAM = 1_000_003
"""Random stream of the occupancy grid, equal on all ranks so that their grids stay equal."""

FRAME_STREAM = 1_000_037
"""Random stream of the frames at which L_r is taken."""

PATIENCE = 20
"""Steps in a row with a loss that is not finite after which training gives up."""


class TrainingError(RuntimeError):
    """Training cannot go on; the message says what was seen and what to change."""


class RadianceModule(LightningModule):
    """Trains a field on rays against the images' colours.

    Optimisation is manual, so that a step is what this file says and nothing else.

    Args:
        field: The field.
        renderer: Renders it; its grid is kept up to date here.
        loss: Weights of the regularisers.
        sampler: Upkeep of the grid.
        trainer: Budget and learning rates.
        seed: The run's seed.
        product: What the products of time planes are tied to (L_r); None leaves the term out.
        origin: What load_run needs to build this module again where its start was not random, kept
            in checkpoints: the model's settings and the frame, tensors and builtins.
    """

    def __init__(
        self,
        field: XPlanes,
        renderer: Renderer,
        *,
        loss: LossConfig,
        sampler: SamplerConfig,
        trainer: TrainerConfig,
        seed: int,
        product: SparseProduct | None = None,
        origin: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.field, self.renderer, self.grid = field, renderer, renderer.grid
        self.loss, self.sampler, self.options, self.seed = loss, sampler, trainer, seed
        self.product, self.origin = product, origin
        self.batches = 0
        self.clock = 0.0
        self.rays = min(trainer.rays_per_batch, 256)
        self.counts = dict.fromkeys(("rays", "candidates", "empty", "occluded", "samples"), 0)
        self.unusable = 0
        self.unusable_in_a_row = 0
        self.last: dict[str, float] = {}
        self.improved = False

    @property
    def progress(self) -> float:
        """Share of the budget that is spent: of steps or of the training clock, the larger."""
        share = self.global_step / self.options.max_steps
        if self.options.max_seconds is not None:
            share = max(share, self.clock / self.options.max_seconds)
        return min(1.0, share)

    @property
    def stride(self) -> int:
        """Steps that one sample stands for: the first training steps look at half the samples."""
        return 2 if self.global_step < self.sampler.coarse_steps else 1

    def configure_optimizers(self) -> torch.optim.Optimizer:
        groups: list[dict[str, Any]] = [
            {"params": [self.field.space], "lr": self.options.plane_lr, "name": "space"}
        ]
        if self.field.time is not None:
            groups.append({"params": [self.field.time], "lr": self.options.time_lr, "name": "time"})
        decoder = [p for p in self.field.decoder.parameters() if p.requires_grad]
        if decoder:
            groups.append({"params": decoder, "lr": self.options.decoder_lr, "name": "decoder"})
        for group in groups:
            group["peak_lr"] = group["lr"]
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        self._set_learning_rates()

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        rays = {name: value[: self.rays] for name, value in batch.items()}
        rendering = self.renderer.render(
            self.field,
            rays["origins"],
            rays["directions"],
            rays["times"],
            rays["background"],
            rays["jitter"],
            stride=self.stride,
        )
        loss = (rendering.colour - rays["target"]).square().mean()
        value = float(loss.detach())
        self.batches += 1
        # All ranks must skip a step together: one that waits for the others' gradients would hang.
        usable = self.trainer.strategy.reduce_boolean_decision(math.isfinite(value), all=True)
        if not usable:
            self._refuse(value, rendering.density)
            return
        self.unusable_in_a_row = 0
        self.manual_backward(loss / self.options.accumulate)
        self.grid.observe(rendering.samples.cells, rendering.density)
        self._count(rendering.samples, len(rays["times"]))
        self.last = {"loss": value, "psnr": -10 * math.log10(max(value, 1e-10))}
        if self.batches % self.options.accumulate == 0:
            self._update(optimizer)

    def _update(self, optimizer: LightningOptimizer) -> None:
        step = self.global_step
        if step % self.loss.every == 0:
            self._regularise()
        optimizer.step()
        optimizer.zero_grad()
        generator = step_generator(self.seed, step, GRID_STREAM)
        if step in self.sampler.sweep_at or (step and step % self.sampler.sweep_every == 0):
            self.grid.sweep(self.field, generator)
        elif step % self.sampler.update_every == 0:
            self.grid.update(self.field, self.sampler.update_cells, generator)

    def _regularise(self) -> None:
        every, field = self.loss.every, self.field
        if field.space.grad is None:
            return
        if weight := self.loss.total_variation * every:
            add_total_variation_gradient(field.space.grad, field.space, (1, 2), weight)
        if field.time is None or field.time.grad is None:
            return
        if weight:
            add_total_variation_gradient(field.time.grad, field.time, (2,), weight)
        if weight := self.loss.time_smoothness * every:
            add_time_smoothness_gradient(field.time.grad, field.time, weight)
        if weight := self.loss.time_magnitude * every:
            scale = 2 * weight / field.time.numel()
            field.time.grad.add_(field.time.detach(), alpha=scale)
        if self.product is not None:
            weight = self.loss.sparse_weight * every
            # The same frames on all ranks: their planes must stay equal.
            generator = step_generator(self.seed, self.global_step, FRAME_STREAM)
            self.product.add_gradient(field.time.grad, field.time, weight, generator)

    def _set_learning_rates(self) -> None:
        warm = min(1.0, (self.global_step + 1) / max(1, self.options.warmup_steps))
        final = self.options.final_lr
        factor = warm * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * self.progress)))
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        for group in optimizer.param_groups:
            group["lr"] = factor * group["peak_lr"]

    def _count(self, samples: Any, rays: int) -> None:
        for name in ("candidates", "empty", "occluded"):
            self.counts[name] += getattr(samples, name)
        self.counts["rays"] += rays
        self.counts["samples"] += len(samples)
        # Rays of the next batch: as many as keep its samples near the target.
        room = self.options.samples_per_batch * rays / max(1, len(samples))
        self.rays = max(64, min(self.options.rays_per_batch, int(room)))

    def _refuse(self, value: float, density: Tensor) -> None:
        self.unusable += 1
        self.unusable_in_a_row += 1
        if self.unusable_in_a_row < PATIENCE:
            return
        broken = [name for name, p in self.field.named_parameters() if not p.isfinite().all()]
        where = f"parameters {', '.join(broken)}" if broken else "the rendered rays alone"
        raise TrainingError(
            f"the loss was {value} for {PATIENCE} steps in a row, at step {self.global_step}; not "
            f"finite: {where}; largest density {float(density.max()) if len(density) else 0:.3g}. "
            f"Lower trainer.plane_lr={self.options.plane_lr} or trainer.decoder_lr="
            f"{self.options.decoder_lr}, or set trainer.precision=32."
        )

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["progress"] = {
            "batches": self.batches,
            "clock": self.clock,
            "rays": self.rays,
            "counts": dict(self.counts),
            "unusable": self.unusable,
        }
        if self.origin is not None:
            checkpoint["origin"] = self.origin

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        progress = checkpoint["progress"]
        self.batches, self.clock = progress["batches"], progress["clock"]
        self.rays, self.counts = progress["rays"], dict(progress["counts"])
        self.unusable = progress["unusable"]
