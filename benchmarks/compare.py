"""Two versions side by side: training throughput, PSNR and start-up, in paired runs.

    python benchmarks/compare.py --before FOLDER --after FOLDER [--rounds 3] [--lego FOLDER]
        [--steps 1000] [--old KEY=VALUE ...] [--new KEY=VALUE ...] [--out FOLDER]

FOLDER is a checkout of each version (`git worktree add FOLDER COMMIT`). Two runs train at the same
time, each on half of the cores, and then once more with the halves swapped: what else the machine
does, and a slower core, meet both alike. A pair's ratio is the geometric mean of the two. Pairs of
the version before with itself show what is left of the noise. Settings that only one version knows
are given with --old and --new.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from runner import RESULTS, lego, machine, markdown

from xplanes.files import write_text

COLUMNS = ("scene", "pair", "steps/s, ratio", "start-up, ratio", "steps/s", "PSNR, dB")


@dataclass(frozen=True)
class Version:
    """A checkout and the settings that only it knows."""

    checkout: Path
    overrides: tuple[str, ...]


@dataclass(frozen=True)
class Measured:
    """What one run took."""

    steps: float
    psnr: float
    start: float


def train_together(
    versions: Sequence[Version], overrides: Sequence[str], work: Path
) -> list[Measured]:
    """Train once with each version, at the same time, on equal shares of the cores."""
    cores = sorted(os.sched_getaffinity(0))
    share = max(1, len(cores) // len(versions))
    runs, processes, began = [], [], []
    for index, version in enumerate(versions):
        run = Path(tempfile.mkdtemp(dir=work)) / "run"
        own = cores[index * share : (index + 1) * share]
        environment = os.environ | {
            "PYTHONPATH": str(version.checkout),
            "OMP_NUM_THREADS": str(share),
        }
        command = [sys.executable, str(version.checkout / "train.py"), *overrides]
        command += [*version.overrides, f"hydra.run.dir={run}"]
        began.append(time.perf_counter())
        processes.append(
            subprocess.Popen(
                ["taskset", "-c", ",".join(map(str, own)), *command],
                cwd=work,
                env=environment,
                stdout=subprocess.DEVNULL,
            )
        )
        runs.append(run)
    ended: dict[int, float] = {}
    while len(ended) < len(processes):
        for index, process in enumerate(processes):
            if index not in ended and process.poll() is not None:
                ended[index] = time.perf_counter()
                if process.returncode:
                    raise SystemExit(f"{versions[index].checkout}: exit {process.returncode}")
        time.sleep(0.05)
    found = []
    for index, run in enumerate(runs):
        metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
        seconds = metrics["seconds"]
        total = ended[index] - began[index]
        found.append(
            Measured(
                metrics["step"] / seconds["train"],
                metrics["test"]["psnr"],
                total - seconds["train"] - seconds["evaluate"],
            )
        )
    return found


@dataclass(frozen=True)
class Pair:
    """Two versions in one round, with the cores swapped half-way."""

    steps: float
    start: float
    second: tuple[Measured, Measured]


def pair(first: Version, second: Version, overrides: Sequence[str], work: Path) -> Pair:
    """The second version over the first."""
    a, b = train_together([first, second], overrides, work)
    d, c = train_together([second, first], overrides, work)
    return Pair(
        math.sqrt(b.steps / a.steps * d.steps / c.steps),
        math.sqrt(b.start / a.start * d.start / c.start),
        (b, d),
    )


def row(scene: str, name: str, pairs: list[Pair]) -> tuple:
    """Mean and standard deviation of each figure."""

    def of(values: list[float], digits: int) -> str:
        spread = statistics.stdev(values) if len(values) > 1 else 0.0
        return f"{statistics.mean(values):.{digits}f} ± {spread:.{digits}f}"

    runs = [run for found in pairs for run in found.second]
    return (
        scene,
        name,
        of([found.steps for found in pairs], 3),
        of([found.start for found in pairs], 3),
        of([run.steps for run in runs], 1),
        of([run.psnr for run in runs], 2),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--before", type=Path, required=True)
    parser.add_argument("--after", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--lego", type=Path)
    parser.add_argument("--old", nargs="*", default=[])
    parser.add_argument("--new", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    before = Version(args.before.resolve(), tuple(args.old))
    after = Version(args.after.resolve(), tuple(args.new))
    scenes = {"excavator, 128 px": ["lrm=none"]}
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
            common = [*overrides, "trainer.max_seconds=null"]
            train_together([before, after], [*common, "trainer.max_steps=20"], work)  # Compiles.
            pairs: dict[str, list[Pair]] = {"before / before": [], "after / before": []}
            for number in range(args.rounds):
                chosen = [*common, f"trainer.max_steps={args.steps}", f"seed={number}"]
                for kind, second in zip(pairs, (before, after), strict=True):
                    pairs[kind].append(pair(before, second, chosen, work))
                    print(f"{scene}, {kind}, seed {number}: {pairs[kind][-1]}", flush=True)
            rows += [row(scene, kind, found) for kind, found in pairs.items()]
    page = f"""# Two versions side by side

{machine()}; means and standard deviations of {args.rounds} seeds, {args.steps} steps each, two runs
at a time on half of the cores each, the halves swapped. Ratios above 1 are more steps per second
and a longer start-up. The first line of each scene compares the version before with itself: noise.

{markdown(COLUMNS, rows)}
"""
    print(page)
    write_text(args.out / "compare.md", page)


if __name__ == "__main__":
    main()
