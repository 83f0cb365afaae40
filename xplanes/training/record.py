"""The run directory: run.json, config.yaml, train.log, and checks before a run uses it."""

import logging
import os
import platform
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import yaml

import xplanes
from xplanes import __version__
from xplanes.errors import ConfigError, SceneError
from xplanes.files import read_json, replacing, write_json, write_text
from xplanes.lrm import LRMError
from xplanes.optional import MissingExtraError
from xplanes.process import resume_command
from xplanes.scenes.views import Views
from xplanes.settings import flatten
from xplanes.training.checkpoints import LAST, has_checkpoint, load_checkpoint

logger = logging.getLogger(__name__)

REFUSALS = (ConfigError, SceneError, LRMError, MissingExtraError)
"""Errors in settings, data or weights: the run cannot begin."""

KEPT = """model.name lrm.name model.sampler.name data.name data.scene data.seed data.resolution
data.views data.train_views data.train_on_video data.static data.half_side data.centre
data.refine_cameras data.eval_split data.eval_every data.test_cameras data.frames data.protocol
data.masks data.mask_use data.model data.images data.orient data.times data.time_pattern""".split()
"""Settings that a resumed run must keep, because the planes and their frame depend on them."""


def require_same_views(run: Path, record: Mapping[str, Any], views: Views) -> None:
    """Refuse to resume with other training views: the frame and the field's size depend on them.

    Args:
        run: The run directory.
        record: The content of its run.json; without a list of files, nothing is checked.
        views: The scene's training views.

    Raises:
        ConfigError: If the views or their order differ.
    """
    files = record.get("files")
    recorded = files.get("train") if isinstance(files, Mapping) else None
    if isinstance(recorded, list) and recorded != list(views.files):
        raise ConfigError(
            f"{run} was trained on {len(recorded)} views; the scene now has {len(views.files)}, "
            "with other files or in another order: restore the scene's files"
        )


Status = Literal["running", "finished", "failed", "interrupted"]

_PACKAGES = "torch lightning hydra-core omegaconf torchmetrics tensorboard numba triton".split()

NOTED = ("device", "precision", "files")
"""Entries that are added once the scene is read."""


class RunRecord:
    """Keeps run.json up to date from the start of a run to its end.

    Args:
        run: The run directory.
        seed: The run's seed.
        resume: Whether the run is resumed; otherwise the record of an earlier run is ignored.
        began: Start of the run on the clock of `time.perf_counter`; now when None.
    """

    def __init__(self, run: Path, seed: int, *, resume: bool, began: float | None = None) -> None:
        self.path = run / "run.json"
        self._began = time.perf_counter() if began is None else began
        earlier = _earlier(self.path) if resume else {}
        self._before = float(earlier.get("total_seconds", 0.0))
        self.content: dict[str, Any] = {
            "status": "running",
            "started": earlier.get("started", _now()),
            "ended": None,
            "total_seconds": self._before,
            "resumed": earlier.get("resumed", 0) + bool(earlier),
            "seed": seed,
            "process": os.getpid(),
            "directory": str(Path.cwd()),  # Relative paths of the settings start here.
            "xplanes": __version__,
            "commit": _commit(),
            "python": platform.python_version(),
            "versions": {name: _version(name) for name in _PACKAGES},
            "platform": platform.platform(),
            "cpus": os.cpu_count(),
            **{name: earlier[name] for name in NOTED if name in earlier},
        }
        write_json(self.path, self.content)

    def note(self, **entries: Any) -> None:
        """Add entries, such as the device."""
        self.content.update(entries)
        write_json(self.path, self.content)

    def end(self, status: Status, reason: str | None = None) -> None:
        """Set the final status of the run."""
        total = round(self.total_seconds, 3)
        self.note(status=status, ended=_now(), total_seconds=total, reason=reason)

    @property
    def total_seconds(self) -> float:
        """Wall-clock time of this run so far, including parts before a resume."""
        return self._before + self.seconds

    @property
    def seconds(self) -> float:
        """Wall-clock time since this part of the run began."""
        return time.perf_counter() - self._began


def claim(run: Path, *, resume: bool) -> None:
    """Refuse a folder with a finished run or a checkpoint, unless that run is to be resumed.

    Raises:
        ConfigError: For such a run without ``resume``, or ``resume`` without a run.
    """
    path, status = run / "run.json", None
    if path.is_file():
        try:
            status = str(read_json(path).get("status"))
        except ValueError:
            status = "damaged"
    if not resume and not has_checkpoint(run) and status != "finished":
        return  # The run ended before its first checkpoint: nothing is lost.
    if not resume:
        raise ConfigError(
            f"{run} already holds a run ({status}). Resume it with {resume_command(run)}, "
            "or choose another hydra.run.dir"
            if status is not None
            else f"{run} holds checkpoints, but no run.json. Choose another hydra.run.dir"
        )
    if status is None:
        raise ConfigError(
            f"resume={run}: there is no run.json, so no run to resume; start one with "
            f"hydra.run.dir={run} instead of resume"
        )


def _earlier(path: Path) -> dict[str, Any]:
    """run.json of the run that is resumed; empty if it is missing or damaged."""
    if not path.is_file():
        return {}
    try:
        return read_json(path)
    except ValueError as problem:
        logger.warning("%s: starting a new record of this run", problem)
        return {"resumed": 0}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _version(name: str) -> str | None:
    with suppress(PackageNotFoundError):
        return version(name)
    return None


def _commit() -> str | None:
    """Commit of the source tree, marked if there are local changes; None outside a checkout."""
    root = Path(__file__).resolve().parent.parent.parent
    # An installed package may lie inside a repository of the user.
    if not (root / ".git").exists():
        return None
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    options: Any = {"cwd": root, "capture_output": True, "text": True, "timeout": 5, "check": True}
    try:
        return subprocess.run(command, **options).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def read_config(run: Path) -> dict[str, Any]:
    """config.yaml of a run directory.

    Raises:
        ConfigError: If it is missing or damaged.
    """
    path = run / "config.yaml"
    if not path.is_file():
        raise ConfigError(f"{run} is not a run directory: no config.yaml in it")
    try:
        text = path.read_text(encoding="utf-8")
        content = yaml.safe_load(text)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is damaged: {error}") from error
    if not isinstance(content, dict) or not text.endswith("\n"):
        raise ConfigError(f"{path} is damaged: not a mapping, or cut short")
    return content


def require_same_run(run: Path, config: Mapping[str, Any], max_steps: int) -> None:
    """Refuse to resume with settings other than the checkpoint's, or with no steps left.

    Args:
        run: The run directory.
        config: The new settings.
        max_steps: New maximum number of steps; -1 for no limit.

    Raises:
        ConfigError: With the difference, or the number of steps done.
    """
    before: dict[str, Any] = {}
    with suppress(ConfigError):  # A damaged file is written again.
        before = flatten(read_config(run))
    now = flatten(config)
    for key in KEPT:
        if key in before and key in now and before[key] != now[key]:
            was, wanted = ("null" if each[key] is None else each[key] for each in (before, now))
            raise ConfigError(
                f"resume={run} with {key}={wanted}: its checkpoint was trained with {key}={was}. "
                "Leave it out, or start a new run in another folder"
            )
    done = 0
    with suppress(ConfigError, KeyError):  # An unusable checkpoint is refused later.
        done = load_checkpoint(run / "checkpoints" / LAST)["global_step"]
    if 0 <= max_steps < done:
        raise ConfigError(
            f"trainer.max_steps={max_steps}: {run} has already done {done} steps. Set more, or "
            "leave it out"
        )


@contextmanager
def keeping_settings(run: Path, config: Mapping[str, Any], overrides: list[str]) -> Iterator[None]:
    """Write the settings; the previous ones are restored if the new ones prove invalid."""
    paths = (run / "config.yaml", run / "overrides.txt")
    before = {path: path.read_bytes() for path in paths if path.is_file()}
    write_text(paths[0], yaml.safe_dump(dict(config), sort_keys=False))
    write_text(paths[1], "".join(f"{line}\n" for line in overrides))
    try:
        yield
    except REFUSALS:
        for path, content in before.items():
            with replacing(path) as temporary:
                temporary.write_bytes(content)
        raise


@contextmanager
def logged(path: Path) -> Iterator[None]:
    """Send log records and warnings to a file, and this package's warnings also to the terminal."""
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
    """A log file that fails silently when the disk is full."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        return


def _own_warning(record: logging.LogRecord) -> bool:
    """Whether a record is a warning of this package; Python's warnings start with a file path."""
    ours = record.name.startswith("xplanes") or (
        record.name == "py.warnings" and f"{Path(xplanes.__file__).parent}" in record.getMessage()
    )
    return ours and record.levelno == logging.WARNING
