"""Plots of the runs of a sweep: PSNR against seconds and steps, or against a setting."""

import importlib.util
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from xplanes.files import replacing
from xplanes.tools.sweep import Point, RunRow, is_number
from xplanes.tools.tabulate import SEED, mean

SCENE = "data.scene"
PLACES = 60
"""Number of positions along an axis at which curves of several seeds are averaged."""


def plot_curves(rows: Sequence[RunRow], names: Sequence[str], path: Path) -> bool:
    """Plot PSNR against seconds, preparation included, and against steps, a column per scene.

    Returns:
        Whether a plot was written: it needs curves and matplotlib (extra ``plots``).
    """
    over = [name for name in names if name not in (SEED, SCENE)]
    lines: dict[tuple[str, str], list[tuple[Point, ...]]] = {}
    for row in rows:
        if len(row.curve) > 1:
            key = str(row.settings.get(SCENE, "")), run_label(row, over)
            lines.setdefault(key, []).append(row.curve)
    if not lines or not importlib.util.find_spec("matplotlib"):
        return False
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    scenes, labels = (list(dict.fromkeys(names)) for names in zip(*lines, strict=True))
    across = max(1, round(1.5 * len(scenes)))
    size = max(1 + 4.2 * len(scenes), 7), 7 + 0.2 * -(-len(labels) // across)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(2, len(scenes), squeeze=False)
    handles = {}
    titles = {"seconds": "seconds (preparation included)", "step": "steps"}
    for ((scene, label), runs), (row, axis) in itertools.product(lines.items(), enumerate(titles)):
        panel = panels[row][scenes.index(scene)]
        # Models differ in speed by orders of magnitude; a logarithmic axis has no 0.
        points = np.transpose(_mean_curve(runs, axis))
        points = points[points[:, 0] > 0]
        colour = f"C{labels.index(label)}"
        (handles[label],) = panel.plot(*points.T, label=label, color=colour, marker=".")
        panel.set(xlabel=titles[axis], ylabel="PSNR, dB", title=scene, xscale="log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.grid(alpha=0.3)
    place: Any = {"loc": "outside lower center", "ncols": across, "fontsize": "small"}
    figure.legend(handles.values(), labels, **place)
    _save(figure, path)
    return True


def plot_against(rows: Sequence[RunRow], names: Sequence[str], path: Path) -> bool:
    """Plot final PSNR, as mean over scenes and seeds, against a setting with at least three values.

    Returns:
        Whether a plot was written: it needs exactly one such setting, and matplotlib.
    """
    done = [row for row in rows if "psnr" in row.scores]
    numeric = {}
    for name in names:
        values = [row.settings.get(name) for row in done]
        if name != SEED and all(value is None or is_number(value) for value in values):
            # null means all, so it is the last value of the axis.
            places = [math.inf if value is None else float(value) for value in values]
            numeric |= {name: places} if len(set(places)) > 2 else {}
    if len(numeric) != 1 or not importlib.util.find_spec("matplotlib"):
        return False
    from matplotlib.figure import Figure

    ((name, places),) = numeric.items()
    ticks = sorted(set(places))
    scores: dict[str, dict[int, list[float]]] = {}
    over = [n for n in names if n not in (SEED, SCENE, name)]
    for row, place in zip(done, places, strict=True):
        values = scores.setdefault(run_label(row, over), {})
        values.setdefault(ticks.index(place), []).append(row.scores["psnr"])
    figure = Figure(figsize=(6, 4), layout="constrained")
    panel = figure.subplots()
    for label, values in scores.items():
        panel.plot(sorted(values), [mean(values[x]) for x in sorted(values)], ".-", label=label)
    words = ["all" if place == math.inf else f"{place:g}" for place in ticks]
    panel.set(xlabel=name, ylabel="PSNR, dB", xticks=range(len(ticks)), xticklabels=words)
    panel.grid(alpha=0.3)
    panel.legend(fontsize="small")
    _save(figure, path)
    return True


def _save(figure: Any, path: Path) -> None:
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def run_label(row: RunRow, names: Sequence[str]) -> str:
    """Label of a run: the settings in which it differs from others."""
    parts = [
        str(value) if name.endswith(".name") else f"{name.rsplit('.', 1)[-1]}={value}"
        for name in names
        if (value := row.settings.get(name)) is not None
    ]
    return ", ".join(parts) or "run"


def _mean_curve(runs: Sequence[Sequence[Point]], axis: str) -> tuple[list[float], list[float]]:
    """The mean of curves over their common range; a single curve is unchanged."""
    curves = [([getattr(p, axis) for p in run], [p.psnr for p in run]) for run in runs]
    if len(curves) == 1:
        return curves[0]
    places = np.linspace(max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves), PLACES)
    return places.tolist(), np.mean([np.interp(places, *curve) for curve in curves], 0).tolist()
