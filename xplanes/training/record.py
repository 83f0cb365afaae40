"""run.json: what ran, where, and how it ended."""

import logging
import os
import platform
import subprocess
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from xplanes import __version__
from xplanes.errors import ConfigError
from xplanes.files import read_json, write_json
from xplanes.process import resume_command
from xplanes.scenes.views import Views

logger = logging.getLogger(__name__)

KEPT = """model.name lrm.name model.sampler.name data.name data.scene data.seed data.resolution
data.views data.train_views data.train_on_video data.static data.half_side data.eval_split
data.eval_every data.test_cameras data.frames data.protocol data.masks data.mask_use data.model
data.images data.orient data.times data.time_pattern""".split()
"""Settings on which the planes, their frame and what they show depend. Files may have moved."""


def require_same_settings(run: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse settings that a checkpoint cannot go on with.

    Args:
        run: The run directory.
        before: The settings that it began with; those that are not there are not compared.
        now: The settings that it is to go on with.

    Raises:
        ConfigError: Naming the first that differs.
    """
    for key in KEPT:
        was, wanted = (_value(content, key) for content in (before, now))
        if _ABSENT not in (was, wanted) and was != wanted:
            was, wanted = ("null" if value is None else value for value in (was, wanted))
            raise ConfigError(
                f"resume={run} with {key}={wanted}: its checkpoint was trained with {key}={was}. "
                "Leave it out, or train anew in another folder"
            )


def require_same_views(run: Path, record: Mapping[str, Any], views: Views) -> None:
    """Refuse other training views than the run's: the frame and the field's size depend on them.

    Args:
        run: The run directory.
        record: The content of its run.json; one that lists no files refuses nothing.
        views: The scene's training views.

    Raises:
        ConfigError: If they are others, or in another order.
    """
    files = record.get("files")
    recorded = files.get("train") if isinstance(files, Mapping) else None
    if isinstance(recorded, list) and recorded != list(views.files):
        raise ConfigError(
            f"{run} was trained on {len(recorded)} views, but the scene now lists "
            f"{len(views.files)} others or in another order: restore the scene's files"
        )


_ABSENT = object()
"""Stands for a setting that a configuration lacks; one that is null is there."""


def _value(content: Any, key: str) -> Any:
    for name in key.split("."):
        content = content.get(name, _ABSENT) if isinstance(content, Mapping) else _ABSENT
    return content


Status = Literal["running", "finished", "failed", "interrupted"]

_PACKAGES = (
    "torch",
    "lightning",
    "hydra-core",
    "omegaconf",
    "torchmetrics",
    "tensorboard",
    "numba",
    "triton",
)

NOTED = ("device", "precision", "files")
"""Facts that are noted once the scene is read."""


class RunRecord:
    """Keeps run.json true from the start of a run to its end.

    Args:
        run: The run directory.
        seed: The run's seed.
        resume: Whether the run goes on; what a folder says of another start is left out else.
    """

    def __init__(self, run: Path, seed: int, *, resume: bool) -> None:
        self.path = run / "run.json"
        self._began = time.perf_counter()
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
            "directory": str(Path.cwd()),  # Where relative paths of the settings start.
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
        """Add facts, such as the device."""
        self.content.update(entries)
        write_json(self.path, self.content)

    def end(self, status: Status, reason: str | None = None) -> None:
        """Set how the run ended."""
        total = self.total_seconds
        self.content.update(
            status=status, ended=_now(), total_seconds=round(total, 3), reason=reason
        )
        write_json(self.path, self.content)

    @property
    def total_seconds(self) -> float:
        """Wall time of this run so far, earlier parts included."""
        return self._before + time.perf_counter() - self._began


def run_status(run: Path) -> str | None:
    """Status in run.json, "damaged" if it cannot be read; None where the folder holds no run."""
    path = run / "run.json"
    if not path.is_file():
        return None
    try:
        return str(read_json(path).get("status"))
    except ValueError:
        return "damaged"


def claim(run: Path, *, resume: bool) -> None:
    """Refuse a folder that holds a run with a checkpoint, unless it is to be resumed.

    Raises:
        ConfigError: If there is a run and ``resume`` is off, or none and it is on.
    """
    status = run_status(run)
    if not resume and not (run / "checkpoints" / "last.ckpt").is_file() and status != "finished":
        return  # It ended before its first checkpoint: nothing would be lost.
    if status is not None and not resume:
        raise ConfigError(
            f"{run} holds a run already ({status}). Go on with it: {resume_command(run)}; "
            "or choose another hydra.run.dir"
        )
    if status is None and resume:
        raise ConfigError(
            f"resume={run}: no run.json there, so no run to go on with; start it with "
            f"hydra.run.dir={run} instead of resume"
        )


def _earlier(path: Path) -> dict[str, Any]:
    """run.json of the run that goes on; nothing where there is none or it is damaged."""
    if not path.is_file():
        return {}
    try:
        return read_json(path)
    except ValueError as problem:
        logger.warning("%s: the record of this run begins anew", problem)
        return {"resumed": 0}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the source tree, with a mark if it was changed; None outside a checkout."""
    root = Path(__file__).resolve().parent.parent.parent
    try:
        # Installed into an environment, the package may lie in a repository of the user's own.
        if Path(_git(root, "rev-parse", "--show-toplevel")).resolve() != root:
            return None
        return _git(root, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(folder: Path, *words: str) -> str:
    """What git says, in a folder.

    Raises:
        OSError, subprocess.SubprocessError: If it fails.
    """
    run = subprocess.run(
        ["git", *words], cwd=folder, capture_output=True, text=True, timeout=5, check=True
    )
    return run.stdout.strip()
