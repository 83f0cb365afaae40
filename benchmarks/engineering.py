"""The page "Engineering": where a minute goes, how fast parts are, and what they withstand."""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean, median

import torch
from figures import COLOURS, MARKS, bars, curves, legend, panels, save
from runner import markdown, run_apart
from sections import DATA, Row, Section, number, settings_of
from torch import Tensor
from torch.nn.functional import interpolate

from xplanes.decomposition import robust_pca
from xplanes.lrm.config import PUBLISHED
from xplanes.rendering.grid_renderer import GridRenderer
from xplanes.scenes.datamodule import whole_view
from xplanes.scenes.views import Views
from xplanes.tools.runs import TrainedRun, load_run
from xplanes.training.scores import render_item, score_image

HERE = Path(__file__).parent


def child(script: str, *words: str, threads: int = 1) -> Row:
    """What another script of this folder prints as JSON in its last line.

    Raises:
        RuntimeError: If it fails.
    """
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    line = [sys.executable, str(HERE / script), *words]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{script}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def measure_time(work: Path, quick: bool) -> list[Row]:
    child("where_time_goes.py")  # Compiles the loops, whose time would count.
    return child("where_time_goes.py")["stages"]


def show_time(rows: list[Row]) -> str:
    stages = sorted((row for row in rows if row["seconds"] > 0.05), key=lambda row: -row["seconds"])
    figure, (axes,) = panels(1, 0.22 * len(stages) + 0.8)
    bars(axes, [row["case"] for row in stages], {"": [row["seconds"] for row in stages]})
    axes.set_xlabel("seconds")
    save(figure, "time")
    whole = sum(row["seconds"] for row in rows)
    lines = [
        (row["case"], f"{row['seconds']:.1f}", f"{row['seconds'] / whole:.1%}", row["calls"] or "")
        for row in stages
    ]
    return f"""\
{whole:.0f} s in all; {rows[0]["steps"]} steps, PSNR {rows[0]["psnr"]:.2f} dB.

![Seconds of each stage](time.png)

{markdown(("stage", "seconds", "share", "calls"), lines)}"""


SIZES, SAMPLES, FRAMES, REPEATS = (100, 200, 400, 800), (64, 128, 256), 3, 5
TRAINED = (
    *("data=dnerf", "data.root={dnerf}", "data.scene=lego", "data.eval_split=val"),
    *("data.resolution=200", "lrm=none", "trainer.max_seconds=60", "trainer.accelerator=cpu"),
)


def views_at(run: TrainedRun, size: int) -> tuple[Views, bool]:
    """Views of the scored split at a size, and whether true images of that size exist."""
    whole = replace(run.experiment.data, resolution=None, eval_views=FRAMES)
    native = whole.read((run.split,)).splits[run.split]
    if size <= native.width:
        scene = replace(whole, resolution=size).read((run.split,))
        return scene.splits[run.split], True
    blank = torch.zeros(FRAMES, size, size, 4, dtype=torch.uint8)
    return replace(native, images=blank, intrinsics=native.intrinsics.focal_at(size)), False


@torch.no_grad()
def measure_rendering(work: Path, quick: bool) -> list[Row]:
    folder = work.absolute() / "run"
    lines = [line.format(**{k: v.absolute() for k, v in DATA.items()}) for line in TRAINED]
    run_apart([*lines, "media=false", "logger=none"], folder)
    run, rows = load_run(folder), []
    for size in SIZES[:2] if quick else SIZES:
        views, known = views_at(run, size)
        for samples in SAMPLES:
            renderer = run.module.renderer
            assert isinstance(renderer, GridRenderer)
            parts = (run.module.field, replace(renderer, samples=samples), run.frame)
            items = [whole_view(views, index, run.scene.background) for index in range(FRAMES)]
            render_item(*parts, items[0])
            row: Row = {"case": f"{size} px, {samples}", "pixels": size, "samples": samples}
            row["seconds"] = median(
                min(timed(partial(render_item, *parts, item)) for _ in range(REPEATS))
                for item in items
            )
            if known:
                scores = [score_image(render_item(*parts, item), item) for item in items]
                row["psnr"] = fmean(score.psnr for score in scores)
            rows.append(row)
    return rows


def timed(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def show_rendering(rows: list[Row]) -> str:
    figure, (axes,) = panels(1, 3)
    lines = {
        f"{size} px": [
            (row["seconds"], row["psnr"], 0.0)
            for row in rows
            if row["pixels"] == size and row.get("psnr") is not None
        ]
        for size in SIZES
    }
    curves(axes, {name: points for name, points in lines.items() if points})
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set(
        xlabel=f"seconds per frame with {', '.join(map(str, SAMPLES))} samples", ylabel="PSNR, dB"
    )
    save(figure, "rendering")
    columns = (
        "pixels",
        "samples along the cube's diagonal",
        "seconds per frame",
        "rays/s",
        "PSNR, dB",
    )
    table = [
        (
            *(row["pixels"], row["samples"], number(row, "seconds", 3)),
            *(f"{row['pixels'] ** 2 / row['seconds'] / 1000:.0f}k", number(row, "psnr")),
        )
        for row in rows
    ]
    return f"![PSNR against seconds per frame](rendering.png)\n\n{markdown(columns, table)}"


WEIGHT, PENALTY = 0.009, 0.05
"""The paper's constants."""

STOPS = (2, 4, 6, 8, 10, 12, 14, 16, 20, 25, 32, 40, 50, 64, 80, 100, 128, 160, 220)
METHODS = {"svd": "paper's ADMM, full SVD", "admm": "paper's ADMM, fused", "adaptive": "default"}
BOUND = 1e-3
Point = tuple[int, float, Tensor]


def feature_matrix(frames: int, channels: int = 40, size: int = 64, noise: float = 0.02) -> Tensor:
    """One column of features per frame, root mean square near 1. [channels size size, frames]

    A standing texture with slow drift, two moving discs that hide it, and noise on every entry.
    """
    generator = torch.Generator().manual_seed(0)

    def smooth(cells: int) -> Tensor:
        coarse = torch.randn(1, channels, cells, cells, generator=generator)
        return interpolate(coarse, (size, size), mode="bicubic")[0]

    base = smooth(8) + 0.3 * smooth(24)
    base /= base.square().mean().sqrt()
    drifts = [0.05 * smooth(6) for _ in range(3)]
    colour = 1.5 * torch.randn(channels, 1, 1, generator=generator)
    rows, columns = torch.meshgrid(*[torch.arange(size) / size] * 2, indexing="ij")
    video = torch.empty(frames, channels, size, size)
    for frame in range(frames):
        time = frame / max(frames - 1, 1)
        video[frame] = base
        for order, drift in enumerate(drifts):
            video[frame] += math.sin(2 * math.pi * 0.7 * time * (order + 1) + order) * drift
        discs = (
            (0.5 + 0.3 * math.cos(5 * time), 0.5 + 0.3 * math.sin(5 * time), 0.09, 1.0),
            (0.2 + 0.6 * time, 0.3 + 0.2 * math.sin(9 * time), 0.06, -1.0),
        )
        for x, y, radius, sign in discs:
            inside = (columns - x) ** 2 + (rows - y) ** 2 < radius**2
            shading = 1 + 0.2 * torch.sin(20 * (columns - x))
            video[frame] = torch.where(inside, sign * colour * shading, video[frame])
    video += noise * torch.randn(video.shape, generator=generator)
    return video.flatten(1).mT.contiguous()


def plain(matrix: Tensor, budget: float) -> Iterator[Point]:
    """The paper's Algorithm 1, written plainly: iterations, seconds and the low-rank part."""
    spent = 0.0
    sparse, multiplier = torch.zeros_like(matrix), torch.zeros_like(matrix)
    for iteration in range(1, STOPS[-1] + 1):
        began = time.perf_counter()
        argument = matrix - sparse - multiplier / PENALTY
        left, values, right = torch.linalg.svd(argument, full_matrices=False)
        low_rank = (left * (values - 1 / PENALTY).clamp_min(0)) @ right
        argument = matrix - low_rank - multiplier / PENALTY
        sparse = argument.sign() * (argument.abs() - WEIGHT / PENALTY).clamp_min(0)
        multiplier = multiplier + PENALTY * (low_rank + sparse - matrix)
        spent += time.perf_counter() - began
        if iteration in STOPS:
            yield iteration, spent, low_rank
        if spent > budget:
            return


def package(matrix: Tensor, method: str, budget: float) -> Iterator[Point]:
    """Ours, run anew to each number of iterations."""
    for stop in STOPS:
        began = time.perf_counter()
        found = robust_pca(
            matrix, sparsity_weight=WEIGHT, method=method, tolerance=1e-5, max_iterations=stop,
            progress=False,
        )  # fmt: skip
        seconds = time.perf_counter() - began
        yield stop, seconds, found.low_rank
        if found.converged or seconds > budget:
            return


def objective(low_rank: Tensor, matrix: Tensor) -> float:
    """Objective of the feasible pair (L, Y - L), in float64 by blocks of rows."""
    gram, rest = torch.zeros(matrix.shape[1], matrix.shape[1], dtype=torch.float64), 0.0
    for low, y in zip(low_rank.split(20000), matrix.split(20000), strict=True):
        gram += low.double().mT @ low.double()
        rest += (y.double() - low.double()).abs().sum().item()
    return torch.linalg.eigvalsh(gram).clamp_min(0).sqrt().sum().item() + WEIGHT * rest


def measure_decomposition(work: Path, quick: bool) -> list[Row]:
    """Excess of the objective over the best that was found, against seconds."""
    warnings.simplefilter("ignore")
    rows = []
    for frames in (50,) if quick else (50, 150):
        matrix, budget = feature_matrix(frames), 15.0 if quick else 60.0
        best = robust_pca(
            matrix.double(), sparsity_weight=WEIGHT, tolerance=1e-8, max_iterations=1000,
            progress=False,
        )  # fmt: skip
        optimum = objective(best.low_rank, matrix)
        for method in METHODS:
            points = plain(matrix, budget) if method == "svd" else package(matrix, method, budget)
            curve = [
                (count, seconds, objective(low_rank, matrix) / optimum - 1)
                for count, seconds, low_rank in points
            ]
            row: Row = {"case": f"{frames} frames, {METHODS[method]}", "frames": frames}
            row |= {"method": METHODS[method], "errors": curve, "each": curve[-1][1] / curve[-1][0]}
            rows.append(row)
    return rows


def reached(row: Row) -> float:
    """Seconds after which the objective stays within the bound."""
    seconds = math.inf
    for _, spent, error in reversed(row["errors"]):
        if abs(error) > BOUND:
            break
        seconds = spent
    return seconds


def show_decomposition(rows: list[Row]) -> str:
    sizes = list(dict.fromkeys(row["frames"] for row in rows))
    figure, axes = panels(len(sizes), 2.5 * len(sizes))
    for axis, frames in zip(axes, sizes, strict=True):
        axis.set_xscale("log")
        axis.set_yscale("log")
        for place, row in enumerate(row for row in rows if row["frames"] == frames):
            seconds, errors = zip(*((s, abs(e)) for _, s, e in row["errors"]), strict=True)
            look = {"color": COLOURS[place], "marker": MARKS[place], "markersize": 3}
            axis.plot(seconds, errors, label=row["method"], **look)
        axis.axhline(BOUND, color="0.4", linestyle="--", linewidth=0.8)
        axis.set(ylabel="excess of the objective", title=f"{frames} frames")
        axis.xaxis.set_major_formatter("{x:g}")
    axes[-1].set_xlabel("seconds")
    legend(figure, axes[0], columns=1)
    save(figure, "decomposition")
    columns = ("frames", "method", "seconds per iteration", f"seconds to an excess of {BOUND:g}")
    lines = [
        (
            *(row["frames"], row["method"], number(row, "each", 3)),
            "not reached" if math.isinf(seconds := reached(row)) else f"{seconds:.2f}",
        )
        for row in rows
    ]
    return (
        f"![Error of robust PCA against seconds](decomposition.png)\n\n{markdown(columns, lines)}"
    )


def measure_lrms(work: Path, quick: bool) -> list[Row]:
    rows = []
    for name in list(PUBLISHED)[: 1 if quick else None]:
        with tempfile.TemporaryDirectory() as folder:
            path = str(Path(folder) / "model.safetensors")
            sizes = child("lrm_sizes.py", "write", name, path)
            rows.append({"case": name} | sizes | child("lrm_sizes.py", "load", name, path))
    return rows


def show_lrms(rows: list[Row]) -> str:
    columns = ("model", "parameters", "file, GB", "load, s", "encode, s", "triplane", "peak GB")
    lines = [
        (
            *(row["case"], f"{row['parameters'] / 1e6:.0f} M", number(row, "file", 2, 1e-9)),
            *(number(row, "load", 1), number(row, "encode", 1)),
            *(" x ".join(map(str, row["shape"])), number(row, "peak", 1, 1e-9)),
        )
        for row in rows
    ]
    return markdown(columns, lines)


def tallied(folder: str, quick: bool) -> list[Row]:
    """Counts of the stress tests in a folder, a row for each test.

    Raises:
        RuntimeError: If a test fails.
    """
    return child("tally.py", folder, *(["--short"] if quick else []))["rows"]


def show_stability(rows: list[Row]) -> str:
    return show_counts(
        rows,
        {"cases": "cases", "finite": "finite", "diagnosed": "stopped with a diagnosis"},
        "Extreme values",
    )


def show_faults(rows: list[Row]) -> str:
    return show_counts(
        rows,
        {"cases": "cases", "recovered": "same end", "said": "messages in words"},
        "Faults",
    )


def show_counts(rows: list[Row], keys: dict[str, str], title: str) -> str:
    total = {key: sum(row.get(key) or 0 for row in rows) for key in keys}
    lines = [(row["case"], *(row.get(key) or 0 for key in keys)) for row in rows]
    lines.append(("**all**", *total.values()))
    table = markdown((title, *keys.values()), lines)
    # Python-Markdown leaves tables inside HTML alone without the attribute.
    summary = f"<summary>{total['cases']:,} cases in {len(rows)} kinds</summary>"
    return f'<details markdown="1">{summary}\n\n{table}\n\n</details>'


def constants(**named: object) -> Callable[[], dict[str, Row]]:
    return lambda: {"all": named}


SECTIONS: tuple[Section, ...] = (
    Section(
        name="time",
        settings=lambda: {"default": settings_of(("preparation.cache=null",))},
        measure=measure_time,
        show=show_time,
        checks={"seconds": 0.5},
    ),
    Section(
        name="rendering",
        settings=lambda: {"lego": settings_of(TRAINED)},
        measure=measure_rendering,
        show=show_rendering,
        checks={"seconds": 0.5, "psnr": 0.02},
    ),
    Section(
        name="decomposition",
        settings=constants(weight=WEIGHT, penalty=PENALTY, frames=[50, 150]),
        measure=measure_decomposition,
        show=show_decomposition,
        checks={"each": 0.5},
    ),
    Section(
        name="lrm_sizes",
        settings=lambda: {name: {"architecture": name} for name in PUBLISHED},
        measure=measure_lrms,
        show=show_lrms,
        checks={"peak": 0.2},
    ),
    Section(
        name="stability",
        settings=constants(tests="tests/stress"),
        measure=lambda work, quick: tallied("stress", quick),
        show=show_stability,
        checks={"cases": 0.0},
    ),
    Section(
        name="faults",
        settings=constants(tests="tests/faults"),
        measure=lambda work, quick: tallied("faults", quick),
        show=show_faults,
        checks={"cases": 0.0},
    ),
)
