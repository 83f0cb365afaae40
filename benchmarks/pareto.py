"""PSNR against seconds and memory: planes, initialisations, sampling, precision, baselines.

    python benchmarks/pareto.py [--lego FOLDER] [--seconds 20] [--resolution 100] [--together 1]
        [--work FOLDER]

Writes docs/results/pareto.md, pareto.csv, pareto_points.csv and pareto.png. Every run is a process
of its own with one thread, and seconds are those of its CPU time (cpu_clock.py); the preparation
is part of them, and schedules end with them (total_time.py). ``--together`` sets how many run side
by side, and those kept in the work folder are not repeated.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import itertools
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from figures import panels, save
from runner import CPU_CLOCK, RESULTS, Measured, command, lego, machine, markdown, run_apart
from total_time import OVERRIDES as WITHIN_TOTAL

from xplanes.files import write_rows, write_text

SMALLER = (
    "model/sampler=occupancy",
    "model.scales=[2]",
    "model.warmup_steps=50",
    "model.rays.per_batch=1024",
    "model.rays.samples_per_batch=8192",
    "model.rays.skip_background=true",
    "model.rays.background=white",
)
"""K-Planes at a size that learns within a minute on a CPU."""

FIRST = 1.0
"""Seconds from which runs are compared: nobody looks at a picture earlier."""

MARGIN = 0.05
"""Decibels by which a run may be behind and still count as the best: less than a seed makes."""

SELDOM = ("callbacks.evaluation.at=[0.5,1.0]", "trainer.limit_val_batches=2")
"""How often a baseline is scored: a picture takes it seconds."""

CASES: dict[str, tuple[str, ...]] = {
    "six, tiny (default)": (),
    "six, mini": ("lrm=mini",),
    "six, random": ("lrm=none",),
    "nine, tiny": ("model=nine_planes",),
    "nine, random": ("model=nine_planes", "lrm=none"),
    "six, random, 32 texels": ("lrm=none", "model.resolution=32"),
    "six, random, 128 texels": ("lrm=none", "model.resolution=128"),
    "six, random, 256 texels": ("lrm=none", "model.resolution=256"),
    "six, random, 64 samples": ("lrm=none", "model.sampler.samples=64"),
    "six, random, 256 samples": ("lrm=none", "model.sampler.samples=256"),
    "six, random, float32": ("lrm=none", "model.precision=32"),
    "six, random, bfloat16": ("lrm=none", "model.precision=bf16"),
    "K-Planes, smaller, our grid": ("model=kplanes", *SMALLER, *SELDOM),
    "K-Planes": ("model=kplanes", *SELDOM),
    "K-Planes, our grid": ("model=kplanes", "model/sampler=occupancy", *SELDOM),
    "TiNeuVox-S": ("model=tineuvox_s", *SELDOM),
    "Tensor4D, density": ("model=tensor4d_density", *SELDOM),
    "4D-GS": ("model=gaussians_hexplane", "lrm=none"),
    "4D-GS, from a field": ("model=gaussians_hexplane", "lrm=field"),
    "Deformable 3DGS": ("model=gaussians_deform", "lrm=none"),
    "Spacetime GS": ("model=gaussians_spacetime", "lrm=none"),
}

COLUMNS = (
    "scene",
    "run",
    "on front",
    "psnr",
    "ssim",
    "prepare s",
    "train s",
    "steps",
    "rays/s",
    "samples a ray",
    "parameters",
    "peak MB",
)


def slug(name: str) -> str:
    """A case as the name of its folder."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def points(result: Measured) -> list[tuple[float, float]]:
    """Seconds, preparation included, and PSNR along a run."""
    prepared = sum(result.metrics["seconds"]["prepare"].values())
    return [(prepared + float(row["seconds"]), float(row["psnr"])) for row in result.curve]


def on_front(name: str, curves: dict[str, list[tuple[float, float]]], budget: float) -> bool:
    """Whether a run was at some time from `FIRST` to the budget as good as the best, to `MARGIN`.

    Between two scores a run lies on the line between them; before its first one it has nothing.
    What a last step takes beyond the budget does not count.
    """
    seconds = np.geomspace(FIRST, budget, 200)
    values = {
        run: np.interp(seconds, *zip(*curve, strict=True), left=-np.inf)
        for run, curve in curves.items()
    }
    best = np.max(list(values.values()), axis=0)
    return bool((values[name] >= best - MARGIN).any())


def plot(scenes: dict[str, dict[str, list[tuple[float, float]]]], budget: float) -> None:
    """One panel per scene: runs on the front in colour, the others in grey."""
    figure, all_axes = panels(len(scenes), 7, 3.6 * len(scenes), rows=len(scenes))
    best = {
        scene: [name for name in curves if on_front(name, curves, budget)]
        for scene, curves in scenes.items()
    }
    names = dict.fromkeys(name for found in best.values() for name in found)
    # Without C7, which is grey.
    colours = dict(zip(names, itertools.cycle(f"C{n}" for n in range(10) if n != 7), strict=False))
    for axes, (scene, curves) in zip(all_axes, scenes.items(), strict=True):
        for name, curve in curves.items():
            seen = [point for point in curve if point[0] > 0]
            front = name in best[scene]
            axes.plot(
                *zip(*seen, strict=True),
                marker="o",
                markersize=3,
                label=name if front or name == next(iter(curves)) else None,
                color=colours[name] if front else "0.75",
                **({} if front else {"linewidth": 0.8, "zorder": 0}),
            )
        axes.set_xscale("log")
        axes.set(title=scene, xlabel="seconds, preparation included", ylabel="PSNR in dB")
        axes.legend(fontsize=7, loc="lower right")
    figure.suptitle(f"grey: never as good as the best; {machine()}", fontsize=8)
    save(figure, "pareto")


def line(scene: str, name: str, result: Measured, front: bool) -> tuple:
    metrics = result.metrics
    return (
        scene,
        name,
        "yes" if front else "",
        f"{metrics['test']['psnr']:.2f}",
        f"{metrics['test']['ssim']:.4f}",
        f"{sum(metrics['seconds']['prepare'].values()):.1f}",
        f"{metrics['seconds']['train']:.1f}",
        metrics["step"],
        f"{metrics['rays_per_second'] / 1000:.1f}k" if metrics["rays_per_second"] else "",
        f"{metrics['samples_per_ray']:.1f}" if metrics["samples_per_ray"] else "",
        f"{metrics['parameters'] / 1e6:.1f} M",
        f"{metrics['peak_memory_bytes'] / 2**20:.0f}",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path, default=Path("data/dnerf/lego"))
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--resolution", type=int, default=100)
    parser.add_argument("--together", type=int, default=1, help="runs side by side")
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmarks/pareto"))
    args = parser.parse_args()
    scenes = {"excavator": ["data.scene=excavator"]}
    if args.lego.is_dir():
        scenes = {"lego": lego(args.lego.resolve())} | scenes
    common = [
        f"data.resolution={args.resolution}",
        f"trainer.max_seconds={args.seconds}",
        *WITHIN_TOTAL,
        "trainer.max_steps=1000000",
        "trainer.accelerator=cpu",
        "media=false",
        "trainer.limit_val_batches=4",
        "data.eval_views=5",
        # A stage taken from the cache would cost its run nothing.
        "preparation.cache=null",
    ]

    def train(scene: str, name: str) -> Measured:
        print(f"{scene}: {name}", flush=True)
        folder = args.work / f"{scene}_{args.resolution}px_{args.seconds:g}s" / slug(name)
        overrides = [*scenes[scene], *common, *CASES[name]]
        return run_apart(overrides, folder.absolute(), CPU_CLOCK)

    with ThreadPoolExecutor(args.together) as pool:
        runs = {scene: {n: pool.submit(train, scene, n) for n in CASES} for scene in scenes}
        results = {s: {n: run.result() for n, run in named.items()} for s, named in runs.items()}
    curves = {s: {n: points(run) for n, run in named.items()} for s, named in results.items()}
    rows = [
        line(scene, name, result, on_front(name, curves[scene], args.seconds))
        for scene, named in results.items()
        for name, result in named.items()
    ]
    write_rows(RESULTS / "pareto.csv", COLUMNS, rows)
    along = [
        (scene, name, f"{second:.2f}", f"{value:.3f}")
        for scene, runs in curves.items()
        for name, curve in runs.items()
        for second, value in curve
    ]
    write_rows(RESULTS / "pareto_points.csv", ("scene", "run", "seconds", "psnr"), along)
    page = f"""# PSNR against seconds

{args.seconds:g} s for each run, preparation included, in CPU time of one core; learning rates end
there. {args.resolution} px, five views of the test split (lego: val), one seed; {machine()}.
"on front": at some time up to {args.seconds:g} s the run is within {MARGIN:g} dB of the best; PSNR
is interpolated linearly between evaluations. A run ends with its first step beyond the budget, and
baselines have steps of seconds. What all runs do to build their field does not count; Gaussians on
the visual hull find it then, in about half a second. During training four views are scored; for
baselines two, and less often. Runs initialised from the LRM see frames of a video that the others
do not, except on lego, which has none ([effect of these frames](initialisation.md)). `smaller` is
K-Planes at a size that learns within a minute on a CPU; `our grid` replaces the published sampler
by the occupancy grid of X-Planes; `from a field` places Gaussians on the surfaces of a six-plane
field that is trained beforehand (`lrm=field`).

    {command()}

![PSNR against seconds](pareto.png)

{markdown(COLUMNS, rows)}
"""
    write_text(RESULTS / "pareto.md", page)
    plot(curves, args.seconds)


if __name__ == "__main__":
    main()
