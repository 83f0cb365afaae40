"""Seconds per frame against PSNR: image sizes and samples a ray, of one trained field.

    python benchmarks/rendering.py [--lego FOLDER] [--seconds 60] [--work FOLDER]

Writes docs/results/rendering.md, rendering.csv and rendering.png.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import statistics
import time
from dataclasses import replace
from pathlib import Path

import torch
from figures import panels, save
from runner import RESULTS, command, lego, machine, markdown, run_apart

from xplanes.evaluation.runs import TrainedRun, load_run
from xplanes.files import write_rows, write_text
from xplanes.rendering.grid_renderer import GridRenderer
from xplanes.scenes.datamodule import whole_view
from xplanes.scenes.views import Views
from xplanes.training.scores import mean, render_item, score_view

SIZES = (100, 200, 400, 800)
SAMPLES = (64, 128, 256)
FRAMES, REPEATS = 3, 5
COLUMNS = (
    "pixels",
    "samples along the cube's diagonal",
    "seconds per frame",
    "frames/s",
    "rays/s",
    "psnr",
)


def views_at(run: TrainedRun, size: int) -> tuple[Views, bool]:
    """Views of the scored split at a size, and whether true images of that size exist."""
    whole = replace(run.experiment.data, resolution=None, eval_views=FRAMES)
    native = whole.read((run.split,)).splits[run.split]
    if size <= native.width:
        scene = replace(whole, resolution=size).read((run.split,))
        return scene.splits[run.split], True
    blank = torch.zeros(FRAMES, size, size, 4, dtype=torch.uint8)
    focal = native.intrinsics.focal_at(size)
    return replace(native, images=blank, intrinsics=focal), False


@torch.no_grad()
def measure(run: TrainedRun, size: int, samples: int) -> tuple:
    """One line of the table."""
    renderer = run.module.renderer
    assert isinstance(renderer, GridRenderer)
    renderer = replace(renderer, samples=samples)
    views, known = views_at(run, size)
    parts = (run.module.field, renderer, run.frame)
    background = run.scene.background
    render_item(*parts, whole_view(views, 0, background))
    seconds = []
    for index in range(FRAMES):
        rounds = []
        for _ in range(REPEATS):
            began = time.perf_counter()
            render_item(*parts, whole_view(views, index, background))
            rounds.append(time.perf_counter() - began)
        seconds.append(min(rounds))
    spent = statistics.median(seconds)
    score = ""
    if known:
        score = (
            f"{mean([score_view(*parts, views, i, background)[0].psnr for i in range(FRAMES)]):.2f}"
        )
    return (
        size,
        samples,
        f"{spent:.3f}",
        f"{1 / spent:.1f}",
        f"{size * size / spent / 1000:.0f}k",
        score,
    )


def plot(rows: list[tuple]) -> None:
    """PSNR against seconds a frame: a line for each size, a mark for each number of samples."""
    figure, (axes,) = panels(1, 7, 4)
    for size in SIZES:
        line = [(float(row[2]), float(row[5])) for row in rows if row[0] == size and row[5]]
        if line:
            axes.plot(*zip(*line, strict=True), marker="o", label=f"{size} px")
            for place, samples in zip(line, SAMPLES, strict=True):
                axes.annotate(str(samples), place, (4, -10), textcoords="offset points", size=7)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set(
        xlabel="seconds per frame; labels: samples along the cube's diagonal", ylabel="PSNR, dB"
    )
    axes.legend(fontsize=8)
    save(figure, "rendering")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path, default=Path("data/dnerf/lego"))
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmarks/rendering"))
    args = parser.parse_args()
    name, scene = "lego (val)", lego(args.lego.resolve())
    if not args.lego.is_dir():
        name, scene = "excavator", ["data.scene=excavator", "data.resolution=400"]
    else:
        scene.append("data.resolution=200")
    folder = (args.work / f"{args.seconds:g}s").absolute()
    overrides = ["lrm=none", f"trainer.max_seconds={args.seconds:g}", "trainer.accelerator=cpu"]
    run_apart([*scene, *overrides, "media=false"], folder)
    run = load_run(folder)
    rows = [measure(run, size, samples) for size in SIZES for samples in SAMPLES]
    plot(rows)
    write_rows(RESULTS / "rendering.csv", COLUMNS, rows)
    page = f"""# Rendering: seconds per frame against PSNR

{name}, six planes with random initialisation, trained for {args.seconds:g} s at
{run.scene.splits["train"].width} px with 128 samples along the cube's diagonal. Seconds are the
median over {FRAMES} views of the fastest of {REPEATS} renderings; PSNR is the mean over these
views. {machine()}. `{command()}`

![PSNR against seconds per frame](rendering.png)

{markdown(COLUMNS, rows)}
"""
    write_text(RESULTS / "rendering.md", page)


if __name__ == "__main__":
    main()
