"""What becomes of numbers at their extremes: the stress suite, as a table.

    python benchmarks/stability.py [--select EXPRESSION]

Writes docs/results/stability.md and .png. One process, one thread, half an hour.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))
os.environ.setdefault("OMP_NUM_THREADS", "1")
# What one thread computes is compared with what two compute.
os.environ.setdefault("NUMBA_NUM_THREADS", "2")

from figures import panels, save
from runner import command, machine, markdown
from tally import Gatherer, write_page

COLUMNS = ("kind of stress", "cases", "finite", "stopped with a diagnosis", "failed", "worst error")


def plot(found: Gatherer) -> None:
    """The worst error of each kind that is compared with float64 or another number of threads."""
    worst: dict[str, list[float]] = {}
    for kind, row in found.rows.items():
        if row.error:
            worst.setdefault(kind.split(":")[0], []).append(row.error)
    figure, (axes,) = panels(1, 8, 3.5)
    for place, errors in enumerate(worst.values()):
        axes.plot(errors, [place] * len(errors), "o", color="C0")
    axes.set_yticks(range(len(worst)), list(worst))
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("worst error of each row, relative to the largest value")
    save(figure, "stability")


def page(found: Gatherer) -> str:
    """The table and the words around it."""
    rows, total = [], [0, 0, 0, 0]
    for kind, row in found.rows.items():
        counts = [row.counts.get(name, 0) for name in ("cases", "finite", "diagnosed")]
        counts.append(row.failed)
        total = [a + b for a, b in zip(total, counts, strict=True)]
        rows.append((kind, *counts, "" if row.error is None else f"{row.error:.1e}"))
    rows.append(("**all**", *total, ""))
    others = ""
    if found.other_failures:
        others = f"\nFailed without a count: {', '.join(found.other_failures)}.\n"
    return f"""# Numerical stability

    {command()}

![Worst errors](stability.png)

Each case runs forward and backward, or trains 50 steps (Tensor4D 15): all values, gradients and
parameters must be finite to the end, or training must stop with a message that names the non-finite
quantity and the remedy. Errors are the largest difference from float64 (or from the other number of
threads) as a share of the largest expected value; each test states its tolerance.

{machine()}; {found.seconds:.0f} s on one thread. The tests alone:
`python -m pytest -m stress tests/stress`.

{markdown(COLUMNS, rows)}
{others}
Robust PCA has [its own table](decomposition_stress.md).
"""


if __name__ == "__main__":
    write_page("stress", page, "stability.md", (__doc__ or "").split("\n")[0], plot)
