"""The table and plots of a sweep, and the Hydra callback that writes them."""

import atexit
import importlib.util
import itertools
import math
import os
import re
import sys
import traceback
from collections import Counter
from collections.abc import MutableMapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from xplanes.errors import ConfigError
from xplanes.files import replacing, write_json, write_rows, write_text
from xplanes.metrics import mean
from xplanes.process import say
from xplanes.readers.entries import is_number
from xplanes.tools.published import beside, check_published
from xplanes.tools.sheet import check_what, write_sheet
from xplanes.tools.sweep import Point, RunRow, published_tables, read_rows
from xplanes.tools.tabulate import (
    SCENE,
    SEED,
    decomposition_table,
    differing,
    run_label,
    run_table,
    seed_groups,
    seed_table,
    shown,
)


def write_tables(folder: Path, out: Path | None = None) -> str:
    """Tabulate all runs in a folder.

    Args:
        folder: A sweep, or any folder of runs.
        out: Output folder; ``folder`` when None. It gets table.md, table.csv, table_seeds.csv (if
            there are several seeds), and with the extra ``plots`` curves.png and against.png.

    Returns:
        Content of table.md.

    Raises:
        ConfigError: If there are no runs in the folder.
    """
    rows, out = read_rows(folder), out or folder
    names = differing(rows)
    lines = run_table(rows, names)
    text = [f"# {folder.resolve().name}", f"{_counts(rows)} {_protocol(rows)}".strip()]
    text.append(shown(lines))
    write_rows(out / "table.csv", lines[0], (line.values() for line in lines))
    (out / "table_seeds.csv").unlink(missing_ok=True)
    if seeds := seed_groups(rows):
        means = seed_table(seeds, [name for name in names if name != SEED])
        text += ["Mean and standard deviation over seeds:", shown(means)]
        write_rows(out / "table_seeds.csv", means[0], (line.values() for line in means))
    if (published := beside(rows, published_tables(folder))) is not None:
        text.append(published)
    if parts := decomposition_table(rows, names):
        text += ["Decomposition of the LRM's triplanes (means over xy, xz, yz):", shown(parts)]
    plots = importlib.util.find_spec("matplotlib") is not None
    if plots and len(rows) > 1 and plot_curves(rows, names, out / "curves.png"):
        text.append("![PSNR against seconds and steps](curves.png)")
    if plots and plot_against(rows, names, out / "against.png"):
        text.append("![PSNR at the end](against.png)")
    whole = "\n\n".join(text) + "\n"
    write_text(out / "table.md", whole)
    return whole


def _counts(rows: Sequence[RunRow]) -> str:
    """Number of runs by status, and the split of their scores."""
    kinds = Counter(re.split("[:,;]", row.status)[0] for row in rows)
    tally = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    splits = {row.split for row in rows if row.split}
    scored = f" Scores of the {splits.pop()} split." if len(splits) == 1 else ""
    return f"{len(rows)} runs: {tally}.{scored}"


PROTOCOL = {
    "data.name": ("data", ""),
    "data.resolution": ("width, px", "native"),
    "data.views": ("training views", "all"),
    "data.eval_views": ("scored views", "all"),
    "model.rays.background": ("background", ""),
    "trainer.max_steps": ("steps", ""),
    "trainer.max_seconds": ("seconds", "no limit"),
}
"""Settings of the protocol of training and scoring, each with its name and the word for null."""


def _protocol(rows: Sequence[RunRow]) -> str:
    """The protocol of training and scoring, as far as known: data, budget, machine."""
    known = [row.settings for row in rows if row.settings and not row.missing]
    parts = []
    for key, (name, unset) in PROTOCOL.items():
        values = [settings[key] for settings in known if key in settings]
        if shown := dict.fromkeys(unset if value is None else str(value) for value in values):
            parts.append(f"{name}: {', '.join(shown)}")
    if machines := dict.fromkeys(row.machine for row in rows if row.machine):
        parts.append(f"machine: {'; '.join(machines)}")
    return f"Protocol: {' · '.join(parts)}." if parts else ""


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
    if not lines:
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
    if len(numeric) != 1:
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


def _mean_curve(runs: Sequence[Sequence[Point]], axis: str) -> tuple[list[float], list[float]]:
    """The mean of curves over their common range; a single curve is unchanged."""
    curves = [([getattr(p, axis) for p in run], [p.psnr for p in run]) for run in runs]
    if len(curves) == 1:
        return curves[0]
    places = np.linspace(max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves), PLACES)
    return places.tolist(), np.mean([np.interp(places, *curve) for curve in curves], 0).tolist()


class SweepTable(Callback):
    """Reports the result of each job of a multirun, and writes and prints the table at its end.

    The table is also written at exit, since Hydra does not call ``on_multirun_end`` if a job has
    failed or the sweep was stopped.

    Args:
        published: Published tables to add, whatever the data.
        sheet: Kind of the contact sheet, one of `xplanes.tools.sheet.WHAT`; None for no sheet.
    """

    def __init__(self, published: Sequence[str] = (), sheet: str | None = None) -> None:
        self._folder: Path | None = None
        self._published, self._sheet = list(published), sheet

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            check_published(self._published)
            check_what(self._sheet)
        except ConfigError as error:
            sys.exit(f"error: {error}")  # Hydra turns other exceptions into warnings.
        self._folder = Path(config.hydra.sweep.dir).absolute()
        atexit.register(self._finish)

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        if config.hydra.mode == RunMode.MULTIRUN:
            gpu = choose_gpu(config.hydra.job.num, os.environ)
            if gpu is not None:
                say(f"job {config.hydra.job.num} on GPU {gpu}")

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        if config.hydra.mode != RunMode.MULTIRUN:
            return
        run = Path(config.hydra.runtime.output_dir)
        # The public property raises the job's own error.
        value = job_return._return_value
        if job_return.status != JobStatus.FAILED:
            say(f"job {config.hydra.job.num} finished: psnr {value:.2f}  {run.name}")
            return
        reason = f"{type(value).__name__}: {value}"
        say(f"job {config.hydra.job.num} failed: {reason}  {run.name}")
        if not (run / "run.json").exists():
            write_json(run / "run.json", {"status": "failed", "reason": reason})

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        self._finish()

    def _finish(self) -> None:
        folder, self._folder = self._folder, None
        if folder is None or not folder.is_dir():
            return
        atexit.unregister(self._finish)
        try:
            say(f"\n{write_tables(folder)}\nwrote {folder / 'table.md'} and table.csv")
        except ConfigError:
            return  # No job has begun.
        except Exception:
            # The runs are complete; only their table is missing.
            traceback.print_exc()
            say(f"no table: xplanes table {folder}")
        if self._sheet is None:
            return
        try:
            say(f"wrote {write_sheet(folder, folder / 'sheet.png', what=self._sheet)}")
        except ConfigError as error:
            say(f"no sheet: {error}")


def choose_gpu(job: int, environment: MutableMapping[str, str]) -> str | None:
    """Choose a GPU for a parallel job: job number modulo number of GPUs.

    A process keeps the GPU of its first job, because CUDA reads ``CUDA_VISIBLE_DEVICES`` only once.

    Args:
        job: Number of the job within the sweep.
        environment: Environment; its ``CUDA_VISIBLE_DEVICES`` is read, and set to the chosen GPU.

    Returns:
        The GPU; None if there are fewer than two.
    """
    listed = environment.get("CUDA_VISIBLE_DEVICES")
    if listed is None:
        import torch

        gpus = [str(number) for number in range(torch.cuda.device_count())]
    else:
        gpus = [name.strip() for name in listed.split(",") if name.strip()]
    if len(gpus) < 2:
        return None
    environment["CUDA_VISIBLE_DEVICES"] = gpu = gpus[job % len(gpus)]
    return gpu
