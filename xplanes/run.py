"""A whole run: build, prepare, fit, score, report. Read it from top to bottom."""

import logging
import os
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning import seed_everything
from lightning.fabric.utilities.exceptions import MisconfigurationException

from xplanes.backend import warm_up
from xplanes.errors import XPlanesError
from xplanes.evaluation.estimate import estimate
from xplanes.evaluation.findings import scene_findings
from xplanes.evaluation.render import write_run_video
from xplanes.evaluation.report import closing, header, log_hparams, rest, summary, write_pictures
from xplanes.experiment import Experiment
from xplanes.files import StorageError, clear_unfinished, storage_errors, write_json
from xplanes.locks import alone_in
from xplanes.models.initialisation import Place, initialisation_of
from xplanes.process import resume_command, say
from xplanes.scenes.datamodule import SceneDataModule, found_root
from xplanes.training.checkpoints import find_resumable, has_checkpoint
from xplanes.training.clock import find_callback, training_seconds
from xplanes.training.evaluation import Evaluation
from xplanes.training.fit import Trainer, warm_up_loops
from xplanes.training.module import RadianceModule
from xplanes.training.record import (
    REFUSALS,
    RunRecord,
    claim,
    keeping_settings,
    logged,
    require_same_run,
    require_same_views,
)

logger = logging.getLogger(__name__)

KNOWN_ERRORS = (XPlanesError, MisconfigurationException)
"""Errors reported by their message alone; the traceback goes to train.log only."""


@dataclass(frozen=True)
class Job:
    """A run that is ready to begin: settings parsed, Trainer built, nothing written yet.

    Attributes:
        experiment: The settings.
        trainer: The Trainer, with callbacks and loggers.
        folder: The run directory, which need not exist yet.
        new: Whether the folder did not exist yet.
    """

    experiment: Experiment
    trainer: Trainer
    folder: Path
    new: bool


def prepare(experiment: Experiment, folder: Path) -> Job:
    """Build the Trainer of a run.

    Raises:
        ConfigError: If one of its arguments, callbacks or loggers is rejected.
    """
    return Job(experiment, experiment.build_trainer(folder), folder, not folder.exists())


def run(
    config: dict[str, Any],
    folder: Path,
    overrides: list[str],
    *,
    resume: bool,
    job: Job | None = None,
    began: float | None = None,
) -> float:
    """Train and score one field; a run that is refused leaves no directory behind.

    Args:
        config: The resolved configuration, builtins only.
        folder: The run directory.
        overrides: Overrides from the command line.
        resume: Whether to continue the run in ``folder``.
        job: Result of `prepare` for the configuration; prepared here when None.
        began: Start of the run on the clock of `time.perf_counter`; now when None.

    Returns:
        PSNR of the scored split in dB; NaN in helper processes of a distributed run.

    Raises:
        ConfigError, SceneError, LRMError, TrainingError, StorageError: With a message that says
            what to do.
        KeyboardInterrupt: If the user stopped it; the state is saved.
    """
    if resume and isinstance(root := config.get("data", {}).get("root"), str):
        # The path may be relative to the folder in which the run was started.
        found = found_root(folder, root)
        job = job if found == root else None
        config = config | {"data": config["data"] | {"root": found}}
    job = job or prepare(Experiment.read(config), folder)
    if int(os.environ.get("LOCAL_RANK", "0")):
        train(job, resume=resume)
        return float("nan")
    claimed = False
    try:
        with storage_errors(), alone_in(folder):
            claim(folder, resume=resume)
            claimed = True
            if resume and has_checkpoint(folder):
                require_same_run(folder, config, job.experiment.trainer.get("max_steps", -1))
            clear_unfinished(folder)
            with keeping_settings(folder, config, overrides):
                return _recorded(job, overrides, resume=resume, began=began)
    except REFUSALS:
        if claimed and job.new and not has_checkpoint(folder):
            shutil.rmtree(folder, ignore_errors=True)
            with suppress(OSError):  # The parent folder may hold other runs.
                folder.parent.rmdir()
        raise


def _recorded(job: Job, overrides: list[str], *, resume: bool, began: float | None) -> float:
    """Train, keep run.json and train.log, and return the PSNR."""
    folder = job.folder
    with logged(folder / "train.log"):
        record = RunRecord(folder, job.experiment.method.seed, resume=resume, began=began)
        try:
            metrics = train(job, resume=resume, record=record, overrides=overrides)
            record.end("finished")
        except KeyboardInterrupt:
            record.end("interrupted")
            step = job.trainer.global_step
            say(f"\nstopped after step {step}. Resume with: {resume_command(folder)}")
            raise
        except BaseException as error:
            logger.exception("failed")
            # On a full disk the status stays "running", as after a power cut; resume= accepts both.
            with suppress(StorageError):
                record.end("failed", f"{type(error).__name__}: {error}")
            if not isinstance(error, REFUSALS):
                say(f"\nstopped. Once that is fixed: {resume_command(folder)}")
            raise
    return metrics["test"]["psnr"]


def train(
    job: Job, *, resume: bool, record: RunRecord | None = None, overrides: Sequence[str] = ()
) -> dict[str, Any]:
    """Build, fit, score and report; only the process with a ``record`` reports.

    Returns:
        The content of metrics.json; empty without a ``record``.
    """
    experiment, trainer, folder = job.experiment, job.trainer, job.folder
    method, settings, device = experiment.method, experiment.data, experiment.device
    seed_everything(method.seed, verbose=False)
    source = method.lrm.load(say)

    # Data
    warm = warm_up.seconds
    began = time.perf_counter() - warm
    data = SceneDataModule(settings, seed=method.seed)
    data.setup("fit")
    scene, views = data.scene, data.scene.splits["train"]
    if resume and record is not None and has_checkpoint(folder):
        require_same_views(folder, record.content, views)
    hints = settings.hints(scene)
    frame = method.model.frame(views, hints)
    if record is not None:
        for finding in scene_findings(scene, frame):
            logger.warning("%s", finding.text)
    loaded = time.perf_counter() - warm_up.seconds - began

    # Initialisation and field
    # Created before the large initialisation: Lightning keeps its caller's local variables alive.
    module = RadianceModule(method)
    place = Place(scene, frame, device, experiment.devices, say, hints)
    found = initialisation_of(method, source, place)
    del source  # Frees the LRM.
    began = time.perf_counter() - warm_up.seconds
    module.build(scene, frame, device=device, initialisation=found)
    loaded += time.perf_counter() - warm_up.seconds - began
    found = module.initialisation or found  # Without the sparse part, which the model frees.
    loaded -= found.seconds["fill"]  # Counted as preparation.

    # Training
    warm_up_loops(module, data, device)
    checkpoint = find_resumable(folder / "checkpoints") if resume else None
    if record is not None:
        hardware = torch.cuda.get_device_name() if device.type == "cuda" else "cpu"
        files = {name: list(views.files) for name, views in scene.splits.items()}
        record.note(device=hardware, precision=module.field.precision, files=files)
        expected = estimate(module, data)
        text = header(
            experiment, folder, data, module, overrides, expected, record.seconds, checkpoint
        )
        logger.info("\n%s", text)
        say(text + "\n")
        write_pictures(trainer, found.pictures, log=not resume)
    trainer.train(module, data, checkpoint)

    # Scores
    began = time.perf_counter()
    scores = trainer.final_scores(module, data)
    if record is None:
        return {}
    evaluation = find_callback(trainer, Evaluation)
    seconds = {
        "load": loaded,
        "warm_up": warm_up.seconds - warm,
        "prepare": dict(found.seconds),
        "train": training_seconds(trainer),
        "evaluate": time.perf_counter() - began + (evaluation.seconds if evaluation else 0.0),
    }

    # Report
    metrics = summary(trainer, module, scores, data, seconds)
    metrics["skipped"] |= found.skipped
    metrics["decomposition"] = found.report
    metrics["lrm"] = found.lrm
    if experiment.media:
        say("rendering the video ...")
        metrics["media"] = str(write_run_video(module, scene, folder).relative_to(folder))
    seconds |= rest(seconds, record.total_seconds)
    write_json(folder / "metrics.json", metrics)
    log_hparams(trainer, experiment, metrics)
    text = closing(folder, experiment, metrics)
    logger.info("\n%s", text)
    say(text)
    return metrics
