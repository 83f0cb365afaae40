"""Two versions side by side: training throughput, PSNR and start-up, in interleaved runs.

    python benchmarks/compare.py --before FOLDER --after FOLDER [--rounds 3] [--lego FOLDER]
        [--seconds 30] [--old KEY=VALUE ...] [--new KEY=VALUE ...] [--out FOLDER]

FOLDER is a checkout of each version (`git worktree add FOLDER COMMIT`). Rounds alternate between
the two; the version before runs twice in each round, so that its spread is that of the machine.
Settings that only one version knows are given with --old and --new. Nothing else should run.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from runner import RESULTS, lego, machine, markdown

from xplanes.files import write_text

COLUMNS = ("scene", "version", "steps/s", "PSNR, dB", "s until the first step", "s in all")


@dataclass(frozen=True)
class Measured:
    """What one run took."""

    steps: float
    psnr: float
    start: float
    total: float


def measure(checkout: Path, overrides: list[str], work: Path) -> Measured:
    """Train once with a version's code."""
    run = Path(tempfile.mkdtemp(dir=work)) / "run"
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    began = time.perf_counter()
    subprocess.run(
        [sys.executable, str(checkout / "train.py"), *overrides, f"hydra.run.dir={run}"],
        cwd=work,
        env=environment,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    total = time.perf_counter() - began
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    seconds = metrics["seconds"]
    start = total - seconds["train"] - seconds["evaluate"]
    return Measured(metrics["step"] / seconds["train"], metrics["test"]["psnr"], start, total)


def row(scene: str, version: str, runs: list[Measured]) -> tuple:
    """Mean and standard deviation of each figure."""

    def of(name: str, digits: int) -> str:
        values = [getattr(run, name) for run in runs]
        spread = statistics.stdev(values) if len(values) > 1 else 0.0
        return f"{statistics.mean(values):.{digits}f} ± {spread:.{digits}f}"

    return scene, version, of("steps", 1), of("psnr", 2), of("start", 1), of("total", 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--before", type=Path, required=True)
    parser.add_argument("--after", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--lego", type=Path)
    parser.add_argument("--old", nargs="*", default=[])
    parser.add_argument("--new", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    scenes = {"excavator, 128 px": []}
    if args.lego is not None:
        scenes["lego, 200 px, val"] = [
            *lego(args.lego.resolve()),
            "data.resolution=200",
            "lrm=none",
        ]
    rows = []
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        for scene, overrides in scenes.items():
            common = [*overrides, f"trainer.max_seconds={args.seconds:g}"]
            runs: dict[str, list[Measured]] = {"before": [], "before again": [], "after": []}
            for version, checkout, own in (
                ("before", args.before, args.old),
                ("after", args.after, args.new),
            ):
                measure(checkout, [*common, *own, "trainer.max_seconds=2"], work)  # Compiles.
                print(f"{scene}: {version} is compiled", flush=True)
            for number in range(args.rounds):
                for version in runs:
                    old = version != "after"
                    checkout, own = (args.before, args.old) if old else (args.after, args.new)
                    found = measure(checkout, [*common, f"seed={number}", *own], work)
                    runs[version].append(found)
                    print(f"{scene}, {version}, seed {number}: {found}", flush=True)
            rows += [row(scene, version, found) for version, found in runs.items()]
    page = f"""# Two versions side by side

{machine()}; means and standard deviations of {args.rounds} seeds, runs interleaved,
{args.seconds:g} s of training each. "before again" repeats "before": their difference is noise.

{markdown(COLUMNS, rows)}
"""
    print(page)
    write_text(args.out / "compare.md", page)


if __name__ == "__main__":
    main()
