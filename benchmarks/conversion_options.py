"""Which static and dynamic choice of the conversion is nearest the truth, on made sequences.

    python benchmarks/conversion_options.py

Each sequence has a known background triplane (smooth random features, root mean square 1), a
moving ball whose features cover the background on all three planes, a slow flicker of the whole
triplane as per-frame predictions have it, and noise.
"""

import argparse
import math
import time
import warnings
from collections.abc import Callable

import torch
from runner import RESULTS, command, machine
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


def main() -> None:
    argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0]).parse_args()
    warnings.simplefilter("ignore")
    static_rows, dynamic_rows, totals = [], [], {}
    for name in SEQUENCES:
        triplanes, truth = make(name)
        norm = truth.norm()
        for weight in (0.009, "auto"):
            parts = decompose(triplanes, sparsity_weight=weight, progress=False)
            report = parts.reports["xy"]
            errors = {}
            for static in ("middle", "median", "mean"):
                planes = space_planes(parts.low_rank, static=static).permute(0, 3, 1, 2)
                errors[static] = ((planes - truth).norm() / norm).item()
            raw = space_planes(triplanes, static="median").permute(0, 3, 1, 2)
            errors["median of the input frames"] = ((raw - truth).norm() / norm).item()
            for key, value in errors.items():
                totals.setdefault((weight, key), []).append(value)
            cells = " | ".join(f"{value:.4f}" for value in errors.values())
            static_rows.append(
                f"| {name} | {weight} | {cells} | {report['rank']} | {report['sparsity']:.2f} "
                f"| {report['drift']:.3f} |"
            )
            print(static_rows[-1], flush=True)
        for plane_set in ("six", "nine"):
            for dynamic in ("random", "rank1"):
                begin = time.perf_counter()
                planes = time_planes(
                    parts.sparse,
                    plane_set=plane_set,
                    dynamic=dynamic,
                    generator=torch.Generator().manual_seed(0),
                )
                seconds = time.perf_counter() - begin
                cells = [unexplained_energy(planes, parts.sparse, rows=PLANE_SETS[plane_set])]
                cells += [train(planes, parts.sparse, plane_set, steps) for steps in (100, 400)]
                dynamic_rows.append(
                    f"| {name} | {plane_set} | {dynamic} | {seconds:.2f} | "
                    + " | ".join(f"{cell:.3f}" for cell in cells)
                    + " |"
                )
                print(dynamic_rows[-1], flush=True)
    means = [
        f"| mean | {weight} | "
        + " | ".join(f"**{sum(v) / len(v):.4f}**" for (w, _), v in totals.items() if w == weight)
        + " | | | |"
        for weight in (0.009, "auto")
    ]
    lines = [
        "# Conversion: error of each option against the ground truth",
        "",
        f"Synthetic sequences: {FRAMES} frames, {CHANNELS} channels, {SIZE} x {SIZE} texels.",
        f"{machine()}.",
        f"`{command()}`",
        "",
        "## Static: relative error of the space planes against the true background",
        "",
        "| sequence | sparsity weight | middle frame of L | median of L | mean of L "
        "| median of the input frames | rank xy | sparsity xy | drift xy |",
        "|---|---|---|---|---|---|---|---|---|",
        *static_rows,
        *means,
        "",
        "## Dynamic: share of the energy of S (weight auto) that the products do not explain",
        "",
        "The products are then optimised with Adam (rate 0.01, four random frames per step).",
        "",
        "| sequence | planes | initialisation | seconds | step 0 | after 100 steps | after 400 |",
        "|---|---|---|---|---|---|---|",
        *dynamic_rows,
    ]
    write_text(RESULTS / "conversion_options.md", "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
