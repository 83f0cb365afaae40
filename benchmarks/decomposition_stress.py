"""Stress table of robust PCA: type x scale x conditioning x frames against a float64 oracle.

    python benchmarks/decomposition_stress.py

The oracle is plain ADMM in float64 with a full singular value decomposition and a fixed penalty.
"""

import time
import warnings
from pathlib import Path

import torch
from torch import Tensor

from xplanes.decomposition import robust_pca

RESULTS = Path(__file__).parent / "results"
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


def oracle(matrix: Tensor, weight: float, seconds: float = 25.0) -> tuple[Tensor, Tensor, float]:
    """L, S and the last relative step."""
    penalty = 0.1 / matrix.square().mean().sqrt().item()
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
    return low, sparse, step.item()


def objective(low: Tensor, matrix: Tensor, weight: float) -> float:
    return (torch.linalg.svdvals(low).sum() + weight * (matrix - low).abs().sum()).item()


def main() -> None:
    warnings.simplefilter("ignore")
    lines = [
        "# Robust PCA: stress table",
        "",
        f"{ROWS} rows, tolerance 1e-6, at most 2,000 iterations, weight auto, two cores, AMD",
        "EPYC. The low-rank part has the given condition number, 5% of the entries are hit. Errors",
        "against float64 ADMM with full SVD on the SAME (rounded) input, relative to |Y|; gap: of",
        "the objective. Step: where the oracle itself stopped. Script:",
        "`benchmarks/decomposition_stress.py`.",
        "",
        "| frames | condition | type | scale | L error | S error | gap | iterations | seconds | converged | oracle step |",  # noqa: E501
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    worst = 0.0
    for frames in (1, 2, 50, 300):
        for condition in (1e1, 1e3, 1e6):
            matrix = stress_matrix(frames, condition)
            weight = max(ROWS, frames) ** -0.5
            truth = oracle(matrix, weight)
            for name, scales in (
                ("float16", (1.0,)),
                ("bfloat16", (1.0,)),
                ("float32", (1e-6, 1.0, 1e6)),
                ("float64", (1e-6, 1.0, 1e6)),
            ):
                kind = getattr(torch, name)
                half = name in ("float16", "bfloat16")
                if half and frames == 300:
                    continue
                exact = matrix.to(kind).double() if half else matrix
                low, sparse, step = oracle(exact, weight) if half else truth
                for scale in scales:
                    begin = time.perf_counter()
                    result = robust_pca(
                        (matrix * scale).to(kind),
                        sparsity_weight="auto",
                        tolerance=1e-6,
                        max_iterations=2000,
                        progress=False,
                    )
                    seconds = time.perf_counter() - begin
                    found, moved = result.low_rank.double() / scale, result.sparse.double() / scale
                    if not (torch.isfinite(found).all() and torch.isfinite(moved).all()):
                        raise RuntimeError(f"not finite: {frames} {condition} {name} {scale}")
                    norm = exact.norm()
                    errors = [
                        ((a - b).norm() / norm).item() for a, b in ((found, low), (moved, sparse))
                    ]
                    worst = max(worst, *errors) if name == "float32" else worst
                    gap = objective(found, exact, weight) / objective(low, exact, weight) - 1
                    lines.append(
                        f"| {frames} | {condition:.0e} | {name} | {scale:.0e} | {errors[0]:.1e} "
                        f"| {errors[1]:.1e} | {gap:.0e} | {result.iterations} | {seconds:.2f} "
                        f"| {'yes' if result.converged else 'no'} | {step:.0e} |"
                    )
                    print(lines[-1], flush=True)
    lines += ["", f"Worst float32 error: {worst:.1e}. No NaN or infinity anywhere."]
    (RESULTS / "decomposition_stress.md").write_text("\n".join(lines) + "\n")
    print(lines[-1])


if __name__ == "__main__":
    main()
