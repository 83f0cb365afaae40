"""Time of the CPU rasteriser of Gaussians, forward and back, against plain torch.

    python benchmarks/gaussian_rasteriser.py [--repeats 15]

Writes docs/results/gaussian_rasteriser.md, gaussian_rasteriser.csv and gaussian_rasteriser.png. The
scene is a ball of Gaussians of random shapes and opacities; the image's colours are differentiated.
Compiled loops and plain torch take turns.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from runner import RESULTS, command, machine, markdown
from torch import Tensor

from xplanes.backend import compiled
from xplanes.baselines.gaussians.camera import Camera
from xplanes.baselines.gaussians.rasteriser import rasterise
from xplanes.files import replacing, write_rows, write_text
from xplanes.scenes.cameras import camera_around

COUNT, SIZE = 20_000, 200
COUNTS = (1_000, 5_000, 20_000, 100_000, 500_000)
SIZES = (100, 200, 400, 800)
PARTS = {
    "projection": ("project",),
    "sorting and binning": ("depth_order", "gather", "count_tiles", "list_tiles", "bin_tiles"),
    "blending": ("blend",),
    "blending, backward": ("blend_backward", "scatter"),
    "projection, backward": ("project_backward",),
}
COLUMNS = (
    *("Gaussians", "pixels a side", "median ms", "best ms"),
    *("CPU ms", "iterations/s at best", "iterations per CPU second"),
)


def scene(count: int, size: int) -> tuple[list[Tensor], Camera]:
    """Gaussians between radii 0.5 and 1, whose areas add up to the same whatever their number."""
    draw = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=-1)
    scale = 0.02 * (COUNT / count) ** 0.5
    given = [
        directions * (0.5 + 0.5 * torch.rand(count, 1, generator=draw)),
        torch.randn(count, 4, generator=draw),
        scale * (0.5 * torch.randn(count, 3, generator=draw)).exp(),
        torch.rand(count, generator=draw),
        torch.rand(count, 3, generator=draw),
    ]
    pose = camera_around(30, 20, 4.0).float()
    sides = {"width": size, "height": size}
    camera = Camera.from_pose(pose, focal=(1.4 * size,) * 2, centre=(0.5 * size,) * 2, **sides)
    return [t.requires_grad_() for t in given], camera


def iteration(given: list[Tensor], camera: Camera) -> None:
    """One image and its gradients."""
    image = rasterise(*given, camera, torch.ones(3))  # type: ignore[misc]
    image.colour.square().mean().backward()
    for leaf in given:
        leaf.grad = None


def spent(work: Callable[[], None]) -> tuple[float, float]:
    """Seconds of the clock, and of all cores."""
    began, busy = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - began, time.process_time() - busy


@contextmanager
def plain_torch() -> Iterator[None]:
    os.environ["XPLANES_CPU_LOOPS"] = "0"
    try:
        yield
    finally:
        del os.environ["XPLANES_CPU_LOOPS"]


def against_torch(repeats: int) -> dict[str, list[tuple[float, float]]]:
    """Seconds of both, taking turns."""
    given, camera = scene(COUNT, SIZE)
    found: dict[str, list[tuple[float, float]]] = {"compiled loops": [], "plain torch": []}
    iteration(given, camera)
    for _ in range(repeats):
        found["compiled loops"].append(spent(lambda: iteration(given, camera)))
        with plain_torch():
            found["plain torch"].append(spent(lambda: iteration(given, camera)))
    return found


def series(count: int, size: int, repeats: int) -> list[tuple[float, float]]:
    given, camera = scene(count, size)
    iteration(given, camera)
    return [spent(lambda: iteration(given, camera)) for _ in range(repeats)]


def parts(repeats: int) -> dict[str, float]:
    """CPU seconds of each part of an iteration, at best."""
    cpu = compiled("xplanes.baselines.gaussians.rasteriser_numba")
    names = {name: part for part, members in PARTS.items() for name in members}
    kept = {name: getattr(cpu, name) for name in names}
    taken: Counter[str] = Counter()

    def timed(name: str) -> Callable[..., Any]:
        def call(*given: Any) -> Any:
            busy = time.process_time()
            result = kept[name](*given)
            taken[names[name]] += time.process_time() - busy
            return result

        return call

    given, camera = scene(COUNT, SIZE)
    best: dict[str, float] = {}
    for name in names:
        setattr(cpu, name, timed(name))
    try:
        for _ in range(repeats):
            taken.clear()
            _, whole = spent(lambda: iteration(given, camera))
            taken["torch: sums, checks, background"] = whole - sum(taken.values())
            best = {part: min(best.get(part, value), value) for part, value in taken.items()}
    finally:
        for name, function in kept.items():
            setattr(cpu, name, function)
    return best


def line(count: int, size: int, found: list[tuple[float, float]]) -> list[Any]:
    clock, busy = zip(*found, strict=True)
    return [
        count,
        size,
        f"{1000 * statistics.median(clock):.1f}",
        f"{1000 * min(clock):.1f}",
        f"{1000 * min(busy):.1f}",
        f"{1 / min(clock):.1f}",
        f"{1 / min(busy):.1f}",
    ]


def plot(rows: list[list[Any]]) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True)
    cases = (
        (0, "Gaussians", f"{SIZE} x {SIZE} pixels", [r for r in rows if r[1] == SIZE]),
        (1, "pixels a side", f"{COUNT} Gaussians", [r for r in rows if r[0] == COUNT]),
    )
    for axis, (column, label, title, chosen) in zip(axes, cases, strict=True):
        chosen = sorted(chosen, key=lambda row: row[column])
        for position, name in ((3, "clock"), (4, "all cores")):
            values = [float(row[position]) for row in chosen]
            axis.loglog([row[column] for row in chosen], values, "o-", label=name)
        places = [row[column] for row in chosen]
        axis.set_xticks(places, [f"{place:,}" for place in places])
        axis.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
        axis.set(xlabel=label, title=title)
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("ms, forward and back")
    axes[0].legend()
    figure.tight_layout()
    with replacing(RESULTS / "gaussian_rasteriser.png") as temporary:
        figure.savefig(temporary, dpi=110, format="png")
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--repeats", type=int, default=15)
    repeats = parser.parse_args().repeats
    pair = against_torch(max(3, repeats // 3))
    ratios = [
        torch_time / loops_time
        for (loops_time, _), (torch_time, _) in zip(*pair.values(), strict=True)
    ]
    compared = [[name, *line(COUNT, SIZE, found)[2:]] for name, found in pair.items()]
    cases = dict.fromkeys([*((n, SIZE) for n in COUNTS), *((COUNT, s) for s in SIZES)])
    rows = [line(*case, series(*case, repeats)) for case in cases]
    split = parts(repeats)
    whole = sum(split.values())
    shares = [(part, f"{1000 * split[part]:.1f}", f"{split[part] / whole:.0%}") for part in split]
    write_rows(RESULTS / "gaussian_rasteriser.csv", COLUMNS, rows)
    plot(rows)
    page = f"""# Gaussian rasteriser on the CPU

A ball of Gaussians of random shapes and opacities; one iteration renders an image and
differentiates it with respect to all parameters. Medians and best of {repeats} iterations by the
clock, which other processes slow down; "CPU" counts the time of this process alone on all cores, at
best. {machine()};
on average {os.getloadavg()[0]:.1f} processes wanted time on them. `{command()}`

## Against plain torch

{COUNT} Gaussians, {SIZE} x {SIZE} pixels, {len(ratios)} iterations of each in turn. Plain torch
takes {statistics.median(ratios):.0f} times as long (median of the pairs; {min(ratios):.0f} to
{max(ratios):.0f}).

{markdown(("", *COLUMNS[2:]), [tuple(row) for row in compared])}

## Cost

{markdown(COLUMNS, [tuple(row) for row in rows])}

![Milliseconds against Gaussians and pixels](gaussian_rasteriser.png)

The Gaussians shrink as their number grows, so that their total area stays constant.

## Where the time goes

{COUNT} Gaussians, {SIZE} x {SIZE} pixels, CPU milliseconds summed over all cores.

{markdown(("part", "CPU ms", "share"), shares)}
"""
    write_text(RESULTS / "gaussian_rasteriser.md", page)
    print(page)


if __name__ == "__main__":
    main()
