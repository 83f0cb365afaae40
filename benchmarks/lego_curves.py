"""PSNR against seconds on D-NeRF's lego, val split, random initialisation.

    python benchmarks/lego_curves.py [--lego FOLDER] [--seeds 3]

Writes docs/results/lego.md, lego.csv and lego.png. Seconds are the training clock of one process
with nothing else running.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import tempfile
from pathlib import Path
from statistics import fmean, stdev

from figures import panels, save
from runner import RESULTS, Measured, command, lego, machine, markdown, measure

from xplanes.files import write_rows, write_text

CASES = ((100, 30), (200, 30), (400, 60))
"""Pixels and seconds."""

MOMENTS = (0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
"""Shares of the budget after which the field is scored."""

COLUMNS = (
    *("pixels", "planes", "budget, s", "steps", "psnr at a quarter of it", "psnr", "ssim"),
    *("rays/s", "samples per ray"),
)

FOUR_DGS = "https://github.com/riccardolanza05/dynamic-gaussian-splatting-benchmark"
PUBLISHED = (
    ("4DGaussians", f"[independent run]({FOUR_DGS})", "Tesla T4", 800, "83 s", "23.95"),
    ("4DGaussians", f"[independent run]({FOUR_DGS})", "Tesla T4", 800, "26 min", "24.94"),
    (
        "Deformable 3D Gaussians",
        f"[independent run]({FOUR_DGS})",
        "Tesla T4",
        800,
        "85 min",
        "25.06",
    ),
    ("K-Planes", "[NerfAcc](https://www.nerfacc.com)", "GPU", 400, "", "25.18"),
    ("K-Planes", "its public code, run by us", "2 CPU cores (AMD EPYC)", 200, "300 s", "21.6"),
)
"""Others' figures; the last was made here, as the dashed line of the plot was."""

K_PLANES = ((30, 13.0), (60, 13.7), (121, 16.6), (218, 21.0), (300, 21.6))
"""Seconds and PSNR of the public K-Planes code (batch 1024) on two such cores: lego, 200 px, TEST
views, whose shovel differs from training; for orientation, not a like-for-like comparison."""


def train(folder: Path, pixels: int, planes: str, seconds: int, seed: int, work: Path) -> Measured:
    """One run, with all views scored at each of the `MOMENTS`."""
    overrides = [
        *lego(folder),
        "lrm=none",
        f"data.resolution={pixels}",
        f"model={planes}_planes",
        f"seed={seed}",
        f"trainer.max_seconds={seconds}",
        f"callbacks.evaluation.at=[{','.join(map(str, MOMENTS))}]",
        "trainer.accelerator=cpu",
        "media=false",
    ]
    return measure(overrides, work)


def spread(values: list[float], digits: int) -> str:
    """Mean and standard deviation."""
    deviation = f" ± {stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{fmean(values):.{digits}f}{deviation}"


def scored(run: Measured, seconds: float) -> float:
    """PSNR at the evaluation nearest to a number of seconds."""
    row = min(run.curve, key=lambda row: abs(float(row["seconds"]) - seconds))
    return float(row["psnr"])


def line(pixels: int, planes: str, seconds: int, runs: list[Measured]) -> tuple:
    """A row of the table."""
    found = [run.metrics for run in runs]
    return (
        pixels,
        planes,
        seconds,
        f"{fmean(run['step'] for run in found):.0f}",
        spread([scored(run, seconds / 4) for run in runs], 2),
        spread([run["test"]["psnr"] for run in found], 2),
        spread([run["test"]["ssim"] for run in found], 4),
        f"{fmean(run['rays_per_second'] for run in found) / 1000:.0f}k",
        f"{fmean(run['samples_per_ray'] for run in found):.1f}",
    )


def plot(curves: dict[str, list[tuple[float, float]]]) -> None:
    """PSNR against seconds, one line per case."""
    figure, (axes,) = panels(1, 7, 4.2)
    for name, points in curves.items():
        axes.plot(*zip(*points, strict=True), marker="o", markersize=3, label=name)
    axes.plot(
        *zip(*K_PLANES, strict=True),
        color="grey",
        linestyle="--",
        marker="x",
        label="public K-Planes code, 200 px (test views)",
    )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set(xlabel="training clock in seconds", ylabel="PSNR in dB")
    axes.set_title(f"lego, random initialisation; {machine()}", fontsize=9)
    axes.legend(fontsize=8)
    save(figure, "lego")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path, default=Path("data/dnerf/lego"))
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    rows, points, curves = [], [], {}
    with tempfile.TemporaryDirectory() as work:
        for pixels, seconds in CASES:
            for planes in ("six", "nine"):
                case = (pixels, planes, seconds)
                runs = [train(args.lego, *case, seed, Path(work)) for seed in range(args.seeds)]
                rows.append(line(*case, runs))
                print(*rows[-1], flush=True)
                curves[f"{planes} planes, {pixels} px"] = [
                    (share * seconds, fmean(scored(run, share * seconds) for run in runs))
                    for share in MOMENTS
                ]
                for seed, run in enumerate(runs):
                    points += [(*case, seed, row["seconds"], row["psnr"]) for row in run.curve]
    header = ("pixels", "planes", "budget", "seed", "seconds", "psnr")
    write_rows(RESULTS / "lego.csv", header, points)
    published = ("method", "source", "hardware", "pixels", "time", "psnr, test split")
    page = f"""# Lego: PSNR against seconds

Default settings with random initialisation, val split; means of {args.seeds} seeds with their
standard deviation; seconds are training time. {machine()}. `{command()}`

![PSNR against seconds](lego.png)

{markdown(COLUMNS, rows)}

## Published runs

These are of the **test** split, whose shovel is in a different state from the training images:
every method stops at about 25 dB. Scores on the two splits are not comparable.

{markdown(published, list(PUBLISHED))}
"""
    write_text(RESULTS / "lego.md", page)
    plot(curves)


if __name__ == "__main__":
    main()
