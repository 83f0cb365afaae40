"""The whole job of train.py: build, prepare, fit, evaluate, report."""

import logging
import os
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import yaml
from lightning import seed_everything

from xplanes.backend import warm_up
from xplanes.checks import parse
from xplanes.config import ConfigError, TrainConfig
from xplanes.evaluation.media import film_times, orbit_poses, render_path, write_film
from xplanes.evaluation.report import closing, header, summary, write_hparams, write_start
from xplanes.evaluation.runs import read_config
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
from xplanes.optional import MissingExtraError
from xplanes.preparation import find_source, prepare
from xplanes.process import train_command
from xplanes.scenes.datamodule import RayDataModule
from xplanes.scenes.errors import SceneError
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene
from xplanes.training.builder import (
    build_batches,
    build_frame,
    build_module,
    build_scene,
    training_device,
)
from xplanes.training.checkpoints import LAST
from xplanes.training.fit import fit
from xplanes.training.module import RadianceModule, TrainingError
from xplanes.training.record import RunRecord, claim
from xplanes.training.resuming import require_same_settings, require_same_views

logger = logging.getLogger(__name__)

KNOWN_ERRORS = (ConfigError, SceneError, LRMError, TrainingError, MissingExtraError, StorageError)
"""Errors whose message says all; their traceback goes to train.log alone."""

FILM_FRAMES, FILM_FPS, FILM_SIZE = 48, 16, 200


def run(config: dict[str, Any], folder: Path, overrides: list[str], *, resume: bool) -> float:
    """Train and score one field.

    Args:
        config: The resolved configuration, builtins only.
        folder: The run directory.
        overrides: What the command line changed.
        resume: Whether to go on with the run in ``folder``.

    Returns:
        PSNR of the scored split in dB; NaN in helper processes of a distributed run.

    Raises:
        ConfigError, SceneError, LRMError, TrainingError, StorageError: With a message that says
            what to do.
        KeyboardInterrupt: If the user stopped it; the state is saved.
    """
    typed = parse(config)
    if int(os.environ.get("LOCAL_RANK", "0")):
        train(typed, folder, resume=resume)
        return float("nan")
    try:
        with alone_in(folder):
            claim(folder, resume=resume)
            if resume and _has_checkpoint(folder):
                _require_same(folder, config)
            clear_unfinished(folder)
            with _settings(folder, config, overrides):
                return _recorded(typed, folder, overrides, resume=resume)
    except OSError as problem:
        if (words := storage_error(problem)) is None:
            raise
        raise words from problem


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


def _recorded(config: TrainConfig, folder: Path, overrides: list[str], *, resume: bool) -> float:
    """Train with run.json and train.log kept, and give PSNR."""
    with _logged(folder / "train.log"):
        record = RunRecord(folder, config.seed)
        try:
            metrics = train(config, folder, resume=resume, record=record, overrides=overrides)
            record.end("finished")
        except KeyboardInterrupt:
            record.end("interrupted")
            say(f"\nstopped. Go on with: {train_command()} resume={folder}")
            raise
        except BaseException as error:
            logger.error("failed\n%s", traceback.format_exc())
            # On a full disk the record stays "running", as after a power cut; resume= takes both.
            with suppress(StorageError):
                record.end("failed", f"{type(error).__name__}: {error}")
            if isinstance(error, OSError | TrainingError):
                say(f"\nstopped. Once that is fixed: {train_command()} resume={folder}")
            raise
    return metrics["test"]["psnr"]


def train(
    config: TrainConfig,
    folder: Path,
    *,
    resume: bool,
    record: RunRecord | None = None,
    overrides: list[str] | None = None,
) -> dict[str, Any]:
    """Build, fit, score and report; only the process with a ``record`` reports.

    Returns:
        The content of metrics.json; empty without a ``record``.
    """
    _check_device(config)
    seed_everything(config.seed, verbose=False)
    source = find_source(config.lrm, say=say)
    warm = warm_up.seconds
    started = time.monotonic()
    scene = build_scene(config.data)
    if resume and record is not None and _has_checkpoint(folder):
        require_same_views(folder, record.content, scene.splits["train"])
    frame = build_frame(config, scene.splits["train"])
    loaded = time.monotonic() - started
    start = prepare(config, scene, frame, source, say=say)
    del source
    config, frame = replace(config, model=start.model), start.frame
    began = time.monotonic() - warm_up.seconds
    module = build_module(
        config,
        scene,
        frame,
        planes=start.planes,
        decoder_state=start.decoder,
        sparse=start.sparse,
    )
    data = RayDataModule(scene, frame, lambda rank: build_batches(config, scene, frame, rank))
    loaded += time.monotonic() - warm_up.seconds - began
    if record is not None:
        device = training_device(config.trainer.accelerator)
        record.note(
            device=torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
            precision=module.field.precision,
            files={name: list(views.files) for name, views in scene.splits.items()},
        )
        text = header(config, folder, scene, frame, module, device, overrides or [], start.words)
        logger.info("\n%s", text)
        say(text + "\n")
        write_start(folder, start.pictures, log=not resume)
    scorer = fit(config, module, data, folder, resume=resume)
    if record is None:
        return {}
    seconds = {
        "load": loaded,
        "warm_up": warm_up.seconds - warm,
        "prepare": dict(start.seconds),
        "train": module.clock,
        "evaluate": scorer.seconds,
    }
    skipped = data.batches(0).skipped
    metrics = summary(module, scorer.latest, config.data.eval_split, seconds, skipped)
    metrics["skipped"] |= start.skipped
    metrics["decomposition"] = start.report
    metrics["lrm"] = start.lrm
    if config.trainer.media:
        metrics["media"] = str(_film(module, frame, scene, folder).relative_to(folder))
    seconds["total"] = record.total_seconds
    write_json(folder / "metrics.json", metrics)
    write_hparams(folder, config, metrics)
    text = closing(folder, config, metrics)
    logger.info("\n%s", text)
    say(text)
    return metrics


def _check_device(config: TrainConfig) -> None:
    """Refuse what the device cannot do, before anything slow begins."""
    if training_device(config.trainer.accelerator).type != "cuda":
        return
    if config.trainer.deterministic:
        raise ConfigError(
            "trainer.deterministic=true: sums on a GPU come out in any order; set trainer=cpu, or "
            "do without"
        )
    if config.trainer.devices > (found := torch.cuda.device_count()):
        raise ConfigError(
            f"trainer.devices={config.trainer.devices}: {found} GPUs found; set "
            f"trainer.devices={found}, or trainer.accelerator=cpu"
        )


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


def _film(module: RadianceModule, frame: Frame, scene: Scene, folder: Path) -> Path:
    """The scene turning once while its time runs forth and back."""
    views = scene.splits["train"]
    say(f"filming {FILM_FRAMES} frames of the turning scene ...")
    longer = max(views.height, views.width)
    size = min(FILM_SIZE, longer)
    frames = render_path(
        module.field,
        module.renderer,
        frame,
        orbit_poses(views, frame, FILM_FRAMES),
        film_times(FILM_FRAMES),
        focal=views.focal * size / longer,
        size=size,
        background=scene.background,
    )
    return write_film(folder / "media" / "orbit.webp", frames, fps=FILM_FPS)


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
