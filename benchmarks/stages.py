"""Seconds of each stage against the size of its problem, and how they grow.

    python benchmarks/stages.py

Writes docs/results/stages.md, stages.csv and stages.png: encoding, decomposition and conversion of
triplane sequences, lookup in planes forward and backward, marching. Each size is timed in turn with
the others, five rounds over, and the least time counts. Growth is the slope of seconds over size,
both as logarithms.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from decomposition_data import feature_matrix
from figures import panels, save
from runner import RESULTS, command, machine, markdown
from torch import Tensor

from xplanes.decomposition import decompose
from xplanes.decomposition.conversion import space_planes, time_planes
from xplanes.fields.lookup import plane_features
from xplanes.files import write_rows, write_text
from xplanes.lrm.bundled import load_bundled
from xplanes.rendering.marching import march
from xplanes.rendering.occupancy import OccupancyGrid

ROUNDS = 5
SIX = ((0, 1), (0, 2), (1, 2))
"""Pairs of the planes xt, yt, zt."""

COLUMNS = ("stage", "size", "seconds", "per unit, of the smallest", "growth")


@dataclass(frozen=True)
class Stage:
    """Something to time at several sizes.

    Attributes:
        name: What is timed.
        unit: What its size counts.
        sizes: Sizes, the smallest first.
        make: From a size to the call that is timed.
    """

    name: str
    unit: str
    sizes: tuple[int, ...]
    make: Callable[[int], Callable[[], object]]


def triplanes(frames: int, channels: int = 32, size: int = 32) -> Tensor:
    """A sequence with standing and moving parts. [T, 3, C, H, H]"""
    video = feature_matrix(frames, channels, size).mT.view(frames, 1, channels, size, size)
    return video.expand(-1, 3, -1, -1, -1).contiguous()


def encoding(count: int) -> Callable[[], object]:
    model, _ = load_bundled("tiny")
    images = torch.rand(count, 3, 96, 96)

    def call() -> Tensor:
        with torch.inference_mode():
            return model.encode(images)

    return call


def decomposition(sequence: Tensor) -> Callable[[], object]:
    return lambda: decompose(sequence, tolerance=0.003)


def conversion(frames: int) -> Callable[[], object]:
    sequence = triplanes(frames)

    def call() -> None:
        space_planes(sequence)
        time_planes(sequence, plane_set="six")

    return call


def lookup(points: int, resolution: int = 64) -> Callable[[], object]:
    space = torch.randn(3, resolution, resolution, 32, requires_grad=True)
    time_plane = torch.randn(3, 25, resolution, 32, requires_grad=True)
    places, times = 2 * torch.rand(points, 3) - 1, torch.rand(points)

    def call() -> None:
        plane_features(space, time_plane, places, times, SIX).sum().backward()

    return call


def marching(rays: int) -> Callable[[], object]:
    grid = OccupancyGrid(64, 8, step=0.03)
    origins = torch.tensor([[0.0, -3.0, 0.0]]).expand(rays, 3).contiguous()
    aims = torch.nn.functional.normalize(2 * torch.rand(rays, 3) - 1 - origins, dim=-1)
    times, middle = torch.rand(rays), torch.full((rays,), 0.5)
    return lambda: march(origins, aims, times, middle, grid, step=0.03)


STAGES = (
    Stage("encode (tiny)", "pictures", (1, 4, 16), encoding),
    Stage("decompose", "frames", (10, 25, 50, 100, 200), lambda n: decomposition(triplanes(n))),
    Stage("decompose", "channels", (8, 16, 32, 64), lambda n: decomposition(triplanes(30, n))),
    Stage(
        "decompose", "texels a side", (16, 32, 64), lambda n: decomposition(triplanes(30, 32, n))
    ),
    Stage("convert", "frames", (10, 25, 50, 100, 200), conversion),
    Stage("look up and back", "points", (1000, 4000, 16000, 64000), lookup),
    Stage("look up and back", "texels a side", (32, 64, 128, 256, 512), lambda n: lookup(8000, n)),
    Stage("march", "rays", (256, 1024, 4096, 16384), marching),
)


def seconds(stage: Stage) -> list[float]:
    """Least seconds of a call at each size."""
    calls = [stage.make(size) for size in stage.sizes]
    for call in calls:
        call()
    least = [math.inf] * len(calls)
    for _ in range(ROUNDS):
        for index, call in enumerate(calls):
            began = time.perf_counter()
            call()
            least[index] = min(least[index], time.perf_counter() - began)
    return least


def growth(sizes: tuple[int, ...], spent: list[float]) -> float:
    """Slope of the line through the logarithms."""
    x = torch.tensor(sizes, dtype=torch.float64).log()
    y = torch.tensor(spent, dtype=torch.float64).log()
    return float(((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum())


def plot(curves: dict[str, tuple[tuple[int, ...], list[float]]]) -> None:
    """Seconds against size, both relative to the smallest; equal growth is the dotted line."""
    figure, (axes,) = panels(1, 7, 4.2)
    for place, (name, (sizes, spent)) in enumerate(curves.items()):
        relative = [size / sizes[0] for size in sizes]
        dash = "--" if place >= 5 else "-"
        axes.loglog(relative, [s / spent[0] for s in spent], dash, marker="o", ms=3, label=name)
    axes.plot([1, 64], [1, 64], ":", color="0.4", label="in proportion")
    axes.set(xlabel="times the smallest size", ylabel="times the seconds of the smallest")
    axes.legend(fontsize=7)
    save(figure, "stages")


def main() -> None:
    argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0]).parse_args()
    rows, curves = [], {}
    for stage in STAGES:
        print(f"{stage.name}: {stage.unit}", flush=True)
        spent = seconds(stage)
        slope = growth(stage.sizes, spent)
        for index, (size, value) in enumerate(zip(stage.sizes, spent, strict=True)):
            ratio = value / size / (spent[0] / stage.sizes[0])
            last = f"size^{slope:.2f}" if index == len(spent) - 1 else ""
            rows.append((stage.name, f"{size} {stage.unit}", f"{value:.4g}", f"{ratio:.2f}", last))
        curves[f"{stage.name}, {stage.unit}"] = (stage.sizes, spent)
    plot(curves)
    write_rows(RESULTS / "stages.csv", COLUMNS, rows)
    page = f"""# Run time of stages against problem size

Least of {ROUNDS} calls; {machine()}. `{command()}`. Sequences have 30 frames, 32
channels and 32 texels a side, planes 64 texels and 32 channels, lookups 8,000 points, unless
stated otherwise. "growth": the exponent fitted over all sizes of a stage.

![Seconds against size](stages.png)

{markdown(COLUMNS, rows)}
"""
    write_text(RESULTS / "stages.md", page)


if __name__ == "__main__":
    main()
