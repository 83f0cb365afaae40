"""Published figures beside a sweep's own: read from a table that names their sources."""

import csv
import math
from collections.abc import Sequence
from importlib import resources

from xplanes.evaluation.sweep import RunRow
from xplanes.evaluation.tabulate import differing, markdown

FILE = "published.csv"
KEYS = {"model": "model.name", "lrm": "lrm.name", "sampler": "model.sampler.name"}
"""Columns of the file that a run must agree with, and its settings of that meaning."""

MEANT = ("data.scene", "seed", "entry")
"""Settings that the means go over."""

HEADER = [
    "runs",
    "psnr",
    "ssim",
    "published",
    "published ssim",
    "minutes",
    "over",
    "source",
]


def read_published() -> list[dict[str, str]]:
    """The published figures: D-NeRF's data, test split, 400 pixels."""
    with resources.files("xplanes.evaluation").joinpath(FILE).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def beside(rows: Sequence[RunRow]) -> str | None:
    """Means of a sweep's finished runs on D-NeRF's scenes beside what was published.

    Args:
        rows: The sweep.

    Returns:
        Words and a table in markdown; None where nothing was published of these models.
    """
    groups: dict[tuple[str, ...], list[RunRow]] = {}
    others = [name for name in differing(rows) if name not in (*KEYS.values(), *MEANT)]
    for row in rows:
        done = row.status == "finished" and {"psnr", "ssim"} <= row.scores.keys()
        if done and row.settings.get("data.name") == "dnerf":
            rest = " ".join(f"{n}={row.settings[n]}" for n in others if n in row.settings)
            key = (*(str(row.settings.get(name)) for name in KEYS.values()), rest)
            groups.setdefault(key, []).append(row)
    published: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for entry in read_published():
        published.setdefault(tuple(entry[name] for name in KEYS), []).append(entry)
    if not {key[:-1] for key in groups} & published.keys():
        return None
    lines = []
    for (*known, rest), runs in groups.items():
        key = [*known, rest] if others else known
        own = [*key, str(len(runs)), _mean(runs, "psnr", ".2f"), _mean(runs, "ssim", ".4f")]
        for entry in published.get(tuple(known), [{}]):
            names = ("psnr", "ssim", "minutes", "scenes", "source")
            lines.append([*own, *(entry.get(name, "") for name in names)])
            own = [*key, "", "", ""]
    used = [row for runs in groups.values() for row in runs]
    scenes, split = _values(used, "data.scene"), ", ".join(sorted({row.split for row in used}))
    pixels, views = _values(used, "data.resolution", "native"), _values(used, "data.views", "all")
    scored = _values(used, "data.eval_views", "all")
    header = [*KEYS, *(["settings"] if others else []), *HEADER]
    return (
        f"Means of these runs ({scenes}; {split} split, {pixels} px, views: {views}, scored: "
        f"{scored}) beside published figures (test split, 400 px, all views), comparable only "
        f"where scenes, split, pixels, views and budget are the same:\n\n{markdown(header, lines)}"
    )


def _mean(runs: Sequence[RunRow], name: str, form: str) -> str:
    return format(math.fsum(row.scores[name] for row in runs) / len(runs), form)


def _values(rows: Sequence[RunRow], name: str, unset: str = "none") -> str:
    values = {row.settings.get(name) for row in rows}
    return ", ".join(sorted(unset if value is None else str(value) for value in values))
