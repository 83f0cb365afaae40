"""Reads the runs of a sweep, including unfinished and damaged ones.

A damaged file must not prevent reading the other runs: every problem becomes part of a run's
status. Reading must stay fast.
"""

import itertools
import json
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from xplanes.config import key_and_value, without
from xplanes.errors import ConfigError
from xplanes.files import natural
from xplanes.files import read_rows as read_csv
from xplanes.readers.entries import is_number
from xplanes.settings import flatten


class Score(NamedTuple):
    """A column of a table: its heading and format, and its dotted name in metrics.json."""

    heading: str
    form: str
    place: str = ""


SCORES = {
    "psnr": Score("psnr", ".2f", "test.psnr"),
    "ssim": Score("ssim", ".4f", "test.ssim"),
    "psnr_foreground": Score("psnr object", ".2f", "test.psnr_foreground"),
    "floaters": Score("floaters", ".4f", "test.floaters"),
    "start_psnr": Score("step 0", ".2f"),
    "seconds_to_20": Score("s to 20 dB", ".1f"),
    "steps": Score("steps", ".0f", "step"),
    "prepare_seconds": Score("prepare s", ".1f", "seconds.prepare"),
    "train_seconds": Score("train s", ".1f", "seconds.train"),
    "samples_per_ray": Score("samples/ray", ".1f", "samples_per_ray"),
    "parameters": Score("params", ",.0f", "parameters"),
}
"""Scores in the order of the columns; those without ``place`` are computed from curve.csv."""

GOAL = 20.0
"""PSNR in dB for ``seconds_to_20``."""

STATES = ("running", "finished", "failed", "interrupted")


class Point(NamedTuple):
    """A line of curve.csv, with the seconds of preparation added; PSNR is a mean over views."""

    seconds: float
    step: int
    psnr: float


@dataclass(frozen=True)
class RunRow:
    """One run, or one job of a sweep without a run directory.

    Attributes:
        name: Folder of the run relative to the sweep's folder.
        settings: Settings by dotted name.
        overridden: Names of settings from the command line.
        scores: Known scores by the names of `SCORES`.
        status: One of `STATES`, "damaged" or "missing", with the reason if it is not ``finished``.
        curve: PSNR during training.
        split: The split of `scores`; empty if unknown.
        parts: Report of the decomposition of each orientation, "xy", "xz" and "yz".
        machine: Device and processor count; empty if unknown.
    """

    name: str
    settings: dict[str, Any] = field(default_factory=dict)
    overridden: frozenset[str] = frozenset()
    scores: dict[str, float] = field(default_factory=dict)
    status: str = "finished"
    curve: tuple[Point, ...] = ()
    split: str = ""
    parts: dict[str, dict[str, Any]] = field(default_factory=dict)
    machine: str = ""

    @property
    def missing(self) -> bool:
        """Whether the job has no run directory: only its overrides are known."""
        return self.status.startswith("missing")

    @property
    def done(self) -> bool:
        """Whether it finished and has PSNR and SSIM, so that it counts in means."""
        return self.status == "finished" and {"psnr", "ssim"} <= self.scores.keys()


def read_rows(folder: Path) -> list[RunRow]:
    """All runs in a folder, at any depth, and the jobs of sweeps without a run directory.

    Raises:
        ConfigError: If the folder does not exist or contains no runs.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder")
    rows, groups = [], list(_groups(folder))
    for place, runs in groups:
        rows += [read_run(run, folder) for run in runs]
        below = [run for other, its in groups if other.is_relative_to(place) for run in its]
        rows += _missing_jobs(place, folder, [run_overrides(run) for run in below])
    if not rows:
        raise ConfigError(f"{folder}: no runs in it (folders with run.json)")
    known = {name for row in rows for name in row.settings if name.endswith(".name")}

    def full(key: str) -> str:
        """The dotted name of an override: ``model`` becomes ``model.name``."""
        name = f"{key.replace('/', '.')}.name"
        return name if name in known else key

    return [replace(r, settings={full(k): v for k, v in r.settings.items()}) for r in rows]


def _groups(folder: Path) -> Iterator[tuple[Path, list[Path]]]:
    """Folders that contain runs or are a sweep, each with the runs directly in it."""
    if _is_job(folder):
        yield folder, [folder]
        return
    for place, names, files in os.walk(folder):
        inside = [Path(place, name) for name in sorted(names, key=natural) if name[0] != "."]
        runs = [path for path in inside if _is_job(path) and not path.is_symlink()]
        names[:] = [path.name for path in inside if path not in runs]
        if runs or "multirun.yaml" in files:
            yield Path(place), runs


def _is_job(folder: Path) -> bool:
    names = ("run.json", "metrics.json", "config.yaml", ".hydra/overrides.yaml")
    return any((folder / name).is_file() for name in names)


def read_run(run: Path, folder: Path) -> RunRow:
    """Read one run directory in ``folder``, or ``folder`` itself."""
    problems: list[str] = []
    has_config = (run / "config.yaml").exists()
    config = _mapping(run / ("config.yaml" if has_config else ".hydra/config.yaml"), problems)
    record = _mapping(run / "run.json", problems)
    metrics = _mapping(run / "metrics.json", problems)
    scores = _scores(metrics or {})
    curve = _curve(run, scores.get("prepare_seconds", 0.0), problems) if metrics else ()
    if metrics and "psnr" not in scores:
        problems.append("metrics.json lacks scores")
    if record is not None and record.get("status") not in STATES:
        problems.append("run.json is damaged")
        record = None
    status = _status(record, metrics)
    if problems:
        ended = record is not None and record["status"] != "finished"
        status = f"{status if ended else 'damaged'}; {', '.join(problems)}"
    settings, metrics, record = flatten(config or {}), metrics or {}, record or {}
    parts = metrics.get("decomposition")
    parts = parts if isinstance(parts, dict) else {}
    device = record.get("device")
    return RunRow(
        name=str(run.relative_to(folder)) if run != folder else run.resolve().name,
        # Configurations of jobs that never began have unresolved interpolations.
        settings={key: value for key, value in settings.items() if "${" not in str(value)},
        overridden=frozenset(key_and_value(line)[0] for line in run_overrides(run)),
        scores=scores | _curve_scores(curve),
        status=status,
        curve=curve,
        split=str(metrics.get("split", "")),
        parts={n: parts[n] for n in ("xy", "xz", "yz") if isinstance(parts.get(n), dict)},
        machine=f"{device}, {record.get('cpus')} CPU cores" if device else "",
    )


def _mapping(path: Path, problems: list[str]) -> dict[str, Any] | None:
    """A mapping from YAML or JSON; None if the file is missing, or damaged (noted in problems)."""
    try:
        text = path.read_text(encoding="utf-8")
        content = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, yaml.YAMLError):
        content = None
    if isinstance(content, dict):
        return content
    problems.append(f"{path.name} is damaged")
    return None


def _curve(run: Path, prepare: float, problems: list[str]) -> tuple[Point, ...]:
    try:
        return tuple(
            Point(prepare + float(line["seconds"]), int(line["step"]), float(line["psnr"]))
            for line in read_csv(run / "curve.csv")
        )
    except (KeyError, TypeError, ValueError):
        problems.append("curve.csv is damaged")
        return ()


def _curve_scores(curve: tuple[Point, ...]) -> dict[str, float]:
    """PSNR before the first step, and seconds until it reaches `GOAL`."""
    found = {"start_psnr": curve[0].psnr} if curve and curve[0].step == 0 else {}
    for before, after in itertools.pairwise((curve[0], *curve) if curve else ()):
        if after.psnr >= GOAL:
            share = (GOAL - before.psnr) / (after.psnr - before.psnr) if after != before else 0
            seconds = before.seconds + share * (after.seconds - before.seconds)
            return found | {"seconds_to_20": seconds}
    return found


def _status(record: dict[str, Any] | None, metrics: dict[str, Any] | None) -> str:
    if record is None:
        return "finished" if metrics else "failed before it began"
    status, reason = record.get("status"), record.get("reason")
    if status == "finished" and metrics is None:
        return "finished without metrics.json"
    if status == "running":
        return f"running, or killed, since {record.get('started')}"
    return f"{status}: {reason}" if reason else str(status)


def _scores(metrics: dict[str, Any]) -> dict[str, float]:
    flat, found = flatten(metrics), {}
    for name, score in SCORES.items():
        # A score may be the sum of several numbers, such as the seconds of all stages.
        parts = [flat[key] for key in flat if f"{key}.".startswith(f"{score.place}.")]
        if parts and all(map(is_number, parts)):
            found[name] = sum(parts)
    return found


def run_overrides(run: Path) -> list[str]:
    """Overrides of the command line, from overrides.txt or Hydra's record.

    Hydra also writes its record if it resumes a run in vain.
    """
    with suppress(OSError, UnicodeDecodeError):
        return (run / "overrides.txt").read_text(encoding="utf-8").splitlines()
    with suppress(OSError, UnicodeDecodeError, yaml.YAMLError):
        content = yaml.safe_load((run / ".hydra" / "overrides.yaml").read_text(encoding="utf-8"))
        if isinstance(content, list):
            return [str(line) for line in content]
    return []


def _value(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text


def _missing_jobs(sweep: Path, folder: Path, done: list[list[str]]) -> list[RunRow]:
    """Rows for the jobs in multirun.yaml for which no run has the same overrides."""
    left = Counter(tuple(without(set(lines), "resume", "hydra")) for lines in done)
    rows = []
    for number, job in enumerate(_jobs(_mapping(sweep / "multirun.yaml", []) or {})):
        key = tuple(without(set(job), "resume", "hydra"))
        if left[key]:
            left[key] -= 1
            continue
        settings = {key: _value(value) for key, value in map(key_and_value, job)}
        name = str(sweep.relative_to(folder) / f"job {number}")
        rows.append(RunRow(name, settings, frozenset(settings), status="missing: no run"))
    return rows


def _jobs(multirun: dict[str, Any]) -> list[list[str]]:
    """Overrides of each job of a sweep over a grid; none for other sweepers."""
    from hydra.errors import HydraException

    from xplanes.sweeps import GRIDS, jobs

    try:
        target = multirun["hydra"]["sweeper"]["_target_"]
        return jobs(multirun["hydra"]) if target.endswith(GRIDS) else []
    except (KeyError, TypeError, AttributeError, HydraException):
        return []


def published_tables(folder: Path) -> list[str]:
    """Names of published tables in the configurations of the sweeps in a folder."""
    found: list[str] = []
    for place, _ in _groups(folder):
        content = _mapping(place / "multirun.yaml", []) or {}
        with suppress(KeyError, TypeError):
            own = content["hydra"]["callbacks"]["table"]["published"]
            found += [name for name in own if name not in found]
    return found
