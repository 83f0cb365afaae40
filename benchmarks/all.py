"""The results below docs/results, made again where they are stale: some hours on two cores.

    python benchmarks/all.py [--lego FOLDER] [--list] [--only NAME ...]

A result is stale if it was made with another version, on another kind of machine, or before the
code or the settings that it measures changed; comments and docstrings do not count. --list says
which are and why; --only makes those named, stale or not. Needs the extra `dev` and D-NeRF's lego
(`xplanes download dnerf`). One script that fails does not stop the others, and one that was
interrupted goes on where it stopped if nothing has changed. Nothing else should run.
"""

import argparse
import ast
import hashlib
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from runner import RESULTS, lego, machine

from xplanes import __version__
from xplanes.files import write_text

HERE = Path(__file__).resolve().parent
MADE = RESULTS / "made.json"
WORK = Path("outputs/benchmarks")
"""Scripts keep finished runs below it, each in a folder of its name."""

TRAINING = ("conf", *(f"xplanes/{part}" for part in ("fields", "models", "rendering", "training")))
START = ("conf", *(f"xplanes/{part}" for part in ("decomposition", "lrm", "preparation")))

PARTS: dict[str, tuple[str, ...]] = {
    "where_time_goes": TRAINING,
    "lego_curves": (*TRAINING, "xplanes/baselines", "xplanes/scenes"),
    "skips": (*TRAINING, "xplanes/scenes"),
    "rendering": ("xplanes/fields", "xplanes/rendering"),
    "ray_drawing": ("xplanes/scenes",),
    "gaussian_rasteriser": ("xplanes/baselines/gaussians",),
    "gaussians": (*TRAINING, "xplanes/baselines", "xplanes/preparation"),
    "captures": (*TRAINING, "xplanes/scenes"),
    "initialisation": (*TRAINING, *START[1:]),
    "lrm_quality": (*TRAINING, *START[1:], "xplanes/synthetic/pretraining"),
    "stages": START,
    "pareto": (*TRAINING, *START[1:], "xplanes/baselines"),
    "lrm_sizes": ("xplanes/lrm",),
    "decomposition_speed": ("xplanes/decomposition",),
    "decomposition_stress": ("xplanes/decomposition",),
    "conversion_options": ("xplanes/fields", "xplanes/decomposition"),
    "paper": (*TRAINING, *START[1:], "xplanes/baselines"),
    "rank_curve": START,
    "stability": (*TRAINING, "xplanes/decomposition", "tests/stress"),
    "faults": ("xplanes", "tests/faults"),
}
"""What each script measures."""


def scripts(folder: Path) -> dict[str, list[list[str]]]:
    """The arguments of each script's runs, by its name; ``folder`` is that of lego."""
    scene = ["--lego", str(folder)]
    given = {name: [scene] for name in ("lego_curves", "rendering")}
    # CPU seconds: runs side by side do not disturb one another.
    for name in ("skips", "initialisation", "gaussians", "pareto"):
        given[name] = [[*scene, "--together", "2"]]
    own = "plain,world,world_tiny,masks,masks_tiny,rough_world,rough_field,thin_fog,even_rays"
    several = ["--together", "2", "--seeds", "3"]
    given["captures"] = [
        [*several, "--scenes", "phone,rig", "--variants", own],
        [
            *("--together", "2", "--seconds", "30", "--variants", "world,kplanes,tineuvox_s"),
            *("--scenes", "phone_test,rig_test,dark_test,topology_test,occlusion_test"),
            *("--name", "captures_models", "--title", "Test scenes in three models"),
        ],
    ]
    for name in ("lrm_quality", "paper"):
        given[name] = [["--together", "2"]]
    given["ray_drawing"] = [["--gigabytes", "22"]]  # More than the system keeps in memory.
    apart = "preparation.cache=null"
    given["where_time_goes"] = [[apart], ["--name", "lego", apart, *lego(folder.resolve())]]
    return {name: given.get(name, [[]]) for name in PARTS}


def digest(files: Iterable[Path]) -> str:
    """A number that changes with code and settings, but not with comments and docstrings."""
    found = hashlib.sha256()
    for file in files:
        text = file.read_text(encoding="utf-8")
        if file.suffix == ".py":
            text = ast.dump(_without_docstrings(ast.parse(text)))
        else:
            lines = (line.split("  #")[0].rstrip() for line in text.splitlines())
            text = "\n".join(line for line in lines if line and not line.startswith("#"))
        found.update(f"{file.name}\0{text}\0".encode())
    return found.hexdigest()[:16]


def _without_docstrings(tree: ast.AST) -> ast.AST:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            kept = [line for line in body if not _is_text(line)]
            node.body = kept  # type: ignore[attr-defined]
    return tree


def _is_text(line: ast.stmt) -> bool:
    return (
        isinstance(line, ast.Expr)
        and isinstance(line.value, ast.Constant)
        and isinstance(line.value.value, str)
    )


@cache
def digest_of(part: str) -> str:
    """The `digest` of a file, or of the code and settings in a folder of the repository."""
    path = HERE.parent / part
    found = [file for ending in ("*.py", "*.yaml") for file in sorted(path.rglob(ending))]
    return digest([path] if path.is_file() else found)


def state_of(name: str) -> dict[str, Any]:
    """Version, machine and measured code as they are now."""
    parts = {part: digest_of(part) for part in (*PARTS[name], f"benchmarks/{name}.py")}
    return {"version": __version__, "machine": kind_of(machine()), "parts": parts}


def kind_of(machine: str) -> str:
    """A machine without how many of its cores were used, which a script says itself."""
    return re.sub(r"^\d+ of ", "", machine)


def recorded() -> dict[str, dict[str, Any]]:
    """What `state_of` was when each script last made its results."""
    return json.loads(MADE.read_text(encoding="utf-8")) if MADE.is_file() else {}


def why_stale(now: dict[str, Any], then: dict[str, Any] | None) -> str:
    """What has changed since a result was made, in words; empty if nothing has."""
    if then is None:
        return "not recorded"
    changes = [f"made with {then['version']}"] * (then["version"] != now["version"])
    changes += [f"made on {then['machine']}"] * (kind_of(then["machine"]) != now["machine"])
    parts = [name for name, code in now["parts"].items() if then["parts"].get(name) != code]
    changes += [f"changed since: {', '.join(parts)}"] * bool(parts)
    return "; ".join(changes)


def keep_runs_of(state: dict[str, Any], folder: Path) -> None:
    """Forget the runs in a script's folder, unless they were made in this very state."""
    file = folder / "state.json"
    if not file.is_file() or json.loads(file.read_text(encoding="utf-8")) != state:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_text(file, json.dumps(state))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path, default=Path("data/dnerf/lego"))
    parser.add_argument("--list", action="store_true", help="say what is stale, and make nothing")
    parser.add_argument("--only", nargs="+", choices=list(PARTS))
    args = parser.parse_args()
    made = recorded()
    stale = {name: why_stale(state_of(name), made.get(name)) for name in PARTS}
    for name, reason in stale.items():
        print(f"{name:<22}{reason or 'up to date'}")
    if args.list:
        return 0
    wanted = args.only or [name for name, reason in stale.items() if reason]
    chosen = {name: runs for name, runs in scripts(args.lego).items() if name in wanted}
    needs_lego = any("lego" in " ".join(line) for runs in chosen.values() for line in runs)
    if needs_lego and not args.lego.is_dir():
        parser.error(f"--lego {args.lego}: there is no such folder; xplanes download dnerf")
    failed = []
    for name, runs in chosen.items():
        state, began = state_of(name), time.perf_counter()
        keep_runs_of(state, WORK / name)
        script = [sys.executable, str(HERE / f"{name}.py")]
        codes = [subprocess.run([*script, *line], check=False).returncode for line in runs]
        print(f"{name}: {time.perf_counter() - began:.0f} s, exit codes {codes}", flush=True)
        if any(codes):
            failed.append(name)
            continue
        shutil.rmtree(WORK / name)
        made = recorded() | {name: state}  # Another process may have made other results.
        write_text(MADE, json.dumps(dict(sorted(made.items())), indent=1) + "\n")
    if failed:
        print(f"failed: {', '.join(failed)}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
