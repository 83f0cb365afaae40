"""The whole job of train.py: build, prepare, fit, evaluate, report."""

import logging
import os
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
import yaml
from lightning import seed_everything
from lightning.fabric.utilities.exceptions import MisconfigurationException

from xplanes.backend import warm_up
from xplanes.errors import ConfigError, XPlanesError
from xplanes.evaluation.findings import camera_findings, opaque_findings
from xplanes.evaluation.published import check_published
from xplanes.evaluation.render import orbit_poses, render_path, video_times, write_video
from xplanes.evaluation.report import closing, header, log_hparams, summary, write_pictures
from xplanes.evaluation.runs import read_config
from xplanes.evaluation.sheet import check_what
from xplanes.experiment import Experiment
from xplanes.files import (
    StorageError,
    clear_unfinished,
    replacing,
    storage_error,
    write_json,
    write_text,
)
from xplanes.locks import alone_in
from xplanes.lrm import LRMError
from xplanes.models.initialisation import Initialisation, Place
from xplanes.optional import MissingExtraError
from xplanes.process import resume_command
from xplanes.scenes.datamodule import SceneDataModule, found_root
from xplanes.scenes.errors import SceneError
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene
from xplanes.training.checkpoints import LAST, find_resumable, load_checkpoint
from xplanes.training.clock import find_callback, training_seconds
from xplanes.training.evaluation import Evaluation, final_scores
from xplanes.training.fit import estimate
from xplanes.training.fit import warm_up as warm_up_loops
from xplanes.training.module import RadianceModule
from xplanes.training.record import RunRecord, claim, require_same_settings, require_same_views

logger = logging.getLogger(__name__)

KNOWN_ERRORS = (XPlanesError, MisconfigurationException)
"""Errors that are reported by their message; the traceback is written to train.log only."""

VIDEO_FRAMES, VIDEO_FPS, VIDEO_SIZE = 48, 16, 200


def run(config: dict[str, Any], folder: Path, overrides: list[str], *, resume: bool) -> float:
    """Train and score one field.

    Args:
        config: The resolved configuration, builtins only.
        folder: The run directory.
        overrides: What the command line changed.
        resume: Whether to continue the run in ``folder``.

    Returns:
        PSNR of the scored split in dB; NaN in helper processes of a distributed run.

    Raises:
        ConfigError, SceneError, LRMError, TrainingError, StorageError: With a message that says
            what to do.
        KeyboardInterrupt: If the user stopped it; the state is saved.
    """
    if resume and isinstance(root := config.get("data", {}).get("root"), str):
        # It may be relative to where the run was started.
        config = config | {"data": config["data"] | {"root": found_root(folder, root)}}
    experiment = check(config, folder)
    if int(os.environ.get("LOCAL_RANK", "0")):
        train(experiment, folder, resume=resume)
        return float("nan")
    try:
        with alone_in(folder):
            claim(folder, resume=resume)
            if resume and _has_checkpoint(folder):
                _require_same(folder, config)
                _require_steps(folder, experiment)
            clear_unfinished(folder)
            with _settings(folder, config, overrides):
                return _recorded(experiment, folder, overrides, resume=resume)
    except OSError as problem:
        if (words := storage_error(problem)) is None:
            raise
        raise words from problem


def check(config: dict[str, Any], folder: Path) -> Experiment:
    """The experiment of a configuration, once all of its settings are taken; nothing is written.

    Args:
        config: The resolved configuration, builtins only.
        folder: The run directory, which need not exist.

    Raises:
        ConfigError: If settings are missing, out of range, or contradict one another.
    """
    experiment = Experiment.read(config)
    check_published(config.get("published", []))
    check_what(config.get("sheet"))
    experiment.check_trainer(folder)
    return experiment


def _has_checkpoint(folder: Path) -> bool:
    return (folder / "checkpoints" / LAST).is_file()


@contextmanager
def _settings(folder: Path, config: dict[str, Any], overrides: list[str]) -> Iterator[None]:
    """Write down the settings; those of before come back if they turn out to be impossible."""
    paths = (folder / "config.yaml", folder / "overrides.txt")
    before = {path: path.read_bytes() for path in paths if path.is_file()}
    write_text(paths[0], yaml.safe_dump(config, sort_keys=False))
    write_text(paths[1], "".join(f"{line}\n" for line in overrides))
    try:
        yield
    except (ConfigError, SceneError, LRMError):
        for path, content in before.items():
            with replacing(path) as temporary:
                temporary.write_bytes(content)
        raise


def _require_same(folder: Path, config: dict[str, Any]) -> None:
    """Refuse to go on as another run than that of the checkpoint."""
    try:
        before = read_config(folder)
    except ConfigError:
        return  # Damaged: it is written anew, and what does not fit is refused later.
    require_same_settings(folder, before, config)


def _require_steps(folder: Path, experiment: Experiment) -> None:
    """Refuse a limit that the run has passed: nothing would be trained, now or later."""
    most = experiment.trainer.get("max_steps", -1)
    try:
        done = load_checkpoint(folder / "checkpoints" / LAST)["global_step"]
    except (ConfigError, KeyError):
        return  # Damaged: what takes its place is found later.
    if 0 <= most < done:
        raise ConfigError(
            f"trainer.max_steps={most}: {folder} has done {done} steps already. Give more, or "
            "leave it out"
        )


def _recorded(experiment: Experiment, folder: Path, overrides: list[str], *, resume: bool) -> float:
    """Train with run.json and train.log kept, and give PSNR."""
    with _logged(folder / "train.log"):
        record = RunRecord(folder, experiment.method.seed, resume=resume)
        try:
            metrics = train(experiment, folder, resume=resume, record=record, overrides=overrides)
            record.end("finished")
        except KeyboardInterrupt:
            record.end("interrupted")
            say(f"\nstopped. Go on with: {resume_command(folder)}")
            raise
        except BaseException as error:
            logger.error("failed\n%s", traceback.format_exc())
            # On a full disk the record stays "running", as after a power cut; resume= takes both.
            with suppress(StorageError):
                record.end("failed", f"{type(error).__name__}: {error}")
            if not isinstance(error, ConfigError | SceneError | LRMError | MissingExtraError):
                say(f"\nstopped. Once that is fixed: {resume_command(folder)}")
            raise
    return metrics["test"]["psnr"]


def train(
    experiment: Experiment,
    folder: Path,
    *,
    resume: bool,
    record: RunRecord | None = None,
    overrides: Sequence[str] = (),
) -> dict[str, Any]:
    """Build, fit, score and report; only the process with a ``record`` reports.

    Returns:
        The content of metrics.json; empty without a ``record``.
    """
    method, settings = experiment.method, experiment.data
    device = experiment.device
    trainer = experiment.build_trainer(folder)
    seed_everything(method.seed, verbose=False)
    source = method.lrm.load(say)
    warm = warm_up.seconds
    started = time.monotonic()
    data = SceneDataModule(settings, seed=method.seed)
    data.setup("fit")
    scene, views = data.scene, data.scene.splits["train"]
    if resume and record is not None and _has_checkpoint(folder):
        require_same_views(folder, record.content, views)
    frame = method.model.frame(views, settings.half_side, scene.points)
    if record is not None:
        for finding in (*camera_findings(scene, frame), *opaque_findings(scene)):
            logger.warning("%s", finding.text)
    loaded = time.monotonic() - started
    # Before the initialisation: Lightning holds on to the variables around a new module.
    module = RadianceModule(experiment.config, experiment.config.get("plugins") or [])
    found = Initialisation(method.model, frame)
    if source is not None:
        place = Place(scene, frame, device, experiment.devices, say, settings.half_side)
        found = source.initialise(method, place)
    del source
    began = time.monotonic() - warm_up.seconds
    module.build(scene, frame, device=device, initialise=lambda *_: found)
    assert module.initialisation is not None
    found = module.initialisation  # Without the sparse part.
    loaded += time.monotonic() - warm_up.seconds - began
    if record is not None:
        record.note(
            device=torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
            precision=module.field.precision,
            files={name: list(views.files) for name, views in scene.splits.items()},
        )
        warm_up_loops(module, data, device)
        expected = estimate(module, data)
        text = header(experiment, folder, data, module, overrides, expected)
        logger.info("\n%s", text)
        say(text + "\n")
        write_pictures(trainer, found.pictures, log=not resume)
    trainer.train(module, data, find_resumable(folder / "checkpoints") if resume else None)
    if record is None:
        return {}
    began = time.perf_counter()
    scores = final_scores(trainer, module, data)
    evaluation = find_callback(trainer, Evaluation)
    scoring = time.perf_counter() - began + (0.0 if evaluation is None else evaluation.seconds)
    seconds = {
        "load": loaded,
        "warm_up": warm_up.seconds - warm,
        "prepare": dict(found.seconds),
        "train": training_seconds(trainer),
        "evaluate": scoring,
    }
    skipped = data.batches_for(module, 0).skipped
    metrics = summary(trainer, module, scores, data, seconds, skipped)
    metrics["skipped"] |= found.skipped
    metrics["decomposition"] = found.report
    metrics["lrm"] = found.lrm
    if experiment.media:
        video = _video(module, found.frame, scene, folder)
        metrics["media"] = str(video.relative_to(folder))
    seconds["total"] = record.total_seconds
    write_json(folder / "metrics.json", metrics)
    log_hparams(trainer, experiment, metrics)
    text = closing(folder, experiment, metrics)
    logger.info("\n%s", text)
    say(text)
    return metrics


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


def _video(module: RadianceModule, frame: Frame, scene: Scene, folder: Path) -> Path:
    """One camera orbit while time runs from 0 to 1 and back."""
    views = scene.splits["train"]
    say(f"rendering {VIDEO_FRAMES} frames of the orbit video ...")
    size = min(VIDEO_SIZE, max(views.height, views.width))
    frames = render_path(
        module.field,
        module.renderer,
        frame,
        orbit_poses(views, frame, VIDEO_FRAMES),
        video_times(VIDEO_FRAMES),
        focal=views.intrinsics.focal_at(size),
        size=size,
        background=scene.background,
    )
    return write_video(folder / "media" / "orbit.webp", frames, fps=VIDEO_FPS)


@contextmanager
def _logged(path: Path) -> Iterator[None]:
    """Send log records and warnings to a file, our own warnings to the terminal too."""
    file, terminal = _LogFile(path), logging.StreamHandler()
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    terminal.setFormatter(logging.Formatter("warning: %(message)s"))
    terminal.addFilter(_own_warning)
    logging.getLogger("xplanes").setLevel(logging.INFO)
    root = logging.getLogger()
    handlers = (file, terminal)
    for handler in handlers:
        root.addHandler(handler)
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.captureWarnings(False)
        for handler in handlers:
            root.removeHandler(handler)
            with suppress(OSError):
                handler.close()


class _LogFile(logging.FileHandler):
    """A log that a full disk cuts short, without a word for each line on the terminal."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        return


def _own_warning(record: logging.LogRecord) -> bool:
    """Whether a record is a warning of this package; Python's name the file they come from."""
    ours = record.name.startswith("xplanes") or (
        record.name == "py.warnings" and f"{Path(__file__).parent}" in record.getMessage()
    )
    return ours and record.levelno == logging.WARNING
