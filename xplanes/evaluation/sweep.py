"""What the runs of a sweep say of themselves, whatever state they are in.

Must stay quick, and a damaged file must not hide the other runs: every problem ends as a run's
status.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from xplanes.files import natural, read_json
from xplanes.files import read_rows as read_csv

SCORES = {
    "psnr": ("test", "psnr"),
    "ssim": ("test", "ssim"),
    "psnr_thing": ("test", "psnr_thing"),
    "floaters": ("test", "floaters"),
    "steps": ("step",),
    "prepare_seconds": ("seconds", "prepare"),
    "train_seconds": ("seconds", "train"),
    "samples_per_ray": ("samples_per_ray",),
    "parameters": ("parameters",),
}
"""Where metrics.json holds each column's number."""

MEASURES = (
    "psnr",
    "ssim",
    "psnr_thing",
    "floaters",
    "start_psnr",
    "seconds_to_20",
    "steps",
    "prepare_seconds",
    "train_seconds",
    "samples_per_ray",
    "parameters",
)
"""Columns of a table; `start_psnr` and `seconds_to_20` come from curve.csv."""

GOAL = 20.0
"""PSNR that ``seconds_to_20`` stands for."""

STATES = ("running", "finished", "failed", "interrupted")


@dataclass(frozen=True)
class Point:
    """A line of curve.csv.

    Attributes:
        seconds: Preparation and training clock.
        step: Optimiser steps.
        psnr: Mean over the scored views.
    """

    seconds: float
    step: int
    psnr: float


@dataclass(frozen=True)
class RunRow:
    """One run, or one job of a sweep that left none.

    Attributes:
        name: Folder of the run relative to the sweep's.
        settings: Settings by dotted name.
        overridden: Names of those that the command line set.
        scores: Numbers by the names of `MEASURES`, as far as they are known.
        status: How it ended, with the reason where it is not ``finished``.
        curve: PSNR on the way.
        split: The split that `scores` are of; empty where they do not say.
        parts: Report of the decomposition of each orientation, "xy", "xz" and "yz".
        machine: Device and processor count; empty where run.json does not say.
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


def read_rows(folder: Path) -> list[RunRow]:
    """All runs in a folder, however deep, and the jobs of sweeps that left no run."""
    rows, groups = [], list(_groups(folder))
    for place, runs in groups:
        rows += [read_run(run, _name(run, folder)) for run in runs]
        below = [run for other, its in groups if other.is_relative_to(place) for run in its]
        rows += _missing_jobs(place, folder, [run_overrides(run) for run in below])
    return rows


def _name(path: Path, folder: Path) -> str:
    relative = path.relative_to(folder)
    return str(relative) if relative.parts else path.resolve().name


def _groups(folder: Path) -> Iterator[tuple[Path, list[Path]]]:
    """Folders that hold runs or are a sweep, each with the runs right in it."""
    if _is_job(folder):
        yield folder, [folder]
        return
    inside = [path for path in folder.iterdir() if path.is_dir() and not path.is_symlink()]
    inside = [path for path in inside if not path.name.startswith(".")]
    inside.sort(key=lambda path: natural(path.name))
    runs = [path for path in inside if _is_job(path)]
    if runs or (folder / "multirun.yaml").is_file():
        yield folder, runs
    for path in inside:
        if path not in runs:
            yield from _groups(path)


def _is_job(folder: Path) -> bool:
    names = ("run.json", "metrics.json", "config.yaml", ".hydra/overrides.yaml")
    return any((folder / name).is_file() for name in names)


def read_run(run: Path, name: str) -> RunRow:
    """One run directory as a row."""
    problems: list[str] = []
    config = _read_yaml(run, ("config.yaml", ".hydra/config.yaml"), problems)
    record = _read_json(run / "run.json", problems)
    metrics = _read_json(run / "metrics.json", problems)
    scores = _scores(metrics) if metrics else {}
    curve = _curve(run, scores.get("prepare_seconds", 0.0), problems) if metrics else ()
    scores |= _curve_scores(curve)
    if metrics and "psnr" not in scores:
        problems.append("metrics.json lacks scores")
    if not isinstance(config, dict) and (run / "config.yaml").is_file() and not problems:
        problems.append("config.yaml is damaged")
    if record is not None and record.get("status") not in STATES:
        problems.append("run.json is damaged")
        record = None
    status = _status(record, metrics)
    if problems:
        ended = record is not None and record["status"] != "finished"
        status = f"{status if ended else 'damaged'}; {', '.join(problems)}"
    return RunRow(
        name=name,
        settings=_resolved(flatten(config)) if isinstance(config, dict) else {},
        overridden=frozenset(_key(line) for line in run_overrides(run)),
        scores=scores,
        status=status,
        curve=curve,
        split=str((metrics or {}).get("split", "")),
        parts=_parts(metrics or {}),
        machine=_machine(record or {}),
    )


def _parts(metrics: dict[str, Any]) -> dict[str, dict[str, Any]]:
    found = metrics.get("decomposition")
    found = found if isinstance(found, dict) else {}
    return {name: found[name] for name in ("xy", "xz", "yz") if isinstance(found.get(name), dict)}


def _machine(record: dict[str, Any]) -> str:
    device, cpus = record.get("device"), record.get("cpus")
    return "" if device is None else f"{device}, {cpus} CPU cores"


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
    found = {}
    if curve and curve[0].step == 0:
        found["start_psnr"] = curve[0].psnr
    if curve and curve[0].psnr >= GOAL:
        return found | {"seconds_to_20": curve[0].seconds}
    for before, after in zip(curve, curve[1:], strict=False):
        if before.psnr < GOAL <= after.psnr:
            share = (GOAL - before.psnr) / (after.psnr - before.psnr)
            found["seconds_to_20"] = before.seconds + share * (after.seconds - before.seconds)
            break
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
    found = {}
    for name, path in SCORES.items():
        value: Any = metrics
        for key in path:
            value = value.get(key) if isinstance(value, dict) else None
        if isinstance(value, dict) and value:
            parts = list(value.values())
            value = sum(parts) if all(_is_number(part) for part in parts) else None
        if _is_number(value):
            found[name] = value
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def flatten(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        flat.update(flatten(value, f"{name}.") if isinstance(value, dict) else {name: value})
    return flat


def _resolved(settings: dict[str, Any]) -> dict[str, Any]:
    """Without references to other settings, which jobs that never began still have."""
    return {name: value for name, value in settings.items() if "${" not in str(value)}


def run_overrides(run: Path) -> list[str]:
    """What the command line set, from Hydra's record of it or our own."""
    content = _read_yaml(run, (".hydra/overrides.yaml",), [])
    if isinstance(content, list):
        return [str(line) for line in content]
    try:
        return (run / "overrides.txt").read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []


def _key(override: str) -> str:
    return override.split("=", 1)[0].lstrip("+~")


def _value(override: str) -> Any:
    text = override.split("=", 1)[-1]
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text


def _missing_jobs(sweep: Path, folder: Path, done: list[list[str]]) -> list[RunRow]:
    """Rows for the jobs in multirun.yaml whose overrides belong to no run."""
    content = _read_yaml(sweep, ("multirun.yaml",), [])
    if not isinstance(content, dict):
        return []
    left = Counter(_settings_of(lines) for lines in done)
    rows = []
    for number, job in enumerate(_jobs(content)):
        key = _settings_of(job)
        if left[key]:
            left[key] -= 1
            continue
        settings = {_key(line): _value(line) for line in job}
        name = str(Path(_name(sweep, folder) if sweep != folder else "") / f"job {number}")
        rows.append(RunRow(name, settings, frozenset(settings), status="missing: no run"))
    return rows


def _settings_of(overrides: Iterable[str]) -> tuple[str, ...]:
    """Overrides in order, but for those that say how Hydra runs the job."""
    mine = ("resume", "hydra")
    return tuple(sorted(text for text in overrides if _key(text).split(".")[0] not in mine))


def _jobs(multirun: dict[str, Any]) -> list[list[str]]:
    """Overrides of each job of a sweep over a grid; none for other sweepers."""
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        settings = multirun["hydra"]
        if not settings["sweeper"]["_target_"].endswith(".BasicSweeper"):
            return []
        params = [f"{key}={value}" for key, value in (settings["sweeper"]["params"] or {}).items()]
        lines = [*params, *settings["overrides"]["task"]]
        parsed = OverridesParser.create().parse_overrides(lines)
        return BasicSweeper.split_arguments(parsed, None)[0]
    except (KeyError, TypeError, AttributeError, HydraException):
        return []


def _read_yaml(folder: Path, names: tuple[str, ...], problems: list[str]) -> Any:
    """The first of the files that exists; None, and a problem noted, if it is damaged."""
    for name in names:
        try:
            return yaml.safe_load((folder / name).read_text(encoding="utf-8"))
        except FileNotFoundError:
            continue
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            problems.append(f"{name} is damaged ({type(error).__name__})")
            return None
    return None


def _read_json(path: Path, problems: list[str]) -> dict[str, Any] | None:
    try:
        return read_json(path)
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        problems.append(f"{path.name} is damaged")
        return None
