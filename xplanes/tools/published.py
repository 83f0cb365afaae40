"""Compares the results of a sweep with published ones, which published.csv lists with sources."""

import math
from collections.abc import Sequence
from pathlib import Path

from xplanes.errors import ConfigError
from xplanes.files import read_rows
from xplanes.metrics import mean
from xplanes.tools.sweep import RunRow
from xplanes.tools.tabulate import differing, markdown, mean_part

KEYS = {"model": "model.name", "lrm": "lrm.name", "sampler": "model.sampler.name"}
"""Columns of published.csv, and the settings that must match them."""

MEANT = ("data.scene", "seed")
"""Settings over which means are taken."""

OWN = ["runs", "psnr", "ssim", "minutes"]
PUBLISHED = ["published", "published ssim", "published minutes", "over", "source"]

Entry = dict[str, str]


def read_published() -> list[Entry]:
    """The published results, on D-NeRF's test split at 400 pixels."""
    return read_rows(Path(__file__).with_name("published.csv"))


def check_published(names: object) -> list[str]:
    """Check names of published tables, and return them.

    Raises:
        ConfigError: If ``names`` is not a list of names of tables in published.csv.
    """
    known = list(dict.fromkeys(entry["table"] for entry in read_published()))
    if not isinstance(names, list) or any(name not in known for name in names):
        raise ConfigError(
            f"hydra.callbacks.table.published={names}: must be a list of some of {', '.join(known)}"
        )
    return names


def beside(rows: Sequence[RunRow], tables: Sequence[str] = ()) -> str | None:
    """Compare means of a sweep's finished runs with published results.

    Published results are matched with runs on D-NeRF's scenes with all views by model, LRM, sampler
    and, if they state it, the resolution of the planes.

    Args:
        rows: Runs of the sweep.
        tables: Published tables to show completely, whatever the data.

    Returns:
        Text and tables in markdown; None if no published result matches.
    """
    entries = [e for e in read_published() if not tables or e["table"] in tables]
    scored = [entry for entry in entries if entry["psnr"]]
    parts = [_ranks(rows, entry) for entry in entries if tables and entry["rank"]]
    if scored and (text := _scores(rows, scored, whole=bool(tables))) is not None:
        parts.insert(0, text)
    return "\n\n".join(parts) or None


def _ranks(rows: Sequence[RunRow], entry: Entry) -> str:
    own = mean_part(rows, "rank")
    over = f"{own:.2f} over these {sum(bool(row.parts) for row in rows)} runs"
    found = over if math.isfinite(own) else "not known of these runs"
    published = f"{entry['rank']} ({entry['source']})"
    return f"Mean rank of the low-rank part: {found}; published: {published}."


def _scores(rows: Sequence[RunRow], entries: Sequence[Entry], *, whole: bool) -> str | None:
    groups: dict[tuple[str, ...], list[RunRow]] = {}
    others = [name for name in differing(rows) if name not in (*KEYS.values(), *MEANT)]
    for row in rows:
        if row.done and (whole or row.settings.get("data.name") == "dnerf"):
            rest = " ".join(f"{n}={row.settings[n]}" for n in others if n in row.settings)
            names = (str(row.settings.get(name)) for name in KEYS.values())
            groups.setdefault((*names, rest) if others else (*names,), []).append(row)
    matched = {key: [e for e in entries if _agrees(runs[0], e)] for key, runs in groups.items()}
    if not groups or not (whole or any(matched.values())):
        return None
    lines = []
    for key, runs in groups.items():
        own = [str(len(runs)), *_means(runs)]
        for entry in matched[key] or [{}]:
            lines.append([*key, *own, *_published(entry)])
            own = [""] * len(OWN)
    header = [*KEYS, *["settings"] * bool(others), *OWN, *PUBLISHED]
    used = [row for runs in groups.values() for row in runs]
    split = ", ".join(sorted({row.split for row in used}))
    text = (
        f"Means of these runs ({_values(used, 'data.scene')}; {split} split, "
        f"{_values(used, 'data.resolution', 'native')} px, views: "
        f"{_values(used, 'data.views', 'all')}, scored: {_values(used, 'data.eval_views', 'all')}) "
        "beside published figures (test split, 400 px, all views), comparable only where scenes, "
        "split, pixels, views and budget are the same. Minutes are those of preparation and "
        f"training:\n\n{markdown(header, lines)}"
    )
    rest = [e for e in entries if not any(e in found for found in matched.values())]
    if whole and rest:
        columns = ["method", "lrm", "resolution"]
        lines = [[*(entry[name] for name in columns), *_published(entry)] for entry in rest]
        text += (
            "\n\nPublished with them, of D-NeRF's scenes; none of these runs has their settings:"
            f"\n\n{markdown([*columns, *PUBLISHED], lines)}"
        )
    return text


def _means(runs: Sequence[RunRow]) -> list[str]:
    """Mean PSNR, SSIM, and minutes of preparation and training."""
    times = [run.scores for run in runs if "train_seconds" in run.scores]
    minutes = [(t.get("prepare_seconds", 0.0) + t["train_seconds"]) / 60 for t in times]
    psnr, ssim = (mean([run.scores[name] for run in runs]) for name in ("psnr", "ssim"))
    return [f"{psnr:.2f}", f"{ssim:.4f}", f"{mean(minutes):.1f}" if minutes else ""]


def _published(entry: Entry) -> list[str]:
    if not entry:
        return [""] * len(PUBLISHED)
    numbers = [entry[name] for name in ("psnr", "ssim", "minutes", "scenes")]
    return [*numbers, f"{entry['table']}, {entry['source']}"]


def _agrees(row: RunRow, entry: Entry) -> bool:
    """Whether a run has the settings of a published result, as far as they are stated."""
    settings = row.settings
    if settings.get("data.name") != "dnerf" or settings.get("data.views") is not None:
        return False
    named = {**KEYS, "resolution": "model.resolution"}
    return bool(entry["model"]) and all(
        not entry[column] or entry[column] == str(settings.get(name))
        for column, name in named.items()
    )


def _values(rows: Sequence[RunRow], name: str, unset: str = "none") -> str:
    values = {row.settings.get(name) for row in rows}
    return ", ".join(sorted(unset if value is None else str(value) for value in values))
