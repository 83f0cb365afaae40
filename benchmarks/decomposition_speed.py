"""Run time against error of robust PCA: the default, the paper's ADMM with a full SVD, and with Gram.

    python benchmarks/decomposition_speed.py run --frames 50 --weight 0.009 --part reference
    python benchmarks/decomposition_speed.py run --frames 50 --weight 0.009 --part adaptive
    python benchmarks/decomposition_speed.py report

Parts: reference (once per case, long, float64), then svd, gram, adaptive, growing, admm. Errors are
computed outside the clock. Every point of adaptive, growing and admm is a run of its own that was
stopped there, results written out included.
"""

import argparse
import csv
import math
import time
from pathlib import Path

import torch
from decomposition_data import feature_matrix
from torch import Tensor

from xplanes.decomposition import robust_pca
from xplanes.decomposition.passes import Step, Workspace, iterate, start
from xplanes.decomposition.svt import shrinkage_from_gram

RESULTS = Path(__file__).parent / "results"
TABLE = RESULTS / "decomposition_speed.csv"
FIELDS = ("frames", "weight", "part", "iterations", "seconds", "residual", "objective", "low_rank", "sparse", "rank")  # fmt: skip
STOPS = (2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 23, 26, 29, 32, 36, 40, 45, 50, 56, 64, 72, 84, 96, 112, 128, 150, 180, 220)  # fmt: skip
NAMES = {
    "svd": "(a) paper's ADMM, full SVD",
    "gram": "(b) paper's ADMM, Gram matrix",
    "admm": "paper's ADMM, fused passes",
    "growing": "growing penalty (inexact ALM)",
    "adaptive": "default (adaptive)",
}


def nuclear_norm(matrix: Tensor) -> float:
    total = sum(block.double().mT @ block.double() for block in matrix.split(20000))
    return torch.linalg.eigvalsh(total).clamp_min(0).sqrt().sum().item()


def objective(low_rank: Tensor, matrix: Tensor, weight: float) -> float:
    """Objective of the feasible pair (L, Y - L)."""
    rest = sum((y.double() - l.double()).abs().sum().item() for y, l in zip(matrix.split(20000), low_rank.split(20000), strict=True))  # fmt: skip
    return nuclear_norm(low_rank) + weight * rest


def make_reference(matrix: Tensor, weight: float, seconds: float, path: Path) -> None:
    """Long float64 run with a dual bound: the multiplier, made feasible, bounds the optimum below."""
    y = matrix.double()
    state, frames = torch.empty_like(y), y.shape[1]
    work = Workspace(y, state)
    gram, penalty, before, best, begin, count = start(work), 0.03, 0.03, math.inf, time.time(), 0
    low_rank, sparse = torch.empty_like(y), torch.empty_like(y)
    while time.time() - begin < seconds:
        basis, factors, _ = shrinkage_from_gram(gram, 1 / penalty)
        limit = weight / penalty
        after = penalty if count < 20 or count > 200 else penalty * 1.01
        step = Step(basis, factors, weight / before, limit, before / penalty, penalty / after, 1.6)
        if time.time() - begin > seconds - 3:
            # What `finish` does, keeping the state.
            clipped = state.clamp(-step.old_limit, step.old_limit)
            torch.mm(y - state + (1 + step.rescale) * clipped, (basis * factors) @ basis.mT, out=low_rank)
            state.copy_(y - low_rank + step.rescale * clipped)
            break
        gram, norms = iterate(work, step, norms=False, changes=True)
        before, penalty, count = penalty, after, count + 1
    dual = penalty * state.clamp(-limit, limit)
    sparse.copy_(state - dual / penalty)
    spectral = torch.linalg.eigvalsh(dual.mT @ dual)[-1].sqrt().item()
    lower = (y * dual).sum().item() / max(1.0, spectral, dual.abs().max().item() / weight)
    value = objective(low_rank, y, weight)
    print(f"{count} iterations, objective {value:.8g}, dual bound {lower:.8g}, gap {value / lower - 1:.1e}, rank {len(factors)}, last norms {norms}", flush=True)  # fmt: skip
    torch.save({"low_rank": low_rank.float(), "sparse": sparse.float(), "objective": value, "gap": value / lower - 1}, path)  # fmt: skip


def difference(part: Tensor, truth: Tensor) -> float:
    pairs = zip(part.split(20000), truth.split(20000), strict=True)
    gap = sum((p.double() - t.double()).square().sum().item() for p, t in pairs)
    return math.sqrt(gap / sum(t.double().square().sum().item() for t in truth.split(20000)))


def plain(matrix: Tensor, weight: float, svd: bool, budget: float):
    """The paper's Algorithm 1, written plainly; yields (iteration, seconds, L, S, rank)."""
    penalty = 0.05
    sparse, multiplier = torch.zeros_like(matrix), torch.zeros_like(matrix)
    spent = 0.0
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
        gap.norm() / matrix.norm()
        spent += time.perf_counter() - begin
        if iteration in STOPS:
            yield iteration, spent, low_rank, sparse, int((shrunk > 0).sum())
        if spent > budget:
            return


def ours(matrix: Tensor, weight: float, method: str, budget: float):
    spent = 0.0
    for stop in STOPS:
        begin = time.perf_counter()
        result = robust_pca(matrix, sparsity_weight=weight, tolerance=1e-12, max_iterations=stop, method=method, progress=False)  # fmt: skip
        seconds = time.perf_counter() - begin
        spent += seconds
        yield stop, seconds, result.low_rank, result.sparse, result.rank
        if spent > budget:
            return


def run(frames: int, weight_name: str, part: str, budget: float, work: Path) -> None:
    matrix = feature_matrix(frames)
    weight = len(matrix) ** -0.5 if weight_name == "auto" else float(weight_name)
    path = work / f"reference_{frames}_{weight_name}.pt"
    if part == "reference":
        make_reference(matrix, weight, budget, path)
        return
    truth = torch.load(path)
    source = plain(matrix, weight, part == "svd", budget) if part in ("svd", "gram") else ours(matrix, weight, part, budget)  # fmt: skip
    fresh = not TABLE.exists()
    with TABLE.open("a", newline="") as file:
        writer = csv.writer(file)
        if fresh:
            writer.writerow(FIELDS)
        norm = matrix.double().norm().item()
        for iterations, seconds, low_rank, sparse, rank in source:
            residual = math.sqrt(sum((l + s - y).double().square().sum().item() for l, s, y in zip(low_rank.split(20000), sparse.split(20000), matrix.split(20000), strict=True))) / norm  # fmt: skip
            gap = objective(low_rank, matrix, weight) / truth["objective"] - 1
            row = (frames, weight_name, part, iterations, f"{seconds:.3f}", f"{residual:.2e}", f"{gap:.2e}", f"{difference(low_rank, truth['low_rank']):.2e}", f"{difference(sparse, truth['sparse']):.2e}", rank)  # fmt: skip
            writer.writerow(row)
            print(*row, flush=True)


TARGETS = (
    ("residual", (1e-3, 1e-5, 1e-7)),
    ("objective", (1e-2, 1e-3, 1e-4)),
    ("low_rank", (1e-2, 1e-3)),
    ("sparse", (1e-2, 1e-3)),
)


def reached(rows: list[dict], name: str, bound: float) -> float | None:
    """Seconds after which the error stays below the bound."""
    answer = None
    for row in sorted(rows, key=lambda row: -int(row["iterations"])):
        if abs(float(row[name])) > bound:
            break
        answer = float(row["seconds"])
    return answer


def report() -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with TABLE.open() as file:
        rows = list(csv.DictReader(file))
    cases = sorted({(int(row["frames"]), row["weight"]) for row in rows}, key=lambda c: (c[1], c[0]))
    figure, axes = plt.subplots(len(cases), 3, figsize=(14, 3.4 * len(cases)), squeeze=False)
    lines = [
        "# Robust PCA: run time against error",
        "",
        "163,840 rows (64 x 64 x 40 features), float32, two cores of an AMD EPYC, torch 2.13, times in",
        "seconds, one run each. Errors against a long float64 run: objective of the feasible pair",
        "(L, Y - L), relative difference of L and of S. `-`: not reached in the time it was given (last",
        "column). Script: `benchmarks/decomposition_speed.py`; all points: `decomposition_speed.csv`.",
    ]  # fmt: skip
    for index, (frames, weight) in enumerate(cases):
        lines += ["", f"## {frames} frames, sparsity weight {weight}", ""]
        heads = [f"{name} {bound:.0e}" for name, bounds in TARGETS for bound in bounds]
        lines += ["| method | s per iteration | " + " | ".join(heads) + " | given |", "|" + "---|" * (len(heads) + 3)]  # fmt: skip
        times = {}
        for part, title in NAMES.items():
            chosen = [row for row in rows if int(row["frames"]) == frames and row["weight"] == weight and row["part"] == part]  # fmt: skip
            if not chosen:
                continue
            chosen.sort(key=lambda row: int(row["iterations"]))
            times[part] = [reached(chosen, name, bound) for name, bounds in TARGETS for bound in bounds]  # fmt: skip
            final = chosen[-1]
            each = float(final["seconds"]) / int(final["iterations"])
            cells = ["-" if value is None else f"{value:.2f}" for value in times[part]]
            lines.append(f"| {title} | {each:.3f} | " + " | ".join(cells) + f" | {final['seconds']} |")
            for axis, name in zip(axes[index], ("residual", "objective", "low_rank"), strict=True):
                axis.loglog([float(r["seconds"]) for r in chosen], [abs(float(r[name])) for r in chosen], ".-", label=title)  # fmt: skip
                axis.set(xlabel="seconds", ylabel=f"{name} error" if name != "residual" else name, title=f"{frames} frames, weight {weight}")  # fmt: skip
                axis.grid(alpha=0.3)
        if "svd" in times and "adaptive" in times:
            gains = [f"{a / b:.0f}x" if a and b else "-" for a, b in zip(times["svd"], times["adaptive"], strict=True)]  # fmt: skip
            lines.append("| **(a) over default** | | " + " | ".join(gains) + " | |")
    axes[0][0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(RESULTS / "decomposition_speed.png", dpi=80)
    (RESULTS / "decomposition_speed.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("run", "report"))
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--weight", default="0.009")
    parser.add_argument("--part", choices=("reference", *NAMES), default="adaptive")
    parser.add_argument("--budget", type=float, default=100, help="seconds of measured time")
    parser.add_argument("--work", type=Path, default=Path("/tmp/decomposition_speed"))
    options = parser.parse_args()
    if options.action == "report":
        report()
    else:
        options.work.mkdir(exist_ok=True)
        run(options.frames, options.weight, options.part, options.budget, options.work)
