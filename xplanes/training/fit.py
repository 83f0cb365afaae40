"""Lightning's Trainer with a time budget, warm-up, and short training runs for the preparation."""

import copy
import logging
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import lightning
import torch
from lightning.fabric.utilities import move_data_to_device
from lightning.pytorch.callbacks import Callback, ProgressBar, StochasticWeightAveraging
from lightning.pytorch.plugins.io import CheckpointIO

from xplanes.backend import cpu_loops, find_device, synchronize
from xplanes.errors import ConfigError
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.behind import background_colour
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


class Estimate(NamedTuple):
    """Expected durations, measured before the first step.

    Attributes:
        step: Seconds per step, once the number of rays fits the batch's budget of samples.
        first_ray: Seconds per ray of an image of the untrained field.
        later_ray: Seconds per ray once surfaces are opaque and empty space is pruned.
        pruned_at: First step at which empty space is pruned.
        early: Least share of the extra time of an untrained field that remains until that step.
        passing: Share of it that remains after that step.
    """

    step: float
    first_ray: float
    later_ray: float
    pruned_at: int
    early: float
    passing: float

    def ray(self, step: float) -> float:
        """Seconds per ray of an image after a number of steps."""
        pruned = step >= self.pruned_at
        share = self.passing if pruned else max(0.5 ** (step / HALF_OPAQUE), self.early)
        return self.later_ray + (self.first_ray - self.later_ray) * share


WHOLE_STEP = 1.45
"""Ratio of a step's time to that of rendering its rays and backpropagating.

The rest is drawing rays, the optimiser, regularisers, the occupancy grid and Lightning's loop: a
third of the training of the demo scene (docs/results/records/time.json).
"""

HALF_OPAQUE = 85
"""Steps after which the extra time per image of an untrained field halves, as surfaces form.

Measured on a capture with surroundings, in which no cell is pruned in the first 800 steps.
"""

PASSING, PASSING_PRUNED = 0.25, 0.15
"""Assumed shares of rays that meet no surface, and have samples: until empty space is pruned, and
afterwards in scenes with surroundings.

Measured until then: 0.47 on a capture in front of a black backdrop, 0 on one inside a room;
afterwards: 0.13 for a scene on a table, 0 inside the room.
"""

RIG_PASSING = 0.1
"""Added to both in rigs.

Measured on five rigs, until then: 0.5; afterwards: from 0.15 inside a room to 0.4 in the open.
"""

OPAQUE = 1000.0
"""Factor on the density that makes an untrained field about as opaque as a trained one."""

BEHIND = 0.5
"""Assumed share of an image's rays that reach the background."""


def estimate(module: RadianceModule, data: SceneDataModule) -> Estimate:
    """Time a step, and some rays of a test view.

    In a trained field surfaces are opaque, so rays end after a few samples. A copy of the field
    with a much higher density approximates it.
    """
    frame, field, renderer = module.frame, module.field, module.renderer
    assert frame is not None
    device = next(field.parameters()).device
    batches = data.batches_for(module, 0)
    rays = move_data_to_device(batches.draw(0, module.rays), device)
    if module.rays:  # Batches soon have as many rays as the budget of samples allows.
        with torch.no_grad():
            samples = module.sampler.render(field, rays, module.state).samples
        count = module.ray_settings.fitting(module.rays, int(samples.count))
        rays = move_data_to_device(batches.draw(0, count), device)
    views = data.scene.splits[data.test_split]
    camera, seen_at = views.camera(0), (float(views.times[0]), data.scene.background.to(device))
    pixels = camera.height * camera.width

    def step() -> None:
        module.sampler.render(field, rays, module.state).colour.sum().backward()
        module.zero_grad(set_to_none=True)

    taken = WHOLE_STEP * _seconds(step, device)
    if not isinstance(renderer, RayRenderer):
        ray = _seconds(lambda: renderer.view(field, frame, camera, *seen_at), device) / pixels
        return Estimate(taken, ray, ray, 0, 0.0, 0.0)
    chosen = torch.linspace(0, pixels - 1, min(renderer.rays_at_once, pixels)).long()
    origins, directions = (part[chosen].to(device) for part in frame.rays(*camera.rays()))
    first = later = _seconds(lambda: renderer.image(field, origins, directions, *seen_at), device)
    more = RIG_PASSING if module.site.is_rig else 0.0
    passing = 0.0
    if pruned_at := module.sampler.pruned_at:
        solid = field.masked(lambda points: points.new_full(points.shape[:1], OPAQUE))
        later = _seconds(lambda: renderer.image(solid, origins, directions, *seen_at), device)
        if (background := getattr(field, "background", None)) is not None:
            with torch.no_grad():
                seen = origins, directions
                later += BEHIND * _seconds(lambda: background_colour(background, *seen), device)
            passing = PASSING_PRUNED + more
    first, later = first / len(chosen), later / len(chosen)
    return Estimate(taken, first, later, pruned_at, PASSING + more, passing)


def _seconds(work: Callable[[], Any], device: torch.device) -> float:
    """The shorter of two timings: the first call allocates memory and compiles GPU kernels."""
    spent = []
    for _ in range(2):
        began = time.perf_counter()
        work()
        synchronize(device)
        spent.append(time.perf_counter() - began)
    return min(spent)


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
