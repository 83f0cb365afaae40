"""What becomes of runs when processes, disks, files and clocks fail: the fault tests, as a table.

    python benchmarks/faults.py [--select EXPRESSION]

Writes docs/results/faults.md. Some minutes; a few tests mount a small disk and need root for that.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))
os.environ.setdefault("OMP_NUM_THREADS", "1")


from runner import command, machine, markdown
from tally import Gatherer, write_page

COLUMNS = ("fault", "cases", "same end", "messages in words", "failed", "skipped")


def page(found: Gatherer) -> str:
    """The table and the words around it."""
    rows, total = [], [0] * 5
    for kind, row in found.rows.items():
        counts = [row.counts.get(name, 0) for name in ("cases", "recovered", "said")]
        counts += [row.failed, len(row.skipped)]
        total = [a + b for a, b in zip(total, counts, strict=True)]
        rows.append((kind, *counts))
    rows.append(("**all**", *total))
    reasons = sorted({reason for row in found.rows.values() for reason in row.skipped})
    notes = "".join(f"\n{reason}\n" for reason in reasons)
    if found.other_failures:
        notes += f"\nFailed without a count: {', '.join(found.other_failures)}.\n"
    return f"""# Recovery from faults

    {command()}

Runs of 40 steps on a scene of 32 pixels, a checkpoint every 3 steps, random initialisation or
`tiny`, each forked from one fully loaded process. "Same end": after the fault is removed, the run
(resumed if it had started) reaches bit-identical parameters, scores and curve to an uninterrupted
run and leaves no unfinished file; a truncated curve.csv loses rows. "Messages in words": what a
user saw, checked for the file, the reason and the remedy. Cases without "same end" are files and
folders that must be refused.

{machine()}; {found.seconds:.0f} s on one thread. The tests alone:
`python -m pytest -m stress tests/faults`.

{markdown(COLUMNS, rows)}
{notes}"""


if __name__ == "__main__":
    write_page("faults", page, "faults.md", (__doc__ or "").split("\n")[0])
