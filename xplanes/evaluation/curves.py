"""A plot of the runs of a sweep: PSNR against seconds and steps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xplanes.evaluation.sweep import Point, RunRow
from xplanes.evaluation.tabulate import SEED
from xplanes.files import replacing

SCENE = "data.scene"
PLACES = 60
"""Places along an axis at which curves of several seeds are averaged."""


@dataclass(frozen=True)
class Line:
    """One line of a plot: runs that differ in nothing but their seed.

    Attributes:
        scene: Panel that it belongs to.
        label: Settings in which it differs from the others.
        runs: Curves of its runs.
    """

    scene: str
    label: str
    runs: list[tuple[Point, ...]]


def plot_curves(rows: Sequence[RunRow], names: Sequence[str], path: Path) -> bool:
    """Draw PSNR against seconds, preparation included, and against steps, a column per scene.

    Args:
        rows: Runs.
        names: Settings in which they differ.
        path: Picture to write, PNG.

    Returns:
        Whether there was something to draw, and matplotlib (extra ``plots``) to draw it with.
    """
    lines = _lines(rows, names)
    if not lines:
        return False
    try:
        from matplotlib.figure import Figure
        from matplotlib.ticker import LogLocator, NullFormatter
    except ImportError:
        return False
    scenes = list(dict.fromkeys(line.scene for line in lines))
    labels = list(dict.fromkeys(line.label for line in lines))
    across = max(1, round(1.5 * len(scenes)))
    height = 7 + 0.2 * -(-len(labels) // across)
    width = max(1 + 4.2 * len(scenes), 7)
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplots(2, len(scenes), squeeze=False)
    for line in lines:
        column = scenes.index(line.scene)
        for row, (axis, title) in enumerate((("seconds", "seconds"), ("step", "steps"))):
            panel = panels[row][column]
            # Models of unlike speed fill a logarithmic axis evenly; it has no place for 0.
            pairs = [p for p in zip(*_mean_curve(line.runs, axis), strict=True) if p[0] > 0]
            places, values = zip(*pairs, strict=True) if pairs else ((), ())
            panel.set_xscale("log")
            panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            panel.xaxis.set_major_formatter("{x:g}")
            panel.xaxis.set_minor_formatter(NullFormatter())
            panel.plot(
                places, values, label=line.label, color=f"C{labels.index(line.label)}", marker="."
            )
            panel.set_xlabel(f"{title} (preparation included)" if row == 0 else title)
            panel.set_ylabel("PSNR, dB")
            panel.set_title(line.scene)
            panel.grid(alpha=0.3)
    handles = {
        label: handle
        for panel in panels[0]
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        [handles[label] for label in labels],
        labels,
        loc="outside lower center",
        ncols=across,
        fontsize="small",
    )
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    return True


def plot_against(rows: Sequence[RunRow], names: Sequence[str], path: Path) -> bool:
    """Draw final PSNR against a setting that has three values or more, mean over scenes and seeds.

    Args:
        rows: Runs.
        names: Settings in which they differ.
        path: Picture to write, PNG.

    Returns:
        Whether there was one such setting, and matplotlib (extra ``plots``) to draw it with.
    """
    done = [row for row in rows if "psnr" in row.scores]
    found = {name: sorted({_place(row, name) for row in done}) for name in names if name != SEED}
    numeric = [
        name
        for name, places in found.items()
        if len(places) > 2 and all(_is_number(row.settings.get(name)) for row in done)
    ]
    if len(numeric) != 1:
        return False
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return False
    (name,) = numeric
    scores: dict[str, dict[float, list[float]]] = {}
    over = [n for n in names if n not in (SEED, SCENE, name)]
    for row in done:
        label = run_label(row, over)
        scores.setdefault(label, {}).setdefault(_place(row, name), []).append(row.scores["psnr"])
    figure = Figure(figsize=(6, 4), layout="constrained")
    panel = figure.subplots()
    for label, values in scores.items():
        places = sorted(values)
        means = [math.fsum(values[place]) / len(values[place]) for place in places]
        panel.plot([found[name].index(place) for place in places], means, marker=".", label=label)
    ticks = ["all" if place == math.inf else f"{place:g}" for place in found[name]]
    panel.set_xticks(range(len(ticks)), ticks)
    panel.set_xlabel(name)
    panel.set_ylabel("PSNR, dB")
    panel.grid(alpha=0.3)
    panel.legend(fontsize="small")
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    return True


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _place(row: RunRow, name: str) -> float:
    """A setting as a number; null, all of something, lies behind all others."""
    value = row.settings.get(name)
    return float(value) if isinstance(value, int | float) else math.inf


def _lines(rows: Sequence[RunRow], names: Sequence[str]) -> list[Line]:
    over = [name for name in names if name not in (SEED, SCENE)]
    found: dict[tuple[str, str], Line] = {}
    for row in rows:
        if len(row.curve) < 2:
            continue
        scene = str(row.settings.get(SCENE, ""))
        label = run_label(row, over)
        line = found.setdefault((scene, label), Line(scene, label, []))
        line.runs.append(row.curve)
    return list(found.values())


def run_label(row: RunRow, names: Sequence[str]) -> str:
    """A run by the settings in which it differs from others."""
    settings = {name: row.settings.get(name) for name in names}
    parts = [_short(name, value) for name, value in settings.items() if value is not None]
    return ", ".join(parts) or "run"


def _short(name: str, value: Any) -> str:
    if name.endswith(".name"):
        return str(value)
    return f"{name.rsplit('.', 1)[-1]}={value}"


def _mean_curve(runs: Sequence[Sequence[Point]], axis: str) -> tuple[list[float], list[float]]:
    """The mean of curves over what they have in common; a single curve as it is."""
    if len(runs) == 1:
        return [getattr(p, axis) for p in runs[0]], [p.psnr for p in runs[0]]
    first = max(getattr(run[0], axis) for run in runs)
    last = min(getattr(run[-1], axis) for run in runs)
    places = [first + (last - first) * k / (PLACES - 1) for k in range(PLACES)]
    values = [
        math.fsum(interpolate([(getattr(p, axis), p.psnr) for p in run], at) for run in runs)
        / len(runs)
        for at in places
    ]
    return places, values


def interpolate(pairs: Sequence[tuple[float, float]], place: float) -> float:
    """The value of a polyline at a place; its ends go on flat."""
    for (left, low), (right, high) in zip(pairs, pairs[1:], strict=False):
        if place <= right:
            share = (place - left) / (right - left) if right > left else 1.0
            return low + (high - low) * min(max(share, 0.0), 1.0)
    return pairs[-1][1]
