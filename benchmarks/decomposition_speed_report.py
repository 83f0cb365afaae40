"""Table and plot of the run times that decomposition_speed.py measured."""

import matplotlib
from runner import RESULTS, machine

from xplanes.files import read_rows, replacing, write_text

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TABLE = RESULTS / "decomposition_speed.csv"
CLOCK = RESULTS / "decomposition_speed_clock.csv"
NAMES = {
    "svd": "(a) paper's ADMM, full SVD",
    "gram": "(b) paper's ADMM, Gram matrix",
    "admm": "paper's ADMM, fused passes",
    "adaptive": "default (adaptive)",
}
TARGETS = (
    ("residual", (1e-3, 1e-5, 1e-7)),
    ("objective", (1e-2, 1e-3, 1e-4)),
    ("low_rank", (1e-2, 1e-3)),
    ("sparse", (1e-2, 1e-3)),
)
HEAD = """# Robust PCA: run time against error

163,840 rows (64 x 64 cells of 40 features), float32; {machine}. Each
column has the seconds until an error falls below the bound and stays there. Residual:
|L + S - Y| / |Y|. Errors against a long float64 run: objective of the feasible pair (L, Y - L),
relative difference of L and of S. `-`: not reached within the iterations of the last column; ours
end at tolerance 1e-5. Seconds are iterations times the least time per iteration over interleaved
rounds, plus set-up and final steps. Script: `benchmarks/decomposition_speed.py`; points:
`decomposition_speed.csv` (its own column of seconds is raw), times:
`decomposition_speed_clock.csv`.
"""


def clocks() -> dict[tuple[str, ...], tuple[float, float]]:
    """Start and slope of the line through the two clocked counts, by frames, weight and part."""
    points: dict[tuple[str, ...], list[tuple[int, float]]] = {}
    for row in read_rows(CLOCK):
        key = (row["weight"], row["frames"], row["part"])
        points.setdefault(key, []).append((int(row["iterations"]), float(row["seconds"])))
    lines = {}
    for key, values in points.items():
        (few, short), (many, long) = min(values), max(values)
        slope = (long - short) / (many - few)
        lines[key] = (max(0.0, short - few * slope), slope)
    return lines


def reached(rows: list[dict[str, str]], name: str, bound: float) -> float | None:
    """Seconds after which the error stays below the bound."""
    answer = None
    for row in reversed(rows):
        if abs(float(row[name])) > bound:
            break
        answer = float(row["seconds"])
    return answer


def report() -> None:
    """Write the page and the plot."""
    rows, clock = read_rows(TABLE), clocks()
    cases = sorted({(row["weight"], int(row["frames"])) for row in rows})
    figure, axes = plt.subplots(len(cases), 3, figsize=(13, 3.2 * len(cases)), squeeze=False)
    colours = dict(zip(NAMES, plt.rcParams["axes.prop_cycle"].by_key()["color"], strict=False))
    bounds = [(name, bound) for name, values in TARGETS for bound in values]
    lines = [HEAD.format(machine=machine())]
    for line, (weight, frames) in zip(axes, cases, strict=True):
        heads = " | ".join(f"{name} {bound:.0e}" for name, bound in bounds)
        lines.append(f"\n## {frames} frames, sparsity weight {weight}\n")
        lines.append(f"| method | s per iteration | {heads} | given |")
        lines.append("|" + "---|" * (len(bounds) + 3))
        times: dict[str, list[float | None]] = {}
        for part, title in NAMES.items():
            key = (weight, str(frames), part)
            chosen = [row for row in rows if (row["weight"], row["frames"], row["part"]) == key]
            if not chosen:
                continue
            chosen.sort(key=lambda row: int(row["iterations"]))
            begin, each = clock[key]
            for row in chosen:
                row["seconds"] = str(begin + each * int(row["iterations"]))
            times[part] = [reached(chosen, name, bound) for name, bound in bounds]
            cells = " | ".join("-" if t is None else f"{t:.2f}" for t in times[part])
            given = chosen[-1]["iterations"]
            lines.append(f"| {title} | {each:.3f} | {cells} | {given} |")
            for axis, name in zip(line, ("residual", "objective", "low_rank"), strict=True):
                seconds = [float(row["seconds"]) for row in chosen]
                errors = [abs(float(row[name])) for row in chosen]
                axis.loglog(seconds, errors, ".-", color=colours[part], label=title)
                axis.set(xlabel="seconds", ylabel=name.replace("_", "-"))
                axis.set_title(f"{frames} frames, weight {weight}", fontsize=9)
                axis.grid(alpha=0.3)
        if {"svd", "adaptive"} <= set(times):
            pairs = zip(times["svd"], times["adaptive"], strict=True)
            gains = " | ".join(
                f"**{slow / fast:.0f}x**" if slow and fast else "-" for slow, fast in pairs
            )
            lines.append(f"| (a) over the default | | {gains} | |")
    axes[0][0].legend(fontsize=7)
    figure.tight_layout()
    with replacing(RESULTS / "decomposition_speed.png") as temporary:
        figure.savefig(temporary, dpi=75, format="png")
    write_text(RESULTS / "decomposition_speed.md", "\n".join(lines) + "\n")
