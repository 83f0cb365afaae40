"""Setting up Lightning's trainer and running it."""

import logging
import warnings
from pathlib import Path

import torch
from lightning import Trainer
from lightning.pytorch.loggers import TensorBoardLogger

from xplanes.backend import cpu_loops
from xplanes.config import TrainConfig
from xplanes.scenes.datamodule import RayDataModule
from xplanes.training.bar import StepBar
from xplanes.training.builder import training_device
from xplanes.training.checkpoints import Checkpoints, find_resumable
from xplanes.training.clock import TrainingClock
from xplanes.training.interrupt import Interrupt
from xplanes.training.module import RadianceModule
from xplanes.training.plateau import PlateauStop
from xplanes.training.scalars import Scalars
from xplanes.training.scorer import Scorer
from xplanes.training.step_threads import StepThreads
from xplanes.training.warming import warming_up


def fit(
    config: TrainConfig, module: RadianceModule, data: RayDataModule, run: Path, *, resume: bool
) -> Scorer:
    """Train to the end of the budget, or from the last checkpoint on.

    Args:
        config: The run's settings.
        module: The module to train, changed in place.
        data: Its rays.
        run: The run directory.
        resume: Whether to go on from the last checkpoint.

    Returns:
        The scorer, whose ``latest`` holds the final scores on rank 0.

    Raises:
        ConfigError: If no checkpoint of the run to go on with can be read.
        TrainingError: If numbers stopped being finite.
    """
    quiet_lightning()
    options = config.trainer
    split = config.data.eval_split
    clock, interrupt = TrainingClock(options.max_seconds), Interrupt()
    scorer = Scorer(
        data.scene.splits[split],
        split,
        data.frame,
        data.scene.background,
        at=options.evaluate_at,
        count=options.evaluate_views,
        run=run,
        clock=clock,
        interrupt=interrupt,
    )
    plateau = [] if options.plateau is None else [PlateauStop(options.plateau)]
    checkpoints = Checkpoints(run / "checkpoints", options.checkpoint_every, clock)
    bar = StepBar(options.max_steps, options.max_seconds, split)
    trainer = Trainer(
        accelerator="gpu" if training_device(options.accelerator).type == "cuda" else "cpu",
        devices=options.devices,
        strategy=options.strategy,
        max_steps=options.max_steps,
        default_root_dir=run,
        callbacks=[
            clock,
            StepThreads(options, training_device(options.accelerator)),
            *plateau,
            Scalars(options.log_every),
            scorer,
            checkpoints,
            bar,
            interrupt,
        ],
        logger=TensorBoardLogger(run, name="", version="tb"),
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        deterministic=options.deterministic,
        log_every_n_steps=10**9,
        use_distributed_sampler=False,
    )
    _warm_up(module, data, trainer.strategy.root_device)
    last = find_resumable(run / "checkpoints") if resume else None
    with interrupt.listening():
        trainer.fit(
            module,
            data,
            ckpt_path=None if last is None else str(last),
            weights_only=True,
        )
        # Lightning leaves the module on the CPU.
        module.to(trainer.strategy.root_device)
        scorer.finish(trainer, module)
        checkpoints.finish(trainer, module)
    return scorer


def _warm_up(module: RadianceModule, data: RayDataModule, device: torch.device) -> None:
    """Run all loops once on a few rays, so that compiling them is not on the training clock."""
    if device.type == "cuda":
        # The kernels are tried where they will run; Lightning would move the module a little later.
        module.to(device)
    elif not cpu_loops(next(module.field.parameters())):
        return
    rays = {name: value[:8].to(device) for name, value in data.batches(0).draw(0).items()}
    with warming_up():
        rendering = module.sampling.render(module.field, rays, module.moment)
        rendering.colour.sum().backward()
        module.sampling.pass_on(rendering, module.moment)
        module.zero_grad(set_to_none=True)


def quiet_lightning() -> None:
    """Hide, by name, what Lightning says that a user of this program cannot act on."""
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
    ):
        warnings.filterwarnings("ignore", message=message)
