"""Which static and dynamic choice of the conversion is nearest the truth, on made sequences.

    python benchmarks/conversion_options.py

Writes docs/results/conversion_options.md and .png. Each sequence has a known background triplane
(smooth random features, root mean square 1), a moving ball whose features cover the background on
all three planes, a slow flicker of the whole triplane as per-frame predictions have it, and noise.
"""

import argparse
import itertools
import math
import time
import warnings
from collections.abc import Callable
from statistics import fmean

import torch
from figures import bars, panels, save
from runner import RESULTS, command, machine, markdown
from torch import Tensor
from torch.nn.functional import interpolate

from xplanes.decomposition import (
    decompose,
    space_planes,
    sparse_product_loss,
    time_planes,
    unexplained_energy,
)
from xplanes.fields.xplanes import PLANE_SETS
from xplanes.files import write_text

FRAMES, CHANNELS, SIZE = 50, 32, 64
STEPS = (0, 100, 400)
"""After how many steps of Adam the products are compared."""
AXES = ((0, 1), (0, 2), (1, 2))
Path3D = Callable[[float], tuple[float, float, float]]
SEQUENCES: dict[str, tuple[Path3D, float, float]] = {
    "orbiting": (lambda t: (0.6 * math.cos(6 * t), 0.6 * math.sin(6 * t), 0.3), 0.2, 0.0),
    "crossing, large": (lambda t: (1.4 * t - 0.7, 0.2, 0.4 * math.sin(3 * t)), 0.35, 0.0),
    "resting 60% of the time": (
        lambda t: (0.3 + 1.5 * min(0.0, t - 0.4), 0.8 * min(0.0, t - 0.4), -0.2),
        0.2,
        0.0,
    ),
    "waving in place": (lambda t: (0.25 * math.sin(9 * t), 0.0, 0.1 * math.cos(9 * t)), 0.25, 0.0),
    "orbiting, changing features": (
        lambda t: (0.6 * math.cos(6 * t), 0.6 * math.sin(6 * t), 0.3),
        0.2,
        1.0,
    ),
}


def make(name: str) -> tuple[Tensor, Tensor]:
    """A sequence [T, 3, C, H, W] and its background [3, C, H, W]."""
    generator = torch.Generator().manual_seed(7)
    trajectory, radius, turning = SEQUENCES[name]

    def smooth(cells: int) -> Tensor:
        coarse = torch.randn(3, CHANNELS, cells, cells, generator=generator)
        return interpolate(coarse, (SIZE, SIZE), mode="bicubic")

    background = smooth(8) + 0.3 * smooth(24)
    background /= background.square().mean().sqrt()
    flicker = 0.1 * smooth(6)
    colour, other = (1.5 * torch.randn(3, CHANNELS, 1, 1, generator=generator) for _ in range(2))
    grid = (torch.arange(SIZE) + 0.5) / SIZE * 2 - 1
    frames = []
    for frame in range(FRAMES):
        timestep = frame / (FRAMES - 1)
        centre = trajectory(timestep)
        angle = 2 * math.pi * turning * timestep
        features = math.cos(angle) * colour + math.sin(angle) * other
        planes = background + math.sin(2 * math.pi * 1.3 * timestep) * flicker
        for index, (first, second) in enumerate(AXES):
            distance = (grid - centre[first]) ** 2 + (grid[:, None] - centre[second]) ** 2
            cover = torch.sigmoid(8 * (1 - distance.sqrt() / radius))
            texture = 1 + 0.2 * torch.sin(15 * (grid - centre[first]))
            planes[index] = (1 - cover) * planes[index] + cover * features[index] * texture
        frames.append(planes + 0.05 * torch.randn(planes.shape, generator=generator))
    return torch.stack(frames), background


def train(planes: Tensor, sparse: Tensor, plane_set: str, steps: int) -> float:
    """Unexplained energy after steps of Adam on the product loss, four random frames each."""
    planes = planes.clone().requires_grad_()
    optimizer = torch.optim.Adam([planes], lr=0.01)
    generator = torch.Generator().manual_seed(0)
    rows = PLANE_SETS[plane_set]
    for _ in range(steps):
        frames = torch.randint(len(sparse), (4,), generator=generator)
        optimizer.zero_grad()
        sparse_product_loss(planes, sparse, frames, rows=rows).backward()
        optimizer.step()
    return unexplained_energy(planes.detach(), sparse, rows=rows)


def static_errors(triplanes: Tensor, low_rank: Tensor, truth: Tensor) -> dict[str, float]:
    """Relative error of the space planes against the true background, by option."""
    sources = {f"{static} of L": (low_rank, static) for static in ("middle", "median", "mean")}
    sources["median of the input frames"] = (triplanes, "median")
    found = {}
    for name, (sequence, static) in sources.items():
        planes = space_planes(sequence, static=static).permute(0, 3, 1, 2)
        found[name] = ((planes - truth).norm() / truth.norm()).item()
    return found


def dynamic_errors(sparse: Tensor, plane_set: str, dynamic: str) -> tuple[float, list[float]]:
    """Seconds of an initialisation, and what its products do not explain after each of STEPS."""
    generator = torch.Generator().manual_seed(0)
    begin = time.perf_counter()
    planes = time_planes(sparse, plane_set=plane_set, dynamic=dynamic, generator=generator)
    seconds = time.perf_counter() - begin
    return seconds, [train(planes, sparse, plane_set, steps) for steps in STEPS]


def plot(static: dict[str, list[float]], dynamic: dict[str, list[float]]) -> None:
    """Errors of the options, a group of bars for each sequence; weight auto."""
    figure, (left, right) = panels(2, 10, 5, sharey=True)
    bars(left, list(SEQUENCES), static)
    bars(right, list(SEQUENCES), dynamic)
    left.set_xlabel("space planes: relative error")
    right.set_xlabel("time planes: unexplained share of the energy of S")
    for axes in (left, right):
        axes.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1))
    save(figure, "conversion_options")


def main() -> None:
    argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0]).parse_args()
    warnings.simplefilter("ignore")
    static_rows, dynamic_rows = [], []
    totals: dict[float | str, dict[str, list[float]]] = {0.009: {}, "auto": {}}
    left: dict[str, list[float]] = {}
    for name in SEQUENCES:
        triplanes, truth = make(name)
        for weight, total in totals.items():
            parts = decompose(triplanes, sparsity_weight=weight, progress=False)
            report = parts.reports["xy"]
            errors = static_errors(triplanes, parts.low_rank, truth)
            for option, error in errors.items():
                total.setdefault(option, []).append(error)
            about = (report["rank"], f"{report['sparsity']:.2f}", f"{report['drift']:.3f}")
            cells = [f"{error:.4f}" for error in errors.values()]
            static_rows.append((name, weight, *cells, *about))
            print(*static_rows[-1], flush=True)
        for plane_set, dynamic in itertools.product(("six", "nine"), ("random", "rank1")):
            seconds, shares = dynamic_errors(parts.sparse, plane_set, dynamic)
            cells = [f"{share:.3f}" for share in shares]
            dynamic_rows.append((name, plane_set, dynamic, f"{seconds:.2f}", *cells))
            print(*dynamic_rows[-1], flush=True)
            # Rank-1 planes hardly change; random ones explain nothing before they are trained.
            shown = 0 if dynamic == "rank1" else STEPS[-1]
            share = shares[STEPS.index(shown)]
            left.setdefault(f"{plane_set}, {dynamic}, step {shown}", []).append(share)
    for weight, total in totals.items():
        means = [f"**{fmean(errors):.4f}**" for errors in total.values()]
        static_rows.append(("mean", weight, *means, "", "", ""))
    plot(totals["auto"], left)
    options = tuple(totals["auto"])
    static_columns = ("sequence", "sparsity weight", *options, "rank xy", "sparsity xy", "drift xy")
    dynamic_columns = ("sequence", "planes", "initialisation", "seconds")
    dynamic_columns += tuple(f"step {steps}" for steps in STEPS)
    text = f"""# Conversion: error of each option against the ground truth

    {command()}

Synthetic sequences: {FRAMES} frames, {CHANNELS} channels, {SIZE} x {SIZE} texels, one seed.
{machine()}. The plot has the sparsity weight `auto`.

![Errors of the options](conversion_options.png)

## Static: relative error of the space planes against the true background

{markdown(static_columns, static_rows)}

## Dynamic: share of the energy of S (weight auto) that the products do not explain

The products are then optimised with Adam (rate 0.01, four random frames per step).

{markdown(dynamic_columns, dynamic_rows)}
"""
    write_text(RESULTS / "conversion_options.md", text)


if __name__ == "__main__":
    main()
