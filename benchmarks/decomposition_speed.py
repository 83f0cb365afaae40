"""Run time against error of robust PCA, method by method.

    python benchmarks/decomposition_speed.py [--frames 50 ...] [--weight 0.009 ...] [--part svd ...]
        [--budget SECONDS]

Writes results/decomposition_speed.md, .png and two .csv beside this file; what is not measured this
time keeps its rows. Parts: reference (first, once per matrix: long, float64), then svd (the paper's
ADMM with a full singular value decomposition), gram (the same with the Gram matrix), and the
package's adaptive and admm: errors after a number of iterations, tolerance 1e-5. Then clock:
all methods in turn, several rounds, the least time of each, because other work on the machine only
ever adds to it.
"""

import argparse
import math
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from decomposition_data import feature_matrix
from decomposition_speed_report import CLOCK, TABLE, report
from torch import Tensor

from xplanes.decomposition import RobustPCA, robust_pca
from xplanes.decomposition.admm import Step, Workspace, iterate, shrinkage_from_gram, start
from xplanes.files import read_rows, write_rows

PARTS = ("reference", "svd", "gram", "adaptive", "admm", "clock")
CLOCKED = {"svd": (1, 3), "gram": (1, 3), "admm": (8, 24), "adaptive": (8, 24)}
FIELDS = (
    *("frames", "weight", "part", "iterations", "seconds"),
    *("residual", "objective", "low_rank", "sparse", "rank"),
)
CLOCK_FIELDS = ("frames", "weight", "part", "iterations", "seconds")
STOPS = (
    *(2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 23, 26, 29, 32, 36, 40, 45, 50, 56, 64),
    *(72, 84, 96, 112, 128, 150, 180, 220),
)
Point = tuple[int, float, Tensor, Tensor, int]


def squared(*parts: Tensor, signs: tuple[int, ...] = (1,)) -> float:
    """Squared norm of a signed sum, in float64 by blocks."""
    total = 0.0
    for blocks in zip(*(part.split(20000) for part in parts), strict=True):
        summed = sum(sign * block.double() for sign, block in zip(signs, blocks, strict=True))
        total += torch.as_tensor(summed).square().sum().item()
    return total


def objective(low_rank: Tensor, matrix: Tensor, weight: float) -> float:
    """Objective of the feasible pair (L, Y - L)."""
    gram, rest = 0, 0.0
    for low, y in zip(low_rank.split(20000), matrix.split(20000), strict=True):
        gram = gram + low.double().mT @ low.double()
        rest += (y.double() - low.double()).abs().sum().item()
    return torch.linalg.eigvalsh(gram).clamp_min(0).sqrt().sum().item() + weight * rest


def make_reference(matrix: Tensor, weight: float, seconds: float, path: Path) -> None:
    """Long float64 run; its multiplier, made feasible, bounds the optimum from below."""
    y = matrix.double()
    state = torch.empty_like(y)
    work = Workspace(y, state)
    gram, penalty, before, count, begin = start(work), 0.03, 0.03, 0, time.time()
    while True:
        basis, factors, _ = shrinkage_from_gram(gram, 1 / penalty)
        old, limit, rescale = weight / before, weight / penalty, before / penalty
        if time.time() - begin > seconds:
            break
        after = penalty * 1.01 if 20 < count < 200 else penalty
        step = Step(basis, factors, old, limit, rescale, penalty / after, relaxation=1.6)
        gram, _ = iterate(work, step, norms=False, changes=False)
        before, penalty, count = penalty, after, count + 1
    # One plain step that keeps the state, and with it the multiplier.
    clipped = state.clamp(-old, old)
    low_rank = (y - state + (1 + rescale) * clipped) @ ((basis * factors) @ basis.mT)
    state = y - low_rank + rescale * clipped
    dual = penalty * state.clamp(-limit, limit)
    sparse = state - dual / penalty
    spectral = torch.linalg.eigvalsh(dual.mT @ dual)[-1].sqrt().item()
    lower = (y * dual).sum().item() / max(1.0, spectral, dual.abs().max().item() / weight)
    value = objective(low_rank, y, weight)
    print(
        f"reference: {count} iterations, objective {value:.9g}, dual bound {lower:.9g}, "
        f"gap {value / lower - 1:.1e}, rank {len(factors)}",
        flush=True,
    )
    parts = {"low_rank": low_rank.float(), "sparse": sparse.float(), "objective": value}
    torch.save(parts, path)


def plain(
    matrix: Tensor, weight: float, svd: bool, budget: float, every: bool = False
) -> Iterator[Point]:
    """The paper's Algorithm 1, written plainly."""
    penalty, spent = 0.05, 0.0
    sparse, multiplier = torch.zeros_like(matrix), torch.zeros_like(matrix)
    for iteration in range(1, STOPS[-1] + 1):
        begin = time.perf_counter()
        argument = matrix - sparse - multiplier / penalty
        if svd:
            left, values, right = torch.linalg.svd(argument, full_matrices=False)
            shrunk = (values - 1 / penalty).clamp_min(0)
            low_rank = (left * shrunk) @ right
        else:
            squares, vectors = torch.linalg.eigh(argument.mT @ argument)
            shrunk = (1 - 1 / (penalty * squares.clamp_min(1e-30).sqrt())).clamp_min(0)
            low_rank = argument @ ((vectors * shrunk) @ vectors.mT)
        argument = matrix - low_rank - multiplier / penalty
        sparse = argument.sign() * (argument.abs() - weight / penalty).clamp_min(0)
        gap = low_rank + sparse - matrix
        multiplier = multiplier + penalty * gap
        _ = gap.norm() / matrix.norm()
        spent += time.perf_counter() - begin
        if every or iteration in STOPS:
            yield iteration, spent, low_rank, sparse, int((shrunk > 0).sum())
        if spent > budget:
            return


def plain_seconds(matrix: Tensor, weight: float, svd: bool, count: int) -> float:
    for iteration, spent, *_ in plain(matrix, weight, svd, math.inf, every=True):
        if iteration == count:
            return spent
    raise ValueError(count)


def package_run(matrix: Tensor, weight: float, method: str, stop: int) -> tuple[float, RobustPCA]:
    begin = time.perf_counter()
    result = robust_pca(
        matrix,
        sparsity_weight=weight,
        tolerance=1e-5,
        max_iterations=stop,
        method=method,
        progress=False,
    )
    return time.perf_counter() - begin, result


def package(matrix: Tensor, weight: float, method: str, budget: float) -> Iterator[Point]:
    spent = 0.0
    for stop in STOPS:
        seconds, result = package_run(matrix, weight, method, stop)
        spent += seconds
        yield stop, seconds, result.low_rank, result.sparse, result.rank
        if spent > budget or result.converged:
            return


def keep(path: Path, fields: Sequence[str], case: Sequence[str], rows: list[list[str]]) -> None:
    """Write rows into a table, in place of those whose first fields are the same."""
    old = [list(row.values()) for row in read_rows(path)] if path.exists() else []
    write_rows(path, fields, [row for row in old if row[: len(case)] != list(case)] + rows)


def measure(
    matrix: Tensor, weight: float, case: Sequence[str], part: str, budget: float, path: Path
) -> None:
    truth = torch.load(path)
    points = (
        plain(matrix, weight, part == "svd", budget)
        if part in ("svd", "gram")
        else package(matrix, weight, part, budget)
    )
    rows = []
    for iterations, seconds, low_rank, sparse, rank in points:
        gap = squared(low_rank, sparse, matrix, signs=(1, 1, -1)) / squared(matrix)
        errors = [math.sqrt(gap), objective(low_rank, matrix, weight) / truth["objective"] - 1]
        for mine, name in ((low_rank, "low_rank"), (sparse, "sparse")):
            errors.append(
                math.sqrt(squared(mine, truth[name], signs=(1, -1)) / squared(truth[name]))
            )
        row = [*case, part, str(iterations), f"{seconds:.3f}"]
        rows.append([*row, *(f"{error:.2e}" for error in errors), str(rank)])
        print(*rows[-1], flush=True)
    keep(TABLE, FIELDS, [*case, part], rows)


def clock(matrix: Tensor, weight: float, case: Sequence[str], budget: float) -> None:
    """Seconds after two iteration counts, results included: a line through them is the clock."""
    best: dict[tuple[str, int], float] = {}
    begin = time.time()
    while time.time() - begin < budget:
        for part, counts in CLOCKED.items():
            for count in counts:
                if part in ("svd", "gram"):
                    spent = plain_seconds(matrix, weight, part == "svd", count)
                else:
                    spent = package_run(matrix, weight, part, count)[0]
                best[part, count] = min(spent, best.get((part, count), math.inf))
    rows = [[*case, part, str(count), f"{spent:.4f}"] for (part, count), spent in best.items()]
    for row in rows:
        print(*row, flush=True)
    keep(CLOCK, CLOCK_FIELDS, case, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[50, 150])
    parser.add_argument("--weight", nargs="+", default=["0.009", "auto"], help="a number or auto")
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--budget", type=float, default=100, help="seconds for each part")
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmarks/decomposition_speed"))
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    options.work.mkdir(parents=True, exist_ok=True)
    for frames in options.frames:
        matrix = feature_matrix(frames)
        for name in options.weight:
            weight = len(matrix) ** -0.5 if name == "auto" else float(name)
            path = options.work / f"reference_{frames}_{name}.pt"
            case = (str(frames), name)
            for part in options.part:
                if part == "reference":
                    make_reference(matrix, weight, options.budget, path)
                elif part == "clock":
                    clock(matrix, weight, case, options.budget)
                else:
                    measure(matrix, weight, case, part, options.budget, path)
    report()


if __name__ == "__main__":
    main()
