"""PSNR against seconds on D-NeRF's lego, val split, random initialisation.

    python benchmarks/lego_curves.py [--lego FOLDER]

Writes results/lego.md, lego.csv and lego.png beside this file. Seconds are the training clock of
one process with nothing else running.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import tempfile
from pathlib import Path

from runner import RESULTS, command, lego, machine, markdown, measure

from xplanes.files import replacing, write_rows, write_text

CASES = ((100, 30), (200, 30), (200, 120))
COLUMNS = ("pixels", "planes", "budget s", "steps", "psnr", "ssim", "rays/s", "samples a ray")

K_PLANES = ((30, 13.0), (60, 13.7), (121, 16.6), (218, 21.0), (300, 21.6))
"""Seconds and PSNR of the public K-Planes code (batch 1024) on two such cores: lego, 200 px, TEST
views, whose shovel differs from training; for orientation, not a like-for-like comparison."""


def plot(curves: dict[str, list[tuple[float, float]]]) -> None:
    """PSNR against seconds, one line per run."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.2))
    for name, points in curves.items():
        seconds, psnr = zip(*points, strict=True)
        axes.plot(seconds, psnr, marker="o", markersize=3, label=name)
    axes.plot(
        *zip(*K_PLANES, strict=True),
        color="grey",
        linestyle="--",
        marker="x",
        label="public K-Planes code, 200 px (test views)",
    )
    axes.set_xscale("log")
    axes.set(xlabel="training clock in seconds", ylabel="PSNR in dB")
    axes.set_title(f"lego, random initialisation; {machine()}", fontsize=9)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.tight_layout()
    with replacing(RESULTS / "lego.png") as temporary:
        figure.savefig(temporary, dpi=130, format="png")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path, default=Path("data/dnerf/lego"))
    args = parser.parse_args()
    rows, points, curves = [], [], {}
    with tempfile.TemporaryDirectory() as work:
        for pixels, seconds in CASES:
            for planes in ("six", "nine"):
                result = measure(
                    [
                        *lego(args.lego),
                        "lrm=none",
                        f"data.resolution={pixels}",
                        f"model={planes}_planes",
                        f"trainer.max_seconds={seconds}",
                        "trainer.accelerator=cpu",
                        "media=false",
                    ],
                    Path(work),
                )
                metrics = result.metrics
                rows.append(
                    (
                        pixels,
                        planes,
                        seconds,
                        metrics["step"],
                        f"{metrics['test']['psnr']:.2f}",
                        f"{metrics['test']['ssim']:.4f}",
                        f"{metrics['rays_per_second'] / 1000:.0f}k",
                        f"{metrics['samples_per_ray']:.1f}",
                    )
                )
                name = f"{planes} planes, {pixels} px, {seconds} s"
                curve = [(float(r["seconds"]), float(r["psnr"])) for r in result.curve]
                curves[name] = [point for point in curve if point[0] > 0]
                points += [(pixels, planes, seconds, *point) for point in curve]
    header = ("pixels", "planes", "budget", "seconds", "psnr")
    write_rows(RESULTS / "lego.csv", header, points)
    page = f"""# lego, val split, random initialisation

Default settings, {machine()}. `{command()}`

{markdown(COLUMNS, rows)}

## PSNR over the training clock

![PSNR against seconds](lego.png)

{markdown(header, [(*p[:3], f"{p[3]:.1f}", f"{p[4]:.2f}") for p in points])}
"""
    write_text(RESULTS / "lego.md", page)
    plot(curves)


if __name__ == "__main__":
    main()
