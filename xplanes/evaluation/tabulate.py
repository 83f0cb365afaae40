"""Rows of runs as tables: which columns they need, means over seeds, and markdown."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from xplanes.evaluation.sweep import MEASURES, RunRow

SEED = "seed"
UNLISTED = (
    "resume",
    "callbacks.evaluation.at",
    "callbacks.evaluation.views",
    "media",
    "trainer.log_every_n_steps",
    "published",
    "sheet",
)
"""Settings that say nothing about a result."""

SPREAD = ("psnr", "ssim", "psnr_thing")
"""Scores whose standard deviation over seeds is shown."""

LABELS = {
    "psnr_thing": "psnr object",
    "start_psnr": "step 0",
    "seconds_to_20": "s to 20 dB",
    "prepare_seconds": "prepare s",
    "train_seconds": "train s",
    "samples_per_ray": "samples/ray",
    "parameters": "params",
}
FORMATS = {
    "psnr": ".2f",
    "psnr_thing": ".2f",
    "start_psnr": ".2f",
    "ssim": ".4f",
    "floaters": ".4f",
    "steps": ".0f",
    "parameters": ",.0f",
}
LONGEST = 120
"""Letters of a status in markdown; the CSV has all of it."""


def align(rows: list[RunRow]) -> list[RunRow]:
    """Settings of jobs without a run, by the names that runs have: ``model`` is ``model.name``."""
    known = {name for row in rows for name in row.settings if name.endswith(".name")}

    def name(key: str) -> str:
        full = f"{key.replace('/', '.')}.name"
        return full if full in known else key

    return [
        replace(row, settings={name(key): value for key, value in row.settings.items()})
        for row in rows
    ]


def differing(rows: Sequence[RunRow]) -> list[str]:
    """Settings in which runs differ, less those that follow from a group or the model."""
    known = [row for row in rows if row.settings]
    whole = [row for row in known if not row.status.startswith("missing")]
    overridden = {name for row in rows for name in row.overridden}
    found = []
    for name in dict.fromkeys(name for row in known for name in row.settings):
        # Jobs without a run know only what was overridden.
        among = known if name in overridden or name.endswith(".name") else whole
        values = {_text(row.settings.get(name)) for row in among if _has(row, name)}
        if len(values) < 2 or _unlisted(name):
            continue
        parts = name.split(".")
        groups = [f"{'.'.join(parts[:end])}.name" for end in range(1, len(parts))]
        # A model brings settings of other groups along.
        follows = any(_follows(whole, name, group) for group in (*groups, "model.name"))
        if name in groups or name in overridden or not follows:
            found.append(name)
    return found


def _has(row: RunRow, name: str) -> bool:
    return name in row.settings or not row.status.startswith("missing")


def _follows(rows: Sequence[RunRow], name: str, group: str) -> bool:
    """Whether the group's name decides the setting, where there is one."""
    having = [row.settings for row in rows if name in row.settings]
    pairs = {(_text(settings.get(group)), _text(settings[name])) for settings in having}
    return len(pairs) == len({choice for choice, _ in pairs})


def run_table(
    rows: Sequence[RunRow], names: Sequence[str], *, exact: bool = False
) -> tuple[list[str], list[list[str]]]:
    """Header and one line per run; ``exact`` keeps all digits, for CSV."""
    measures = _measures(rows)
    header = ["run", *(_label(n, exact) for n in names), *(_label(n, exact) for n in measures)]
    lines = [
        [
            row.name,
            *(_text(row.settings[n]) if n in row.settings else "" for n in names),
            *(_number(row.scores.get(n), n, exact) for n in measures),
            row.status,
        ]
        for row in rows
    ]
    return [*header, "status"], lines


def _measures(rows: Iterable[RunRow]) -> list[str]:
    """Columns of a table: that of the foreground object is there if any run scores it alone."""
    known = any("psnr_thing" in row.scores for row in rows)
    return [name for name in MEASURES if known or name != "psnr_thing"]


def _unlisted(key: str) -> bool:
    """Whether a setting says nothing about a result: where and what a run writes."""
    return key in UNLISTED or key.startswith("logger.") or key.endswith(".dirpath")


def seed_groups(rows: Sequence[RunRow]) -> list[list[RunRow]]:
    """Finished runs that differ in nothing but their seed, if there are two such runs at all.

    Of runs with the same settings and the same seed, which a repetition is, the first counts.
    """
    groups: dict[str, dict[str, RunRow]] = {}
    for row in rows:
        if row.status == "finished" and row.settings and {"psnr", "ssim"} <= row.scores.keys():
            rest = {k: v for k, v in row.settings.items() if k != SEED and not _unlisted(k)}
            group = groups.setdefault(json.dumps(rest, sort_keys=True, default=str), {})
            group.setdefault(_text(row.settings.get(SEED)), row)
    several = any(len(group) > 1 for group in groups.values())
    return [list(group.values()) for group in groups.values()] if several else []


def seed_table(
    groups: Sequence[Sequence[RunRow]], names: Sequence[str], *, exact: bool = False
) -> tuple[list[str], list[list[str]]]:
    """Header and one line per setting; quality with its standard deviation, the rest as means."""
    measures = _measures(row for group in groups for row in group)
    header = [*(_label(n, exact) for n in names), "seeds"]
    for name in measures:
        label = _label(name, exact)
        spread = name in SPREAD
        header += [label, f"{name}_std"] if spread and exact else [label]
    lines = []
    for group in groups:
        settings = group[0].settings
        line = [_text(settings[n]) if n in settings else "" for n in names] + [str(len(group))]
        for name in measures:
            values = [row.scores[name] for row in group if name in row.scores]
            # The mean of those that got there would be best where most did not.
            mean = math.fsum(values) / len(values) if len(values) == len(group) else None
            shown = _number(mean, name, exact)
            if name not in SPREAD:
                line.append(shown)
                continue
            std = _number(_deviation(values), name, exact)
            line += [shown, std] if exact else [f"{shown} ± {std}" if std else shown]
        lines.append(line)
    return header, lines


def decomposition_table(
    rows: Sequence[RunRow], names: Sequence[str]
) -> tuple[list[str], list[list[str]]] | None:
    """Header and one line per run with a decomposition; None if there is no such run.

    Ranks are those of xy, xz and yz; drift and energies are means over the three.
    """
    chosen = [row for row in rows if row.parts]
    if not chosen:
        return None
    lines = []
    for row in chosen:
        parts = list(row.parts.values())
        numbers = [
            f"{_mean_of(parts, 'drift'):.3f}",
            *(f"{100 * _mean_of(parts, f'{name}_energy'):.2f}" for name in ("low_rank", "sparse")),
        ]
        ranks = "/".join(str(part.get("rank")) for part in parts)
        settings = [_text(row.settings[n]) if n in row.settings else "" for n in names]
        converged = _text(all(part.get("converged") for part in parts))
        lines.append([row.name, *settings, ranks, *numbers, converged])
    header = ["run", *(_label(name, False) for name in names), "rank", "drift"]
    return [*header, "energy of L, %", "energy of S, %", "converged"], lines


def _mean_of(parts: Sequence[dict[str, Any]], name: str) -> float:
    values = [part.get(name) for part in parts]
    known = [float(value) for value in values if isinstance(value, int | float)]
    return math.fsum(known) / len(known) if known else math.nan


def mean_rank(rows: Sequence[RunRow]) -> float:
    """Mean rank of the low-rank parts of all runs and orientations; NaN without any."""
    return _mean_of([part for row in rows for part in row.parts.values()], "rank")


def _deviation(values: Sequence[float]) -> float | None:
    """Standard deviation of the population that the values are a sample of; None for one value."""
    if len(values) < 2:
        return None
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (len(values) - 1))


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table whose columns also line up where it is read as text."""
    cells = [[_cell(text) for text in line] for line in (header, *lines)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, ["-" * width for width in widths])
    padded = [
        [text.ljust(width) for text, width in zip(line, widths, strict=True)] for line in cells
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in padded)


def _cell(text: str) -> str:
    text = " ".join(text.split())
    if len(text) > LONGEST:
        text = text[: LONGEST - 3] + "..."
    return text.replace("|", "\\|")


def _label(name: str, exact: bool) -> str:
    return name if exact else LABELS.get(name, name.removesuffix(".name"))


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    return json.dumps(value, default=str)


def _number(value: float | None, name: str, exact: bool) -> str:
    if value is None:
        return ""
    return repr(value) if exact else format(value, FORMATS.get(name, ".1f"))
