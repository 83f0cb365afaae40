"""Lightning's Trainer with a time budget, warm-up, and short training runs for the preparation."""

import copy
import logging
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
from lightning.fabric.utilities import move_data_to_device
from lightning.pytorch.callbacks import Callback, ProgressBar, StochasticWeightAveraging
from lightning.pytorch.plugins.io import CheckpointIO

from xplanes.backend import cpu_loops, find_device, synchronize
from xplanes.errors import ConfigError
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.warming import warming_up
from xplanes.scenes.batches import Batch
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.views import Scene
from xplanes.settings import Count, Positive, Steps
from xplanes.training.building import loss_terms, require_float32, require_new_rays
from xplanes.training.checkpoints import AtomicCheckpointIO, Checkpoints, find_resumable
from xplanes.training.clock import Interrupt, TrainingClock, find_callback
from xplanes.training.collapse import CollapseWatch
from xplanes.training.evaluation import Evaluation
from xplanes.training.module import RadianceModule
from xplanes.training.scores import ViewScore

WHEN = ("val_check_interval", "check_val_every_n_epoch", "num_sanity_val_steps")
"""Arguments of Lightning's Trainer that say when to validate."""


class Trainer(lightning.Trainer):
    """Lightning's Trainer with a limit in seconds and a check of the devices.

    Args:
        max_steps: Steps after which training ends; -1 for no limit.
        max_seconds: Seconds of the training clock after which training ends; None for no limit.
        accelerator: auto (CUDA if there is a GPU, otherwise the CPU), cpu or gpu.
        devices: Number of processes; they split the rays.
        deterministic: Bit-identical runs; CPU only, with a budget in steps.
        tf32: On GPUs, multiply float32 matrices in TF32 (10-bit mantissa), which is faster.
        log_every_n_steps: Steps between log entries; 0 for none.
        accumulate_grad_batches: Batches of rays, or views, per optimiser step.
        callbacks: Callbacks; a `TrainingClock` and an `Interrupt` are added.
        plugins: Lightning's plugins; checkpoints are atomic unless a plugin writes them.
        **others: As for Lightning's Trainer.

    Raises:
        ConfigError: If the machine lacks the requested devices, or an argument is not supported.
    """

    def __init__(
        self,
        *,
        max_steps: Count | Literal[-1] = -1,
        max_seconds: Positive | None = None,
        accelerator: str = "auto",
        devices: Count = 1,
        deterministic: bool | Literal["warn"] = False,
        tf32: bool = False,
        log_every_n_steps: Steps | None = None,
        accumulate_grad_batches: Count = 1,
        callbacks: Sequence[Callback] = (),
        plugins: Any = None,
        **others: Any,
    ) -> None:
        if max_seconds is not None and not max_seconds > 0:
            raise ConfigError(f"max_seconds={max_seconds}: must be above 0, or null for no limit")
        require_new_rays(others.get("overfit_batches", 0))
        require_float32(str(others.get("precision") or "32-true"))
        for callback in callbacks:
            if isinstance(callback, StochasticWeightAveraging):
                raise ConfigError(
                    f"callbacks: {type(callback).__name__}: the model's schedules would override "
                    "its learning rates; use lightning.pytorch.callbacks.EMAWeightAveraging"
                )
            if isinstance(callback, Evaluation) and (name := next(filter(others.get, WHEN), None)):
                raise ConfigError(
                    f"{name}={others[name]}: Evaluation chooses when to validate; set "
                    "callbacks.evaluation.at, shares of the budget"
                )
        device = find_device(accelerator)
        if device.type == "cuda":
            if deterministic:
                raise ConfigError(
                    "deterministic=true: the order of sums on a GPU varies; set "
                    "trainer.accelerator=cpu, or leave it out"
                )
            if isinstance(devices, int) and devices > (found := torch.cuda.device_count()):
                raise ConfigError(
                    f"devices={devices}: {found} GPUs found; set trainer.devices={found}, or "
                    "trainer.accelerator=cpu"
                )
        own = list(plugins) if isinstance(plugins, list | tuple) else [plugins] * bool(plugins)
        if not any(isinstance(plugin, CheckpointIO) for plugin in own):
            own.append(AtomicCheckpointIO())
        bar = others.get("enable_progress_bar", True)
        used = [each for each in callbacks if bar or not isinstance(each, ProgressBar)]
        # These settings affect the whole process, including the LRM.
        torch.set_float32_matmul_precision("high" if tf32 else "highest")
        torch.backends.cudnn.allow_tf32 = tf32
        # Only `Evaluation` triggers validation.
        usual = {"check_val_every_n_epoch": None, "val_check_interval": sys.maxsize}
        # By default Lightning ends after 1000 epochs if no number of steps is given.
        usual |= {"num_sanity_val_steps": 0, "max_epochs": -1}
        self.interrupt = Interrupt()
        quiet_lightning()
        super().__init__(
            accelerator="gpu" if device.type == "cuda" else "cpu",
            devices=devices,
            deterministic=deterministic,
            max_steps=max_steps,
            log_every_n_steps=log_every_n_steps,
            accumulate_grad_batches=accumulate_grad_batches,
            callbacks=[TrainingClock(max_seconds), *used, self.interrupt],
            plugins=own,
            **(usual | others),
        )

    def train(
        self, module: RadianceModule, data: SceneDataModule, checkpoint: Path | None = None
    ) -> None:
        """Fit a module whose field is built, or continue from a checkpoint.

        Raises:
            KeyboardInterrupt: If the user stopped it; the state is saved.
            TrainingError: If losses, gradients or parameters are no longer finite.
        """
        device = self.strategy.root_device
        with self.interrupt.exits():
            try:
                self.fit(module, data, ckpt_path=None if checkpoint is None else str(checkpoint))
            except RuntimeError as error:
                if "Early stopping conditioned on" not in str(error):
                    raise
                raise ConfigError(f"callbacks: EarlyStopping: {error}") from error
            evaluation = find_callback(self, Evaluation)
            if evaluation is not None and evaluation.step != self.global_step:
                # Lightning skips validation if no steps are left, even if the last is unscored.
                self.validate(module, data, verbose=False)
        module.to(device)  # Lightning moves it back to the CPU after training.

    def final_scores(self, module: RadianceModule, data: SceneDataModule) -> list[ViewScore]:
        """Scores of all views of the test split, from the last evaluation if it covered them."""
        views = data.scene.splits[data.test_split]
        evaluation = find_callback(self, Evaluation)
        same = data.test_split == (data.validation_split or data.test_split)
        scored = evaluation is not None and evaluation.step == self.global_step
        if not (same and scored and len(module.scores) == len(views)):
            with self.interrupt.exits():
                self.test(module, data, verbose=False)
        by_file = {score.file: score for score in module.scores}
        return [by_file[file] for file in views.files if file in by_file]


def fit_quietly(
    module: RadianceModule,
    scene: Scene,
    folder: Path,
    *,
    device: torch.device,
    max_steps: int,
    max_seconds: float | None,
) -> None:
    """Train a built field on a scene, or continue from its last checkpoint in a folder.

    Args:
        module: The module; changed in place.
        scene: The scene.
        folder: Folder of the checkpoints.
        device: Training device.
        max_steps: Maximum number of steps.
        max_seconds: Maximum training time in seconds; None for no limit.
    """
    trainer = Trainer(
        accelerator="gpu" if device.type == "cuda" else "cpu",
        max_steps=max_steps,
        max_seconds=max_seconds,
        # Affects the whole process: keep the setting of the run's own Trainer.
        deterministic=device.type == "cpu" and torch.are_deterministic_algorithms_enabled(),
        tf32=torch.backends.cudnn.allow_tf32,
        callbacks=[CollapseWatch(), Checkpoints(every=250)],
        default_root_dir=folder,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
    )
    data = SceneDataModule.of(scene, seed=module.method.seed)
    data.holds_out = False
    warm_up_loops(module, data, device)
    trainer.train(module, data, find_resumable(folder / "checkpoints"))


def warm_up_loops(module: RadianceModule, data: SceneDataModule, device: torch.device) -> None:
    """Run all loops once on a few rays, so that the training clock does not count compilation."""
    # The kernels' trial needs the training device; Lightning would move the module only later.
    module.to(device)
    on_cpu = device.type == "cpu"
    if on_cpu and not cpu_loops(next(module.field.parameters())):
        return
    rays = move_data_to_device(data.batches_for(module, 0).draw(0, 8), device)
    with warming_up():
        rehearse(module, rays)
        synchronize(device)
        if on_cpu and isinstance(module.renderer, RayRenderer):
            ends = rays["origins"], rays["directions"]
            module.renderer.image(module.field, *ends, 0.0, data.scene.background)


def rehearse(module: RadianceModule, rays: Batch) -> None:
    """Run a complete step on a copy of the field, so that its loops or kernels are compiled."""
    site, state = module.site, module.state
    copied = copy.deepcopy(module.parts, {id(site): site})  # The site holds all images.
    model, sampler = copied.model, copied.sampler
    optimizer = model.optimizer([*model.groups(), *sampler.groups()])
    rendering = sampler.render(model.field, rays, state)
    terms = loss_terms(copied, module.method.losses, rendering, rays, state)
    torch.stack(list(terms.values())).sum().backward()
    sampler.observe(rendering)
    model.regularise(state)
    sampler.regularise(model.field, state)
    optimizer.step()
    sampler.update(model.field, state)


def quiet_lightning() -> None:
    """Hide messages of Lightning on which users cannot act."""
    for name in (
        "utilities.rank_zero",
        "trainer.connectors.checkpoint_connector",
        "accelerators.cuda",
    ):
        logging.getLogger(f"lightning.pytorch.{name}").setLevel(logging.WARNING)
    for message in (
        ".*does not have many workers.*",
        ".*treespec.*",
        ".*LeafSpec.*",
        ".*litlogger.*",
        ".*`IterableDataset` has `__len__` defined.*",
        ".*Checkpoint directory .* exists and is not empty.*",
        ".*defined a `validation_step` but.*",
    ):
        warnings.filterwarnings("ignore", message=message)
