"""Logging of training steps."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from lightning import Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from xplanes.streams import TrainingState
from xplanes.training.clock import training_seconds

if TYPE_CHECKING:
    from xplanes.training.module import RadianceModule


def logs_now(trainer: Trainer) -> bool:
    """Whether the last batch is to be logged: it ends a step that Lightning logs."""
    every, loop = trainer.log_every_n_steps, trainer.fit_loop.epoch_loop  # type: ignore[attr-defined]
    # Lightning's own count: it begins at 0 even if the module was loaded, and the last batches of
    # an epoch may make a step of fewer batches.
    step = loop._batches_that_stepped + 1
    ends = not loop._should_accumulate()
    return bool(every and not step % every and ends and trainer.loggers)


def forget_later(trainer: Trainer, step: int) -> None:
    """Make TensorBoard drop points after a step, left by an interrupted run."""
    for log in trainer.loggers:
        if isinstance(log, TensorBoardLogger):
            from tensorboard.compat.proto.event_pb2 import (  # pyright: ignore
                Event,  # pyright: ignore[reportAttributeAccessIssue]
                SessionLog,  # pyright: ignore[reportAttributeAccessIssue]
            )

            begins = Event(session_log=SessionLog(status=SessionLog.START))
            log.experiment.file_writer.add_event(begins, step + 1)  # pyright: ignore[reportAttributeAccessIssue]


def log_terms(module: "RadianceModule", terms: Mapping[str, Tensor], state: TrainingState) -> None:
    """Log every term of the loss, weighted, if this step is to be logged."""
    if not logs_now(module.trainer):
        return
    values = {name: float(term.detach()) for name, term in terms.items()}
    values |= module.model.regularisers(state)
    values |= module.sampler.regularisers(module.field, state)
    entries = {f"train/{name}": value for name, value in values.items()}
    entries |= {"train/loss": sum(values.values()), "train/psnr": module.tally.last["psnr"]}
    entries |= {"train/steps_skipped": float(module.tally.skipped), "step": float(state.step)}
    for group in module.trainer.optimizers[0].param_groups:
        entries[f"lr/{group['name']}"] = group["lr"]
    counts = module.tally.counts
    entries["sampler/samples_per_ray"] = counts["samples"] / max(1, counts["rays"])
    if seconds := training_seconds(module.trainer):
        entries["time/rays_per_s"] = counts["rays"] / seconds
        entries["time/train_s"] = seconds
    module.log_dict(entries | module.sampler.scalars() | module.model.scalars(), batch_size=1)
