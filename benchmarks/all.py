"""All benchmarks, one after the other: some hours on two cores.

    python benchmarks/all.py [--lego FOLDER] [--only NAME ...]

Needs the extra `dev` and D-NeRF's lego (`xplanes download dnerf`). Each script writes
its own page below docs/results anew; one that fails does not stop the others.
Nothing else should run.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

from runner import lego

HERE = Path(__file__).resolve().parent


def scripts(folder: Path) -> dict[str, list[list[str]]]:
    """The arguments of each script's runs, by its name; ``folder`` is that of lego."""
    given = ["--lego", str(folder)]
    return {
        "where_time_goes": [[], ["--name", "lego", *lego(folder.resolve())]],
        "lego_curves": [given],
        "skips": [given],
        "rendering": [given],
        "ray_drawing": [[]],
        "gaussian_rasteriser": [[]],
        "gaussians": [given],
        "captures": [[]],
        "stages": [[]],
        "pareto": [given],
        "lrm_sizes": [[]],
        "decomposition_speed": [[]],
        "decomposition_stress": [[]],
        "conversion_options": [[]],
        "rank_curve": [[]],
        "stability": [[]],
        "faults": [[]],
    }


def main() -> int:
    names = list(scripts(Path()))
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path, default=Path("data/dnerf/lego"))
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    args = parser.parse_args()
    chosen = {name: runs for name, runs in scripts(args.lego).items() if name in args.only}
    if any(any(runs) for runs in chosen.values()) and not args.lego.is_dir():
        parser.error(f"--lego {args.lego}: there is no such folder; xplanes download dnerf")
    failed = []
    for name, runs in chosen.items():
        began = time.perf_counter()
        script = [sys.executable, str(HERE / f"{name}.py")]
        codes = [subprocess.run([*script, *line], check=False).returncode for line in runs]
        print(f"{name}: {time.perf_counter() - began:.0f} s, exit codes {codes}", flush=True)
        if any(codes):
            failed.append(name)
    if failed:
        print(f"failed: {', '.join(failed)}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
