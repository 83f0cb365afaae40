"""What the LRM's initialisation gives: PSNR at equal total time, preparation included.

    python benchmarks/initialisation.py [--lego FOLDER] [--seconds 20] [--few-seconds 15]
        [--seeds 3] [--resolution 100] [--together 1] [--work FOLDER]

Writes docs/results/initialisation.md, .csv and .png. Each scene is trained from random
initialisation and from the bundled `tiny`: with all views for --seconds, demo scenes also with five
of them for --few-seconds. The preparation of `tiny` is part of its time: training gets what is
left, and its schedule ends there (total_time.py). Demo scenes bring a video of a fixed camera,
whose frames the LRM sees and random initialisation does not; lego and the suite's scenes have none,
so a field is trained to render them, and both see the same images. Each run is a process of its own
with one thread, and seconds are those of its CPU time (cpu_clock.py); ``--together`` so many run
side by side. On demo scenes both are also trained with the frames of the video among the training
views.
"""

import argparse
import os
import statistics
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from runner import CPU_CLOCK, RESULTS, Measured, command, lego, machine, markdown, run_apart
from total_time import OVERRIDES as WITHIN_TOTAL

from xplanes.files import replacing, write_rows, write_text

DEMOS = ("excavator", "balls")
SUITE = ("half_circle_test",)
VIDEO = "data.train_on_video=true"
STARTS = {
    "none": ("lrm=none",),
    "tiny": ("lrm=tiny",),
    "none, on the video": ("lrm=none", VIDEO),
    "tiny, on the video": ("lrm=tiny", VIDEO),
}
FEW = 5
COLUMNS = (
    *("scene", "views", "initialisation", "preparation, s", "before the first step, dB"),
    *("PSNR, dB", "SSIM", "steps"),
)


class Case(NamedTuple):
    """A scene with its views."""

    scene: str
    overrides: tuple[str, ...]
    views: int | None
    seconds: float


def cases(args: argparse.Namespace) -> list[Case]:
    scenes = {name: (f"data.scene={name}",) for name in DEMOS}
    if args.lego.is_dir():
        scenes["lego (val)"] = tuple(lego(args.lego.resolve()))
    found = {name: ("data=suite", f"data.scene={name}") for name in SUITE}
    every = [Case(name, given, None, args.seconds) for name, given in (scenes | found).items()]
    few = [Case(name, scenes[name], FEW, args.few_seconds) for name in DEMOS]
    return every + few


def measure(case: Case, start: str, seed: int, args: argparse.Namespace) -> Measured:
    """One run, whose preparation and training take the case's seconds."""
    # A stage taken from the cache would cost its run nothing.
    given = [*case.overrides, f"data.resolution={args.resolution}", "preparation.cache=null"]
    given += [*STARTS[start], f"data.views={case.views or 'null'}", f"seed={seed}"]
    given += [f"trainer.max_seconds={case.seconds:g}", "trainer.max_steps=1000000", *WITHIN_TOTAL]
    given += ["callbacks.evaluation.at=[0.0]", "media=false", "logger=none"]
    given += ["trainer.accelerator=cpu"]
    words = start.replace(", ", " ").replace(" ", "_")
    name = f"{case.scene.split()[0]}_{case.views or 'all'}_{words}_{seed}_{case.seconds:g}s"
    return run_apart(given, args.work.absolute() / name, CPU_CLOCK)


def preparation(run: Measured) -> float:
    """Seconds before training that random initialisation does not take."""
    return sum(run.metrics["seconds"]["prepare"].values())


def row(case: Case, start: str, runs: list[Measured]) -> tuple:
    """Means over the seeds, with the standard deviation of PSNR."""
    psnr = [run.metrics["test"]["psnr"] for run in runs]
    spread = f" ± {statistics.stdev(psnr):.2f}" if len(psnr) > 1 else ""
    first = statistics.mean(float(run.curve[0]["psnr"]) for run in runs)
    return (
        *(case.scene, case.views or "all", start),
        f"{statistics.mean(map(preparation, runs)):.1f}",
        f"{first:.2f}",
        f"{statistics.mean(psnr):.2f}{spread}",
        f"{statistics.mean(run.metrics['test']['ssim'] for run in runs):.3f}",
        f"{statistics.mean(run.metrics['step'] for run in runs):.0f}",
    )


def leads(found: dict[tuple[Case, str], list[Measured]], case: Case, start: str) -> list[float]:
    """How far `tiny` is ahead of a random start, in dB, seed by seed."""
    pairs = zip(found[case, start.replace("none", "tiny")], found[case, start], strict=True)
    return [a.metrics["test"]["psnr"] - b.metrics["test"]["psnr"] for a, b in pairs]


def plot(found: dict[tuple[Case, str], list[Measured]]) -> None:
    """Lead of `tiny` in each scene, with all views and with few, without and with the video."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 3.6))
    scenes = list(dict.fromkeys(case.scene for case, _ in found))
    bars = [(views, start) for views in (None, FEW) for start in STARTS if "none" in start]
    for place, (views, start) in enumerate(bars):
        cases = [case for case, name in found if name == start and case.views == views]
        lead = [leads(found, case, start) for case in cases]
        axes.bar(
            [scenes.index(case.scene) + (place - 1.5) * 0.2 for case in cases],
            [statistics.mean(values) for values in lead],
            0.19,
            yerr=[statistics.stdev(values) if len(values) > 1 else 0 for values in lead],
            color=f"C{0 if views is None else 1}",
            alpha=1 if start == "none" else 0.5,
            label=f"{views or 'all'} views{start.removeprefix('none')}",
        )
    axes.axhline(0, color="0.3", linewidth=0.8)
    axes.set_xticks(range(len(scenes)), scenes, rotation=20, ha="right")
    axes.set(ylabel="lead of tiny, dB")
    axes.legend()
    axes.grid(axis="y", alpha=0.3)
    figure.tight_layout()
    with replacing(RESULTS / "initialisation.png") as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path, default=Path("data/dnerf/lego"))
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--few-seconds", type=float, default=15)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--resolution", type=int, default=100)
    parser.add_argument("--together", type=int, default=1, help="runs side by side")
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmarks/initialisation"))
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    pairs = [
        (case, start)
        for case in cases(args)
        for start in STARTS
        if VIDEO not in STARTS[start] or case.scene in DEMOS
    ]
    jobs = [(case, start, seed) for case, start in pairs for seed in range(args.seeds)]
    found: dict[tuple[Case, str], list[Measured]] = {}
    with ThreadPoolExecutor(args.together) as pool:
        measured = pool.map(lambda job: measure(*job, args), jobs)
        for (case, start, _), run in zip(jobs, measured, strict=True):
            runs = found.setdefault((case, start), [])
            runs.append(run)
            if len(runs) == args.seeds:
                print("  ".join(map(str, row(case, start, runs))), flush=True)
    rows = [row(*key, runs) for key, runs in found.items()]
    write_rows(RESULTS / "initialisation.csv", COLUMNS, rows)
    plot(found)
    seeds = f"means of {args.seeds} seeds" if args.seeds > 1 else "one seed"
    text = f"""# What the initialisation gives

    {command()}

Six planes at {args.resolution} pixels; {seeds}; {machine()}. The budget is {args.seconds:g} s of
one core's CPU time with all views and {args.few_seconds:g} s with {FEW}; **it includes the
preparation**, the time that `tiny` alone takes before its first step, and learning rates end with
it. Demo scenes (the first two) have a video of a fixed camera, whose frames the LRM sees and `none`
does not; "on the video" adds them to the training views. The other scenes have no such video: the
preparation trains a field that renders one, and both initialisations see the same images.

![Lead of tiny over random initialisation](initialisation.png)

{markdown(COLUMNS, rows)}
"""
    write_text(RESULTS / "initialisation.md", text)


if __name__ == "__main__":
    main()
