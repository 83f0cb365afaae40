"""Runs of the product for the benchmarks: composed like the command line, in this process."""

import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from xplanes.backend import fast_bf16
from xplanes.config import CONF, compose_plain
from xplanes.files import read_rows
from xplanes.run import run

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
TRAIN, CPU_CLOCK = CONF.parent / "train.py", Path(__file__).resolve().parent / "cpu_clock.py"


@dataclass(frozen=True)
class Measured:
    """What a run left behind: metrics.json and the rows of curve.csv."""

    metrics: dict[str, Any]
    curve: list[dict[str, str]]


def measure(overrides: list[str], work: Path) -> Measured:
    """Train once in a fresh folder below ``work``."""
    config = compose_plain("train", overrides)
    folder = Path(tempfile.mkdtemp(dir=work)) / "run"
    run(config, folder, overrides, resume=False)
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    return Measured(metrics, read_rows(folder / "curve.csv"))


def machine() -> str:
    """The machine, in words."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                name = line.split(":", 1)[1].strip()
                break
    cores, threads = os.cpu_count(), torch.get_num_threads()
    used = f"{cores} cores" if threads == cores else f"{threads} of {cores} cores"
    products = "with" if fast_bf16(torch.device("cpu")) else "without"
    return f"{used}, {name}, {products} bfloat16 products, torch {torch.__version__}"


def command() -> str:
    """This process as a command line, with what the environment says of threads."""
    named = (name for name in ("OMP_NUM_THREADS", "XPLANES_CPU_LOOPS") if name in os.environ)
    given = [f"{name}={os.environ[name]}" for name in named]
    script = f"benchmarks/{Path(sys.argv[0]).name}"
    return shlex.join([*given, "python", script, *without_folders(sys.argv[1:])])


def without_folders(words: Iterable[str]) -> list[str]:
    """Words of a command line; absolute paths, also those behind ``KEY=``, become FOLDER."""
    found = []
    for word in words:
        key, equals, value = word.rpartition("=")
        found.append(f"{key}{equals}FOLDER" if Path(value).is_absolute() else word)
    return found


def markdown(columns: tuple[str, ...], rows: list[tuple]) -> str:
    """A table."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    return "\n".join(lines)


def lego(folder: Path) -> list[str]:
    """Overrides for D-NeRF's lego, scored on the val split."""
    return [
        "data=dnerf",
        f"data.root={folder.parent}",
        f"data.scene={folder.name}",
        "data.eval_split=val",
    ]


def run_apart(overrides: list[str], folder: Path, script: Path = TRAIN) -> Measured:
    """Train in a process of its own, so that memory is the run's; a finished run is not repeated.

    Args:
        overrides: As on the command line.
        folder: The run directory; one that was begun goes on where it stopped.
        script: train.py, or one that does the same.

    Raises:
        RuntimeError: If the run fails, or the folder holds another one.
    """
    listed = folder / "overrides.txt"
    if listed.is_file():
        lines = listed.read_text(encoding="utf-8").splitlines()
        kept = [line for line in lines if not line.startswith("resume=")]
        if kept != overrides:
            raise RuntimeError(f"{folder} holds a run with {' '.join(kept)}: move it away")
    if not (folder / "metrics.json").is_file():
        begun = (folder / "run.json").is_file()
        lines = [f"resume={folder}"] if begun else [*overrides, f"hydra.run.dir={folder}"]
        done = subprocess.run(
            [sys.executable, str(script), *lines],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(
                f"{folder.name} failed:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
            )
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    return Measured(metrics, read_rows(folder / "curve.csv"))
