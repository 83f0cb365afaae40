"""Tables of runs: choice of columns, means over seeds, and markdown."""

import json
from collections.abc import Iterable, Sequence
from statistics import stdev
from typing import Any

from xplanes.metrics import mean
from xplanes.tools.sweep import SCORES, RunRow

SEED, SCENE = "seed", "data.scene"
UNLISTED = ("resume", "callbacks.evaluation.at", "media", "trainer.log_every_n_steps")
"""Settings without influence on results."""

SPREAD = ("psnr", "ssim", "psnr_foreground")  # Scores whose standard deviation over seeds is shown.
LONGEST = 120  # Most characters of a cell in markdown; the CSV is not shortened.
Line = dict[str, Any]  # A line of a table by column name: settings as text, scores as numbers.


def differing(rows: Sequence[RunRow]) -> list[str]:
    """Settings in which runs differ, without those determined by the choice of a group or model."""
    known = [row for row in rows if row.settings]
    whole = [row for row in known if not row.missing]
    overridden = {name for row in rows for name in row.overridden}
    found = []
    for name in dict.fromkeys(name for row in known for name in row.settings):
        # For jobs without a run only the overrides are known.
        among = known if name in overridden or name.endswith(".name") else whole
        having = [row for row in among if name in row.settings or not row.missing]
        if len({_text(row.settings.get(name)) for row in having}) < 2 or _unlisted(name):
            continue
        parts = name.split(".")
        groups = [f"{'.'.join(parts[:end])}.name" for end in range(1, len(parts))]
        # A model's configuration also sets values in other groups.
        follows = any(_follows(whole, name, group) for group in (*groups, "model.name"))
        if name in groups or name in overridden or not follows:
            found.append(name)
    return found


def _follows(rows: Sequence[RunRow], name: str, group: str) -> bool:
    """Whether the group's option determines the setting, among runs that have it."""
    having = [row.settings for row in rows if name in row.settings]
    pairs = {(_text(settings.get(group)), _text(settings[name])) for settings in having}
    return len(pairs) == len({choice for choice, _ in pairs})


def _unlisted(key: str) -> bool:
    """Whether a setting has no influence on results, such as output folders."""
    return key in UNLISTED or key.startswith("logger.") or key.endswith(".dirpath")


def run_table(rows: Sequence[RunRow], names: Sequence[str]) -> list[Line]:
    """One line per run."""
    measures = _measures(rows)
    return [
        {
            "run": row.name,
            **_settings(row, names),
            **{name: row.scores.get(name) for name in measures},
            "status": row.status,
        }
        for row in rows
    ]


def _measures(rows: Iterable[RunRow]) -> list[str]:
    """Scores of a table; ``psnr_foreground`` only if any run has it."""
    known = any("psnr_foreground" in row.scores for row in rows)
    return [name for name in SCORES if known or name != "psnr_foreground"]


def _settings(row: RunRow, names: Sequence[str]) -> Line:
    return {name: _text(row.settings[name]) if name in row.settings else "" for name in names}


def run_label(row: RunRow, names: Sequence[str]) -> str:
    """Label of a run: the settings in which it differs from others."""
    parts = [
        str(value) if name.endswith(".name") else f"{name.rsplit('.', 1)[-1]}={value}"
        for name in names
        if (value := row.settings.get(name)) is not None
    ]
    return ", ".join(parts) or "run"


def seed_groups(rows: Sequence[RunRow]) -> list[list[RunRow]]:
    """Groups of finished runs that differ only in their seed; none if all groups have one run.

    Of repeated runs with the same settings and seed, only the first counts.
    """
    groups: dict[str, dict[str, RunRow]] = {}
    for row in rows:
        if row.done and row.settings:
            rest = {k: v for k, v in row.settings.items() if k != SEED and not _unlisted(k)}
            group = groups.setdefault(json.dumps(rest, sort_keys=True, default=str), {})
            group.setdefault(_text(row.settings.get(SEED)), row)
    several = any(len(group) > 1 for group in groups.values())
    return [list(group.values()) for group in groups.values()] if several else []


def seed_table(groups: Sequence[Sequence[RunRow]], names: Sequence[str]) -> list[Line]:
    """One line per setting: means over seeds, and the standard deviation of quality."""
    lines = []
    for group in groups:
        line = _settings(group[0], names) | {"seeds": len(group)}
        for name in _measures(row for group in groups for row in group):
            values = [row.scores[name] for row in group if name in row.scores]
            # No mean if some seeds never reach the PSNR: it would be biased towards fast ones.
            line[name] = mean(values) if len(values) == len(group) else None
            if name in SPREAD:
                line[f"{name}_std"] = stdev(values) if len(values) > 1 else None
        lines.append(line)
    return lines


def decomposition_table(rows: Sequence[RunRow], names: Sequence[str]) -> list[Line]:
    """One line per run with a decomposition.

    Ranks are those of xy, xz and yz; drift and energies are means over the three.
    """
    return [
        {
            "run": row.name,
            **_settings(row, names),
            "rank": "/".join(str(part.get("rank")) for part in row.parts.values()),
            "drift": f"{mean_part([row], 'drift'):.3f}",
            "energy of L, %": f"{100 * mean_part([row], 'low_rank_energy'):.2f}",
            "energy of S, %": f"{100 * mean_part([row], 'sparse_energy'):.2f}",
            "converged": _text(all(part.get("converged") for part in row.parts.values())),
        }
        for row in rows
        if row.parts
    ]


def mean_part(rows: Sequence[RunRow], name: str) -> float:
    """Mean of a value over the decompositions of all runs and orientations; NaN if none has it."""
    values = [part.get(name) for row in rows for part in row.parts.values()]
    return mean([value for value in values if isinstance(value, int | float)])


def shown(lines: Sequence[Line]) -> str:
    """A table in markdown, with scores rounded and standard deviations added where known."""
    names = [name for name in lines[0] if not name.endswith("_std")]
    header = [SCORES[n].heading if n in SCORES else n.removesuffix(".name") for n in names]
    return markdown(header, [[_shown(line, name) for name in names] for line in lines])


def _shown(line: Line, name: str) -> str:
    if name not in SCORES:
        return str(line[name])
    numbers = (line[name], line.get(f"{name}_std"))
    return " ± ".join(format(n, SCORES[name].form) for n in numbers if n is not None)


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table in markdown with aligned columns."""
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


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)
