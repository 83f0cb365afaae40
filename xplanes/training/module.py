"""The LightningModule: one field, trained on rays."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from lightning import LightningModule
from lightning.pytorch.core.optimizer import LightningOptimizer

from xplanes.config import ConfigError, TrainerConfig
from xplanes.rendering.base import RayRenderer, Rendering
from xplanes.scenes.batches import Batch
from xplanes.training.health import all_usable, not_finite, unusable_gradients
from xplanes.training.methods.base import Method
from xplanes.training.sampling.base import Moment, Sampling

PATIENCE = 20
"""Steps in a row with a loss or gradient that is not finite after which training gives up."""

COUNTS = ("rays", "candidates", "empty", "occluded", "samples", "passed")
"""What a run counts: rays, samples in their box, those dropped as empty or occluded, those left,
and those whose gradients reached the field."""


class TrainingError(RuntimeError):
    """Training cannot go on; the message says what was seen and what to change."""


class RadianceModule(LightningModule):
    """Trains a field on rays against the images' colours.

    Optimisation is manual, so that a step is what this file says and nothing else.

    Args:
        method: The field with its losses and learning rates.
        sampling: Renders the rays of a step.
        trainer: Budget.
        seed: The run's seed.
        origin: What load_run needs to build this module again where its start was not random, kept
            in checkpoints: the model's settings and the frame, tensors and builtins.
    """

    def __init__(
        self,
        method: Method,
        sampling: Sampling,
        *,
        trainer: TrainerConfig,
        seed: int,
        origin: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.field = method.field
        for name, part in sampling.parts.items():
            self.add_module(name, part)
        self.method, self.sampling = method, sampling
        self.options, self.seed, self.origin = trainer, seed, origin
        self.batches = 0
        self.clock = 0.0
        self.threads = torch.get_num_threads()
        self.rays = sampling.first_rays(trainer.rays_per_batch)
        self.counts = dict.fromkeys(COUNTS, 0)
        self.unusable = 0
        self.unusable_in_a_row = 0
        self.last: dict[str, float] = {}
        self.improved = False
        self._peaks: list[float] = []
        self.ending: tuple[int, float, int] | None = None
        """Step and progress at which training was told to end early, and the step of the end."""

    @property
    def spent(self) -> float:
        """Share of the budget that is spent: of steps or of the training clock, the larger."""
        share = self.global_step / self.options.max_steps
        if self.options.max_seconds is not None:
            share = max(share, self.clock / self.options.max_seconds)
        return min(1.0, share)

    @property
    def progress(self) -> float:
        """Share of training that is done: of the budget, or of what is left of it."""
        if self.ending is None:
            return self.spent
        begin, done, end = self.ending
        share = (self.global_step - begin) / (end - begin)
        return min(1.0, max(self.spent, done + (1 - done) * share))

    @property
    def between_updates(self) -> bool:
        """Whether no gradients of batches wait for others (``trainer.accumulate``)."""
        return self.batches % self.options.accumulate == 0

    def end_after(self, steps: int) -> None:
        """Let training run out over ``steps``, or with its budget if that comes first."""
        self.ending = (self.global_step, self.spent, self.global_step + steps)

    @property
    def renderer(self) -> RayRenderer:
        """Renders images of the field."""
        return self.sampling.renderer

    @property
    def renderer_now(self) -> RayRenderer:
        """The same for the field as far as it is trained."""
        return self.sampling.renderer_at(self.global_step)

    @property
    def moment(self) -> Moment:
        """Where training stands."""
        return Moment(self.seed, self.global_step, self.batches, self.global_rank)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        groups = [*self.method.groups(), *self.sampling.groups()]
        # Not part of the optimiser, whose state a resumed run takes over: settings may change.
        self._peaks = [group["lr"] for group in groups]
        return self.method.optimizer(groups)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        self._set_learning_rates()

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        moment = self.moment
        self.method.before_step(moment, optimizer.optimizer)
        rays = {name: value[: self.rays] for name, value in batch.items()}
        rendering = self.sampling.render(self.field, rays, moment)
        loss, error = self.method.loss(rendering, rays, moment)
        if (term := self.sampling.loss(rendering)) is not None:
            loss = loss + term
        value = float(loss.detach())
        self.batches += 1
        # All ranks must skip a step together: one that waits for the others' gradients would hang.
        usable = self.trainer.strategy.reduce_boolean_decision(math.isfinite(value), all=True)
        if not usable:
            optimizer.zero_grad()  # Of the batches before it, for the same update.
            self._refuse(f"the loss was {value}", not_finite(self.named_parameters()), rendering)
            return
        self.manual_backward(loss / self.options.accumulate)
        self.counts["passed"] += self.sampling.pass_on(rendering, moment)
        self.sampling.observe(rendering)
        self._count(rendering.samples, len(rays["times"]))
        error = value if error is loss else float(error.detach())
        self.last = {"loss": value, "psnr": -10 * math.log10(max(error, 1e-10))}
        if self.between_updates:
            self._update(optimizer, moment, rendering)

    def _update(self, optimizer: LightningOptimizer, moment: Moment, rendering: Rendering) -> None:
        self.method.regularise(moment)
        self.sampling.regularise()
        usable = all_usable(self.parameters())
        if not self.trainer.strategy.reduce_boolean_decision(usable, all=True):
            broken = [f"gradient of {name}" for name in unusable_gradients(self.named_parameters())]
            optimizer.zero_grad()
            self._refuse("a gradient was infinite, NaN or too large to square", broken, rendering)
            return
        self.unusable_in_a_row = 0
        optimizer.step()
        optimizer.zero_grad()
        self.sampling.keep_up(self.field, moment)

    def _set_learning_rates(self) -> None:
        factor = self.method.rate(self.global_step, self.progress)
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        for group, peak in zip(optimizer.param_groups, self._peaks, strict=True):
            group["lr"] = factor * peak

    def _count(self, samples: Any, rays: int) -> None:
        for name in ("candidates", "empty", "occluded"):
            self.counts[name] += getattr(samples, name)
        self.counts["rays"] += rays
        self.counts["samples"] += len(samples)
        # Rays of the next batch: as many as keep its samples near the target.
        room = self.options.samples_per_batch * rays / max(1, len(samples))
        self.rays = max(64, min(self.options.rays_per_batch, int(room)))

    def _refuse(self, what: str, broken: list[str], rendering: Rendering) -> None:
        """Leave a step out, and give up after `PATIENCE` of them in a row."""
        self.unusable += 1
        self.unusable_in_a_row += 1
        if self.unusable_in_a_row < PATIENCE:
            return
        density = rendering.density
        raise TrainingError(
            f"{what} for {PATIENCE} steps in a row, at step {self.global_step}; not finite: "
            f"{', '.join(broken) or 'the rendered rays alone'}; largest density "
            f"{float(density.max()) if len(density) else 0:.3g}. {self._way_out}"
        )

    def require_finite(self) -> None:
        """Refuse to go on with, or to keep, parameters that are not finite.

        Raises:
            TrainingError: Naming them.
        """
        if broken := not_finite(self.named_parameters()):
            raise TrainingError(
                f"not finite at step {self.global_step}: {', '.join(broken)}. No checkpoint was "
                f"written over the last sound one. {self._way_out}"
            )

    @property
    def _way_out(self) -> str:
        if self.global_step == 0:
            largest = max(float(p.detach().abs().max()) for p in self.field.parameters())
            return (
                f"No step was done yet, so the start is to blame, whose largest value is "
                f"{largest:.3g}: set lrm=none, or make the start anew"
            )
        precision = "" if self.field.precision == "32" else ", or set trainer.precision=32"
        return f"{self.method.advice}{precision}; resume= goes on from the last checkpoint"

    def _require_frame(self, trained: dict[str, Any] | None) -> None:
        """Refuse planes that were trained in another frame than the start lies in now."""
        if trained is None or self.origin is None:
            return
        for name, now in self.origin["frame"].items():
            before = torch.as_tensor(trained["frame"][name])
            if not torch.allclose(before, torch.as_tensor(now), rtol=1e-4, atol=1e-5):
                raise TrainingError(
                    f"the start was made anew, and its frame is not the checkpoint's ({name} "
                    f"{before.tolist()}, now {torch.as_tensor(now).tolist()}): what "
                    "preparation.cache kept is gone. Bring it back, or train anew in another folder"
                )

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """As torch does, with words for a state of other settings.

        Raises:
            ConfigError: If it does not fit.
        """
        try:
            return super().load_state_dict(state_dict, strict=strict, assign=assign)
        except RuntimeError as error:
            problem = str(error).splitlines()[-1].strip().rstrip(".")
            raise ConfigError(
                f"the checkpoint does not fit these settings ({problem}): go on with those that "
                "the run began with, or train anew in another folder"
            ) from error

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["progress"] = {
            "batches": self.batches,
            "clock": self.clock,
            "rays": self.rays,
            "counts": dict(self.counts),
            "unusable": self.unusable,
            "ending": self.ending,
        }
        if self.origin is not None:
            checkpoint["origin"] = self.origin

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self._require_frame(checkpoint.get("origin"))
        progress = checkpoint["progress"]
        self.batches, self.clock = progress["batches"], progress["clock"]
        self.rays, self.counts = progress["rays"], dict(progress["counts"])
        self.unusable = progress["unusable"]
        # A run that goes on without the rule trains through its budget.
        self.ending = None if self.options.plateau is None else progress["ending"]
