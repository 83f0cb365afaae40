"""Stress table of robust PCA: type x scale x conditioning x frames against a float64 oracle.

    python benchmarks/decomposition_stress.py [--frames 1 2 50 300] [--condition 1e1 1e3 1e6]

Writes results/decomposition_stress.md and .csv beside this file; what is not measured this time
keeps its rows.

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
from runner import RESULTS, command, machine
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
has the given condition number, 5% of the entries are hit. Errors against float64 ADMM with a full
SVD on the SAME (rounded) input, relative to |Y|; gap: of the objective (negative: below the oracle,
which was stopped by the clock). Step: where the oracle stopped. `{command()}`

| frames | condition | type | scale | L error | S error | gap | iterations | s | converged | step |
|---|---|---|---|---|---|---|---|---|---|---|
"""
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
                rows += [row for row in csv.reader(file) if tuple(row[:2]) not in done]
        rows.sort(key=lambda row: (int(row[0]), float(row[1])))
        with replacing(table) as temporary, temporary.open("w", newline="") as file:
            csv.writer(file).writerows(rows)
    worst = max(max(float(row[4]), float(row[5])) for row in rows if row[2] == "float32")
    lines = [f"| {' | '.join(row)} |" for row in rows]
    tail = f"\n\nWorst float32 error: {worst:.1e}. No NaN or infinity anywhere.\n"
    write_text(RESULTS / "decomposition_stress.md", HEAD + "\n".join(lines) + tail)


if __name__ == "__main__":
    main()
