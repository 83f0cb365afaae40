"""Stress table of robust PCA: type x scale x conditioning x frames against a float64 oracle.

    python benchmarks/decomposition_stress.py [--frames 1 2 50 300] [--condition 1e1 1e3 1e6]

Writes docs/results/decomposition_stress.csv, a row for each of these; its page and its plot show
the worst of each type. What is not measured this time keeps its rows.

The oracle is plain ADMM in float64 with a full singular value decomposition; for condition 1e6 its
penalty grows by 1% per iteration, up to tenfold, else it is fixed.
"""

import argparse
import csv
import itertools
import time
import warnings
from collections.abc import Iterator

import torch
from figures import panels, save
from runner import RESULTS, command, machine, markdown
from torch import Tensor

from xplanes.decomposition import robust_pca
from xplanes.files import replacing, write_text

ROWS = 1000


def stress_matrix(frames: int, condition: float) -> Tensor:
    """Low-rank part of the given condition number, 5% large entries, in float64. [ROWS, frames]"""
    generator = torch.Generator().manual_seed(frames)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    left, right = torch.linalg.qr(draw(ROWS, frames)).Q, torch.linalg.qr(draw(frames, frames)).Q
    values = condition ** -torch.linspace(0, 1, frames, dtype=torch.float64)
    low = (left * values) @ right
    hit = torch.rand(ROWS, frames, generator=generator) < 0.05
    return low / low.square().mean().sqrt() + 3 * hit * draw(ROWS, frames)


def oracle(
    matrix: Tensor, weight: float, growth: float, seconds: float
) -> tuple[Tensor, Tensor, float]:
    """L, S and the last relative step."""
    penalty = 0.1 / matrix.square().mean().sqrt().item()
    largest = 10 * penalty
    sparse, multiplier = torch.zeros_like(matrix), torch.zeros_like(matrix)
    norm, begin, step = matrix.norm(), time.time(), torch.tensor(1.0)
    low = sparse
    while step > 1e-10 and time.time() - begin < seconds:
        argument = matrix - sparse - multiplier / penalty
        left, values, right = torch.linalg.svd(argument, full_matrices=False)
        low = (left * (values - 1 / penalty).clamp_min(0)) @ right
        argument = matrix - low - multiplier / penalty
        shrunk = argument.sign() * (argument.abs() - weight / penalty).clamp_min(0)
        gap = low + shrunk - matrix
        multiplier += penalty * gap
        step = (gap.norm() + (shrunk - sparse).norm()) / norm
        sparse = shrunk
        # The multiplier is not scaled by the penalty, so a slow growth needs no correction.
        penalty *= growth if penalty < largest else 1.0
    return low, sparse, step.item()


def objective(low: Tensor, matrix: Tensor, weight: float) -> float:
    return (torch.linalg.svdvals(low).sum() + weight * (matrix - low).abs().sum()).item()


HEAD = f"""# Robust PCA: stress table

{ROWS} rows, tolerance 1e-6, at most 2,000 iterations, weight auto; {machine()}. The low-rank part
has the given condition number, and 5% of the entries are outliers. The columns of types have the
larger error of L and S against float64 ADMM with a full SVD on the same rounded input, relative to
|Y|: the worst over inputs scaled by 1e-6, 1 and 1e6 (half precision: 1). Gap: the worst relative
gap of the objective. Iterations and seconds: maxima. Each case is in `decomposition_stress.csv`.
`{command()}`

![Worst error of each type](decomposition_stress.png)

"""
TYPES = ("float16", "bfloat16", "float32", "float64")
COLUMNS = ("frames", "condition", *TYPES, "gap", "iterations", "s", "converged")
FULL = ("frames", "condition", "type", "scale", "L error", "S error", "gap", "iterations", "s")
FULL += ("converged", "oracle's last step")
SCALES = {
    "float16": (1.0,),
    "bfloat16": (1.0,),
    "float32": (1e-6, 1.0, 1e6),
    "float64": (1e-6, 1.0, 1e6),
}


def rows_of(frames: int, condition: float, seconds: float) -> Iterator[list[str]]:
    matrix = stress_matrix(frames, condition)
    weight = max(ROWS, frames) ** -0.5
    growth = 1.01 if condition > 1e5 else 1.0
    truth = oracle(matrix, weight, growth, seconds)
    for name, scales in SCALES.items():
        kind = getattr(torch, name)
        half = name in ("float16", "bfloat16")
        if half and frames == 300:
            continue
        exact = matrix.to(kind).double() if half else matrix
        low, sparse, step = oracle(exact, weight, growth, seconds) if half else truth
        for scale in scales:
            begin = time.perf_counter()
            result = robust_pca(
                (matrix * scale).to(kind),
                sparsity_weight="auto",
                tolerance=1e-6,
                max_iterations=2000,
                progress=False,
            )
            spent = time.perf_counter() - begin
            found, moved = result.low_rank.double() / scale, result.sparse.double() / scale
            if not (torch.isfinite(found).all() and torch.isfinite(moved).all()):
                raise RuntimeError(f"not finite: {frames} {condition} {name} {scale}")
            errors = [(a - b).norm() / exact.norm() for a, b in ((found, low), (moved, sparse))]
            gap = objective(found, exact, weight) / objective(low, exact, weight) - 1
            yield [
                *(str(frames), f"{condition:.0e}", name, f"{scale:.0e}"),
                *(f"{error.item():.1e}" for error in errors),
                *(f"{gap:.0e}", str(result.iterations), f"{spent:.2f}"),
                *("yes" if result.converged else "no", f"{step:.0e}"),
            ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 2, 50, 300])
    parser.add_argument("--condition", type=float, nargs="+", default=[1e1, 1e3, 1e6])
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    table = RESULTS / "decomposition_stress.csv"
    for frames, condition in itertools.product(options.frames, options.condition):
        seconds = 120.0 if frames == 300 and condition > 1e5 else 45.0
        rows = list(rows_of(frames, condition, seconds))
        done = {tuple(row[:2]) for row in rows}
        if table.exists():
            with table.open(newline="") as file:
                kept = [row for row in csv.reader(file) if row != list(FULL)]
            rows += [row for row in kept if tuple(row[:2]) not in done]
        rows.sort(key=lambda row: (int(row[0]), float(row[1])))
        with replacing(table) as temporary, temporary.open("w", newline="") as file:
            csv.writer(file).writerows([FULL, *rows])
    cases: dict[tuple[str, str], list[list[str]]] = {}
    for row in rows:
        cases.setdefault((row[0], row[1]), []).append(row)
    plot(cases)
    page = [summary(*case, found) for case, found in cases.items()]
    worst = max(error(row) for row in rows if row[2] == "float32")
    tail = f"\n\nWorst float32 error: {worst:.1e}. No NaN or infinity anywhere.\n"
    write_text(RESULTS / "decomposition_stress.md", HEAD + markdown(COLUMNS, page) + tail)


def error(row: list[str]) -> float:
    """The larger of the errors of L and S."""
    return max(float(row[4]), float(row[5]))


def summary(frames: str, condition: str, found: list[list[str]]) -> tuple[str, ...]:
    """The worst of a number of frames and a condition number."""
    errors = {kind: [error(row) for row in found if row[2] == kind] for kind in TYPES}
    gaps = [float(row[6]) for row in found]
    return (
        frames,
        condition,
        *(f"{max(errors[kind]):.1e}" if errors[kind] else "" for kind in TYPES),
        f"{max(gaps, key=abs):.0e}",
        max((row[7] for row in found), key=int),
        max((row[8] for row in found), key=float),
        f"{sum(row[9] == 'yes' for row in found)} of {len(found)}",
    )


def plot(cases: dict[tuple[str, str], list[list[str]]]) -> None:
    """The worst error of each type, a line each, over the cases."""
    figure, (axes,) = panels(1, 8, 4)
    labels = [f"{frames}\n{condition}" for frames, condition in cases]
    for kind in TYPES:
        line = [
            (place, max(errors))
            for place, found in enumerate(cases.values())
            if (errors := [error(row) for row in found if row[2] == kind])
        ]
        axes.semilogy(*zip(*line, strict=True), "o", label=kind, alpha=0.7)
    axes.set_xticks(range(len(labels)), labels, fontsize=8)
    axes.set(xlabel="frames, condition number", ylabel="worst error, relative to |Y|")
    axes.legend(fontsize=8)
    save(figure, "decomposition_stress")


if __name__ == "__main__":
    main()
