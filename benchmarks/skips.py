"""What each saving saves, and what it costs: same steps and rays, one saving off at a time.

    python benchmarks/skips.py [--lego FOLDER] [--steps 1000] [--resolution 100] [--seeds 3]
        [--together 1] [--only SAVING ...] [--name skips] [--work FOLDER]

Writes docs/results/NAME.md, NAME.csv and NAME.png. Each run is a process of its own with one
thread, and seconds are its CPU time (cpu_clock.py); ``--together`` sets how many run side by side.
"""

import argparse
import os
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import fmean
from typing import Any

from figures import bars, panels, save
from runner import CPU_CLOCK, RESULTS, command, lego, machine, markdown, run_apart, spread

from xplanes.files import write_rows, write_text

ONE_OFF = {
    "empty space off": ("model.sampler.skip_empty=false",),
    "occlusion off": ("model.sampler.skip_occluded=false",),
    "silhouettes off": ("model.sampler.silhouettes=false",),
    "background off": ("model.rays.skip_background=false",),
}
EVERYTHING = tuple(line for lines in ONE_OFF.values() for line in lines)
SWITCHES: dict[str, tuple[str, ...]] = {"all savings": (), **ONE_OFF, "all off": EVERYTHING}

KINDS = ("empty", "occluded", "background")

PAIRS = {
    "time planes of a static scene": (("data.scene=still_life",), ("data.static=false",), 1),
    "grid in bins of time": (("data.scene=balls",), ("model.sampler.time_bins=1",), 1),
    "initial grid filled": (
        ("data.scene=excavator", "lrm=tiny"),
        ("model.sampler.fill=false",),
        1,
    ),
}
"""Savings beside those of single samples: a scene, what switches it off there, and for how many
times the steps."""

PAIR_COLUMNS = (
    *("saving", "scene", "seconds with", "seconds without", "psnr with", "psnr without"),
    "steps with / without",
)

FIGURES: dict[str, Callable[[dict], float]] = {
    "seconds": lambda run: run["seconds"]["train"],
    "psnr": lambda run: run["test"]["psnr"],
    "ssim": lambda run: run["test"]["ssim"],
    "samples": lambda run: run["samples_per_ray"],
    **{kind: lambda run, kind=kind: run["skipped"][kind] for kind in KINDS},
}

COLUMNS = (
    "scene",
    "savings",
    "seconds",
    "times slower",
    "psnr",
    "psnr change",
    "ssim",
    "samples per ray",
    "empty",
    "occluded",
    "background",
)


def train(name: str, scene: tuple[str, ...], switches: tuple[str, ...], args: Any) -> list[dict]:
    """What runs with equal rays at equal steps measured, one for each seed."""
    overrides = [
        *([] if any(line.startswith("lrm=") for line in scene) else ["lrm=none"]),
        *scene,
        f"data.resolution={args.resolution}",
        f"trainer.max_steps={args.steps}",
        "trainer.max_seconds=null",
        "model.rays.per_batch=512",
        # No limit on samples, so that every run sees the same rays at the same step.
        "model.rays.samples_per_batch=1000000",
        "callbacks.evaluation.at=[]",
        "trainer.accelerator=cpu",
        *switches,
    ]
    return [
        apart(f"{name} {seed}", [*overrides, f"seed={seed}"], args) for seed in range(args.seeds)
    ]


def apart(name: str, overrides: list[str], args: Any) -> dict:
    """The metrics of a run in a process of its own."""
    folder = args.work.absolute() / args.name / re.sub(r"[^a-z0-9]+", "_", name)
    return run_apart([*overrides, "logger=none", "media=false"], folder, CPU_CLOCK).metrics


def plot(found: dict[str, dict[str, dict[str, float]]], name: str) -> None:
    """Seconds and PSNR of each case beside those of the first; a colour for each scene."""
    figure, (slower, better) = panels(2, 9, 4.2, sharey=True)
    first, *labels = next(iter(found.values()))
    ratios, changes = {}, {}
    for scene, runs in found.items():
        base = runs[first]
        ratios[scene] = [runs[label]["seconds"] / base["seconds"] for label in labels]
        changes[scene] = [runs[label]["psnr"] - base["psnr"] for label in labels]
    bars(slower, labels, ratios, start=1)
    bars(better, labels, changes)
    slower.set_xscale("log", base=2)
    slower.xaxis.set_major_formatter("{x:g}")
    slower.set_xlabel(f"times the seconds of {first}")
    better.set_xlabel("change of PSNR, dB")
    better.legend(fontsize=8)
    save(figure, name)


def pair(name: str, args: Any) -> tuple:
    """A row of the second table."""
    scene, off, longer = PAIRS[name]
    several = argparse.Namespace(**(vars(args) | {"steps": longer * args.steps}))
    seconds, scores, steps = [], [], []
    for word, switches in (("with", ()), ("without", off)):
        runs = train(f"{name} {word}", scene, switches, several)
        psnr = [FIGURES["psnr"](run) for run in runs]
        seconds.append(f"{fmean(FIGURES['seconds'](run) for run in runs):.1f}")
        scores.append(f"{fmean(psnr):.2f}{spread(psnr)}")
        steps.append(f"{fmean(run['step'] for run in runs):.0f}")
    return (name, scene[0].split("=")[1], *seconds, *scores, " / ".join(steps))


def preparation(args: Any) -> list[tuple]:
    """Seconds of the preparation with 16 frames: different ones, equal ones, and cached stages."""
    cache = args.work.absolute() / args.name / "cache"
    cases = {
        "16 different frames": ("data.scene=excavator", "preparation.cache=null"),
        "16 equal frames": ("data.scene=still_life", "data.static=false", "preparation.cache=null"),
        "stages cached": ("data.scene=excavator", f"preparation.cache={cache}"),
    }
    rows = []
    for name, overrides in cases.items():
        lines = [*overrides, "trainer.max_steps=1", "callbacks.evaluation.at=[]"]
        for turn in range(2):  # Whatever is made once, the second finds.
            metrics = apart(f"{name} {turn}", [*lines, "trainer.accelerator=cpu"], args)
        # Not the stages' own seconds: of what was kept these are the ones that it once took.
        waited = metrics["seconds"]["total"] - metrics["seconds"]["evaluate"]
        rows.append((name, f"{waited:.1f}", f"{100 * metrics['skipped']['frames']:.0f}%"))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path, default=Path("data/dnerf/lego"))
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--resolution", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=SWITCHES, default=list(SWITCHES))
    parser.add_argument("--pairs", nargs="*", choices=PAIRS, default=list(PAIRS))
    parser.add_argument("--together", type=int, default=1, help="runs side by side")
    parser.add_argument("--name", default="skips")
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmarks/skips"))
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    scenes = {"demo excavator": ("data.scene=excavator",)}
    if args.lego.is_dir():
        scenes["lego (val)"] = tuple(lego(args.lego.resolve()))
    cases = [(name, label) for name in scenes for label in args.only]
    with ThreadPoolExecutor(args.together) as pool:
        trained = pool.map(
            lambda case: train(" ".join(case), scenes[case[0]], SWITCHES[case[1]], args), cases
        )
        pairs = list(pool.map(lambda name: pair(name, args), args.pairs))
        runs = dict(zip(cases, trained, strict=True))
    prepared = preparation(args) if args.pairs else []
    rows, found = [], {}
    for (name, label), metrics in runs.items():
        means = {key: fmean(find(run) for run in metrics) for key, find in FIGURES.items()}
        found.setdefault(name, {})[label] = means
        base = next(iter(found[name].values()))
        rows.append(
            (
                name,
                label,
                f"{means['seconds']:.1f}",
                f"{means['seconds'] / base['seconds']:.2f}",
                f"{means['psnr']:.2f}{spread([FIGURES['psnr'](run) for run in metrics])}",
                f"{means['psnr'] - base['psnr']:+.2f}",
                f"{means['ssim']:.3f}",
                f"{means['samples']:.1f}",
                *(f"{100 * means[kind]:.0f}%" for kind in KINDS),
            )
        )
    write_rows(RESULTS / f"{args.name}.csv", COLUMNS, rows)
    plot(found, args.name)
    page = f"""# Skipped computation: one saving off at a time

![Seconds and PSNR with one saving off]({args.name}.png)

{args.steps} steps of 512 rays, {args.resolution} px, six planes with random initialisation,
{"one seed" if args.seeds == 1 else f"means of {args.seeds} seeds"}; seconds of training are CPU
time of one core; {machine()}. `{command()}`

Columns `empty` and `occluded`: skipped shares of the samples in the cube; `background`: of the
pixels.

All runs use the same number of rays. With background skipping off, the rays cover the whole image.
Most of them hit nothing and are cheap, so this saving improves PSNR rather than seconds.

{markdown(COLUMNS, rows)}
"""
    if pairs:
        page += f"""
## Other savings

Equal step counts for "steps after convergence" mean that the stopping rule did not trigger.

{markdown(PAIR_COLUMNS, pairs)}

## Preparation

Seconds of a run of one step with `lrm=tiny`, without evaluation.

{markdown(("video", "seconds", "duplicate frames, not encoded"), prepared)}

Truncated SVD: see [robust PCA](decomposition_speed.md). Static cells of a moving scene are not
skipped: [why](../decisions.md#what-is-skipped).
"""
    write_text(RESULTS / f"{args.name}.md", page)


if __name__ == "__main__":
    main()
