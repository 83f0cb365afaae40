"""All benchmarks, one after the other: some four hours on two cores.

    python benchmarks/all.py [--lego FOLDER] [--only NAME ...]

Needs the extra `plots` and D-NeRF's lego (`python -m xplanes download dnerf`). Each script writes
its own page anew, in benchmarks/results or docs/results; one that fails does not stop the others.
Nothing else should run.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

from runner import lego

HERE = Path(__file__).resolve().parent
SCRIPTS = {
    "where_time_goes": False,
    "lego_curves": True,
    "skips": True,
    "rendering": True,
    "stages": False,
    "pareto": True,
    "lrm_sizes": False,
    "decomposition_speed": False,
    "decomposition_stress": False,
    "conversion_options": False,
    "stability": False,
    "faults": False,
}
"""Name of each script, and whether it takes the folder of lego."""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", default="data/dnerf/lego")
    parser.add_argument("--only", nargs="+", choices=list(SCRIPTS), default=list(SCRIPTS))
    args = parser.parse_args()
    wanted = any(SCRIPTS[name] or name == "where_time_goes" for name in args.only)
    if wanted and not Path(args.lego).is_dir():
        parser.error(
            f"--lego {args.lego}: there is no such folder; python -m xplanes download dnerf"
        )
    failed = []
    for name in args.only:
        options = [["--lego", args.lego] if SCRIPTS[name] else []]
        if name == "where_time_goes":
            options.append(["--name", "lego", *lego(Path(args.lego).resolve())])
        began = time.perf_counter()
        script = [sys.executable, str(HERE / f"{name}.py")]
        codes = [subprocess.run([*script, *line], check=False).returncode for line in options]
        print(f"{name}: {time.perf_counter() - began:.0f} s, exit {max(codes)}", flush=True)
        if any(codes):
            failed.append(name)
    if failed:
        print(f"failed: {', '.join(failed)}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
