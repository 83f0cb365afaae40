"""This process: its start, OpenMP's threads, what oneDNN keeps, the user's home, its command line.

Must stay quick: its caller has yet to import torch, whose libraries read the environment once.
"""

import ctypes
import os
import shlex
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

STARTED = time.perf_counter()
"""When this process began, as `time.perf_counter` counts."""

WAIT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "10000"}
"""Threads spin briefly, then sleep: spinning for long wastes the cores of a shared machine."""


KEEP = {"ONEDNN_PRIMITIVE_CACHE_CAPACITY": "256"}
"""Number of compiled matrix products that oneDNN keeps; each takes 0.4 MB and fragments the heap.

Each number of samples needs its own. With oneDNN's default of 1024 a process grows by 150 MB at
each evaluation of eleven 400 px images; 64 are enough for full speed.
"""


NOWHERE = {"HOME": os.devnull}
"""A home directory for users without one, as in containers; nothing can be written there.

Without it some libraries fail, and others write into a folder called ``~``.
"""


def defaults(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables to add; `WAIT` only if neither of its two is set, as they work together."""
    try:
        Path.home()
        groups = [WAIT, KEEP]
    except RuntimeError:
        groups = [WAIT, KEEP, NOWHERE]
    return {
        name: value
        for group in groups
        if not group.keys() & environment.keys()
        for name, value in group.items()
    }


MMAP_THRESHOLD, TRIM_THRESHOLD = (-3, 2**30), (-1, 2**31 - 1)
"""Options of glibc's ``mallopt``: sizes from which blocks, and free memory, are given back."""


def keep_freed_memory() -> None:
    """Let glibc reuse what is freed instead of giving it back to the system.

    Fresh pages for the temporaries of each step cost a tenth of its time with large batches. Other
    C libraries, and whoever sets one of glibc's own variables, are left alone.
    """
    if any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ):
        return
    with suppress(AttributeError, OSError, TypeError):
        library = ctypes.CDLL(None)
        for option, value in (MMAP_THRESHOLD, TRIM_THRESHOLD):
            library.mallopt(option, value)


def train_command() -> str:
    """The command that trains, as this process was started: for messages that name it."""
    return "python train.py" if Path(sys.argv[0]).name == "train.py" else "xplanes train"


def resume_command(run: Path) -> str:
    """What a user types in a shell to go on with a run."""
    return f"{train_command()} {shlex.quote(f'resume={run}')}"
