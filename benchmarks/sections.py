"""Sections of the results: what each measures, and the record that its page is drawn from."""

import hashlib
import json
import math
import re
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from itertools import islice
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from runner import CPU_CLOCK, RESULTS, Measured, machine, run_apart

from xplanes import __version__
from xplanes.config import compose_plain
from xplanes.files import read_json, write_text
from xplanes.lrm.weights import FOLDER as SHIPPED
from xplanes.models.x_planes import USUAL_TEXELS
from xplanes.synthetic.demo.suite import suite_scene
from xplanes.synthetic.demo.write import SUITE_VERSION, VERSION

Row = dict[str, Any]
"""What was measured of a case: its name under "case", numbers under the others."""

RECORDS = RESULTS / "records"
WORK = Path("outputs/benchmarks")
"""Finished runs of a measurement that was interrupted, each section in a folder of its name."""

DATA: dict[str, Path] = {
    "dnerf": Path("data/dnerf"),
    "real": Path("data/real"),
    "held_out": WORK / "scenes",
}
"""Folders of scenes that are not part of the project, by what stands for them in overrides."""

MEASURED = ("data", "model", "lrm", "preparation", "decomposition", "losses", "trainer")
NOT_MEASURED = re.compile(
    r".*_target_$|data\.(root|cache)|preparation\.cache|lrm\.(weights|triplanes)"
    r"|trainer\.(?!max_|accumulate|g)"
)
"""Settings that change nothing of what is measured: where things lie, what classes are called."""

WITH_SURROUNDINGS = re.compile(
    r"model\.background\..*|model\..*_with_background|model\.loss\.(passing|rig).*"
    r"|model\.sampler\.(border|distortion)"
)
"""Settings that change nothing where the images show an object without surroundings."""

POSITIONS = 50
"""Least number of camera positions in the scenes without surroundings that are measured."""


class OutOfTimeError(Exception):
    """The minutes of a measurement are over; finished runs are kept.

    Attributes:
        rows: Of the cases that are complete.
    """

    def __init__(self, message: str, rows: list[Row]) -> None:
        super().__init__(message)
        self.rows = rows


@dataclass(frozen=True, kw_only=True)
class Section:
    """What stands between two comments of a page: measurements, and how they are made and shown.

    Attributes:
        name: Of the record, of the figure, and in the comments.
        settings: Inputs and settings of each case, as they are now, by its name. A change of one
            of them makes the record stale; a change of code does not, and is seen by measuring a
            part of the section again.
        measure: Measures all cases in a folder that keeps what is finished, or a subset with one
            seed.
        show: Draws the figure and returns the table, from the rows of the record.
        checks: What a repeated measurement is judged by, and the share by which it may differ.
    """

    name: str
    settings: Callable[[], dict[str, Row]]
    measure: Callable[[Path, bool], list[Row]]
    show: Callable[[list[Row]], str]
    checks: Mapping[str, float] = field(default_factory=lambda: {"psnr": 0.02})


@dataclass(frozen=True)
class Case:
    """Runs that differ in their seed alone.

    Attributes:
        name: Of the case, unique in its section.
        overrides: As on the command line; {dnerf} and {real} stand for folders of scenes.
        seeds: How many runs.
        quick: Whether one seed of it is enough to notice that something has changed.
        about: Further columns of its row.
    """

    name: str
    overrides: tuple[str, ...]
    seeds: int = 3
    quick: bool = False
    about: Mapping[str, Any] = field(default_factory=dict)


def flat(config: Mapping[str, Any], before: str = "") -> Row:
    """The values of a nested mapping by their whole names."""
    found: Row = {}
    for key, value in config.items():
        name = f"{before}{key}"
        found |= flat(value, f"{name}.") if isinstance(value, dict) and value else {name: value}
    return found


def placed(overrides: Iterable[str]) -> list[str]:
    """Overrides with the folders of `DATA`."""
    folders = {name: path.absolute() for name, path in DATA.items()}
    return [line.format(**folders) for line in overrides]


@cache
def settings_of(overrides: tuple[str, ...]) -> Row:
    """What a run with these overrides depends on: its settings, weights and procedural scene."""
    plain = compose_plain("train", placed(overrides))
    found = flat({name: plain[name] for name in MEASURED})
    found = {key: value for key, value in found.items() if not NOT_MEASURED.match(key)}
    if (name := found.get("lrm.bundled")) is not None:
        found["lrm weights"] = read_json(SHIPPED / f"{name}.json")["weights_sha256"][:12]
    if found["data.name"] in ("demo", "suite"):
        found["version of the scene"] = VERSION if found["data.name"] == "demo" else SUITE_VERSION
    return found


def trainings(
    cases: Sequence[Case],
    *,
    before: Callable[[], None] = lambda: None,
    besides: Callable[[], list[Row]] = list,
    **about: Any,
) -> Section:
    """A section of training runs: each a process with one thread, whose CPU seconds count.

    Args:
        cases: What is trained.
        before: Called before the first run.
        besides: Measures rows that need no training, for full measurements.
        about: The section's other attributes.
    """

    def measure(work: Path, quick: bool) -> list[Row]:
        before()
        rows = train_all(cases, work, quick=quick)
        return rows if quick else rows + besides()

    def settings() -> dict[str, Row]:
        return {case.name: settings_of(case.overrides) for case in cases}

    return Section(settings=settings, measure=measure, **about)


LIMITS = {"together": 1, "seeds": math.inf, "until": math.inf}
"""Runs side by side; seeds at most; when to begin no more runs, by the clock of time.monotonic."""


def train_all(cases: Sequence[Case], work: Path, *, quick: bool = False) -> list[Row]:
    """Train the runs of all cases that are not finished, and gather them; one row per case."""
    chosen = [case for case in cases if case.quick or not quick]
    counts = [1 if quick else int(min(case.seeds, LIMITS["seeds"])) for case in chosen]
    jobs: list[tuple[Case, int, Path]] = []
    for case, count in zip(chosen, counts, strict=True):  # Hydra cannot compose in threads.
        digest = hashlib.sha256(json.dumps(settings_of(case.overrides)).encode()).hexdigest()[:8]
        start = work.absolute() / slug(case.name)
        jobs += [(case, seed, Path(f"{start}_{seed}_{digest}")) for seed in range(count)]

    def train(job: tuple[Case, int, Path]) -> Measured | None:
        case, seed, folder = job
        finished = (folder / "metrics.json").is_file()
        if time.monotonic() > LIMITS["until"] and not finished:
            return None
        if not finished:
            print(f"{case.name}, seed {seed}", flush=True)
        lines = placed(case.overrides)
        return run_apart([*lines, "logger=none", "media=false", f"seed={seed}"], folder, CPU_CLOCK)

    with ThreadPoolExecutor(int(LIMITS["together"])) as pool:
        found = list(pool.map(train, jobs))
    done, rows = iter(found), []
    for case, count in zip(chosen, counts, strict=True):
        runs = [run for run in islice(done, count) if run is not None]
        if len(runs) == count:
            rows.append(gathered(case, runs))
    if (left := found.count(None)) > 0:
        raise OutOfTimeError(f"{left} of {len(jobs)} runs are left", rows)
    return rows


def gathered(case: Case, runs: list[Measured]) -> Row:
    """The row of a case: means over the seeds, with standard deviations of scores."""
    numbers = [values(run) for run in runs]
    row: Row = {"case": case.name, **case.about, "seeds": len(runs)}
    for key in numbers[0]:
        found = [value for each in numbers if (value := each[key]) is not None]
        if found:
            row[key] = fmean(found)
        if key in SCORES[:3] and len(found) > 1:
            row[f"{key}_std"] = stdev(found)
    row["cpu"] = sum(run.metrics["seconds"]["total"] for run in runs)
    row["curve"] = [
        [fmean(float(point["seconds"]) for point in points), *spread_of(points)]
        for points in zip(*(run.curve for run in runs), strict=False)
    ]
    return row


def spread_of(points: Iterable[Mapping[str, str]]) -> tuple[float, float]:
    """Mean and standard deviation of the PSNR of several runs."""
    found = [float(point["psnr"]) for point in points]
    return fmean(found), stdev(found) if len(found) > 1 else 0.0


SCORES = ("psnr", "ssim", "psnr_foreground", "floaters")


def values(run: Measured) -> dict[str, float | None]:
    """The numbers that tables show of a run."""
    metrics, seconds = run.metrics, run.metrics["seconds"]
    first = run.curve[0] if run.curve and run.curve[0]["step"] == "0" else None
    return {
        **{key: metrics["test"].get(key) for key in SCORES},
        "first": float(first["psnr"]) if first else None,
        "prepare": sum(seconds["prepare"].values()),
        "train": seconds["train"],
        "steps": metrics["step"],
        "samples": metrics["samples_per_ray"],
        **{key: metrics["skipped"].get(key) for key in ("empty", "occluded", "background")},
        "parameters": metrics["parameters"],
        "gigabytes": metrics["peak_memory_bytes"] / 1e9,
    }


def slug(name: str) -> str:
    """A name as that of a folder."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def read_record(name: str) -> dict[str, Any] | None:
    """Rows of a section, the settings of their cases, and how they were made."""
    file = RECORDS / f"{name}.json"
    if not file.is_file():
        return None
    record = read_json(file)
    common = record.pop("common", {})
    record["settings"] = {case: common | own for case, own in record.get("settings", {}).items()}
    return record


def write_record(name: str, made: Row, settings: Mapping[str, Row], rows: list[Row]) -> None:
    """Write a record with one line per row; settings that all cases share stand there once."""
    cases = list(settings.values())
    common = {
        key: value
        for key, value in (cases[0] if cases else {}).items()
        if all(key in case and case[key] == value for case in cases)
    }
    own = {
        name: {key: value for key, value in case.items() if key not in common}
        for name, case in settings.items()
    }
    lines = ",\n  ".join(json.dumps(rounded(row), ensure_ascii=False) for row in rows)
    parts = {"made": made, "common": common, "settings": own}
    head = json.dumps(parts, indent=1, ensure_ascii=False)[:-2]
    write_text(RECORDS / f"{name}.json", f'{head},\n "rows": [\n  {lines}\n ]\n}}\n')


def rounded(value: Any) -> Any:
    """Numbers with five significant digits, which are enough for any table."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(each) for each in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def measure(section: Section, work: Path) -> None:
    """Measure a section in full and write its record; finished runs stay in a folder until then.

    Raises:
        OutOfTimeError: If the minutes are over before all is measured. Complete cases are recorded;
            another call goes on.
        RuntimeError: If a run fails.
    """
    began = time.perf_counter()
    work.mkdir(parents=True, exist_ok=True)
    settings, left = section.settings(), None
    try:
        rows = section.measure(work, False)
    except OutOfTimeError as error:
        rows, left = error.rows, error
        settings = {row["case"]: settings[row["case"]] for row in rows}
        if not rows:
            raise
    spent = sum(row.get("cpu", 0) for row in rows) or time.perf_counter() - began
    made = {
        "version": __version__,
        "commit": commit(),
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "machine": machine(),
        "hours": round(spent / 3600, 2),
    }
    write_record(section.name, made, settings, rows)
    if left is not None:
        raise left


def commit() -> str:
    """The commit that is checked out, shortened; a plus where files differ from it."""
    here = Path(__file__).parent
    line = ["git", "-C", str(here), "describe", "--always", "--dirty=+", "--exclude=*"]
    return subprocess.run(line, capture_output=True, text=True, check=False).stdout.strip()


def why_stale(section: Section) -> str:
    """What has changed since a section was measured, in words; empty if nothing has."""
    record = read_record(section.name)
    if record is None:
        return "never measured"
    if not record["settings"]:
        return f"measured with version {record['made']['version']}, which recorded no settings"
    now = section.settings()
    changes: dict[str, list[str]] = {}
    for case, settings in now.items():
        if case not in record["settings"]:
            changes[f"{case} has not been measured"] = []
            continue
        then, settings = effective(record["settings"][case]), effective(settings)
        for key in sorted({*then, *settings}):
            old, new = then.get(key), settings.get(key)
            # A setting that did not exist, and is off now, changes nothing.
            if old != new and (key in then or new not in (False, 0, None)):
                changes.setdefault(f"{key} went from {old} to {new}", []).append(case)
    for words, cases in list(changes.items()):
        if len(cases) == 1 < len(now):
            changes[f"{words} ({cases[0]})"] = changes.pop(words)
    named, rest = list(changes)[:4], len(changes) - 4
    return ", ".join(named) + (f" and {rest} more changes" if rest > 0 else "")


def effective(settings: Row) -> Row:
    """Without the settings that change nothing in this scene."""
    name, scene = settings.get("data.name"), settings.get("data.scene")
    if name not in ("dnerf", "demo") and (name != "suite" or suite_scene(scene).world is not None):
        return settings
    found = {key: value for key, value in settings.items() if not WITH_SURROUNDINGS.match(key)}
    if found.get("model.resolution") == "auto":
        found["model.resolution"] = USUAL_TEXELS
    views = found.get("model.loss.variation_views")
    if found.get("data.views") is None and (views or 0) <= POSITIONS:
        found["model.loss.variation_views"] = None
    return found


def drift(section: Section, rows: list[Row]) -> list[tuple[str, str, str, str, str]]:
    """A repeated measurement beside the record: case, quantity, then, now, and what it means."""
    record = read_record(section.name)
    known = {row["case"]: row for row in record["rows"]} if record else {}
    found = []
    for row in rows:
        then = known.get(row["case"], {})
        for key, share in section.checks.items():
            if (new := row.get(key)) is None or (old := then.get(key)) is None:
                continue
            allowed = max(3 * then.get(f"{key}_std", 0), share * abs(old))
            words = "" if abs(new - old) <= allowed else f"differs by more than {allowed:.2g}"
            found.append((row["case"], key, f"{old:.4g}", f"{new:.4g}", words))
    return found


def number(row: Row, key: str, digits: int = 2, scale: float = 1) -> str:
    """A value with its standard deviation, for a table; empty where there is none."""
    if row.get(key) is None:
        return ""
    mean, spread = f"{scale * row[key]:.{digits}f}", row.get(f"{key}_std")
    if spread is None:
        return mean
    nobreak = "\N{NO-BREAK SPACE}"
    return f"{mean}{nobreak}±{nobreak}{scale * spread:.{digits}f}"


def value(row: Row | None, key: str) -> tuple[float, float] | None:
    """A value with its standard deviation, for a figure."""
    if row is None or row.get(key) is None:
        return None
    return row[key], row.get(f"{key}_std") or 0.0
