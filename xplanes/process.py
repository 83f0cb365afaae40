"""This process: start time, OpenMP threads, oneDNN's cache, home directory, command line.

Must not import torch: its libraries read the environment only once, so it must be set before.
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
"""Time at which this process started, on the clock of `time.perf_counter`."""

WAIT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "1000"}
"""Idle threads spin briefly, then sleep: long spinning wastes the cores of a shared machine."""


KEEP = {"ONEDNN_PRIMITIVE_CACHE_CAPACITY": "256"}
"""Number of matrix-product kernels that oneDNN caches; each takes 0.4 MB and fragments the heap.

Each number of samples needs its own kernel. With oneDNN's default of 1024, each evaluation of
eleven 400 px images adds 150 MB to the process; 64 are enough for full speed.
"""


NOWHERE = {"HOME": os.devnull}
"""Home directory for users without one, as in containers; it is not writable.

Without it some libraries fail, and others write into a folder called ``~``.
"""


def defaults(environment: Mapping[str, str]) -> dict[str, str]:
    """Environment variables to add; a group is left out if any of its variables is set."""
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
"""Options of glibc's ``mallopt``, with sizes in bytes above which freed memory is returned."""


def keep_freed_memory() -> None:
    """Let glibc reuse freed memory instead of returning it to the system.

    With large batches, page faults for temporaries take a tenth of each step's time. Has no effect
    with other C libraries, or if the user has set one of glibc's own variables.
    """
    if any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ):
        return
    with suppress(AttributeError, OSError, TypeError):
        library = ctypes.CDLL(None)
        for option, value in (MMAP_THRESHOLD, TRIM_THRESHOLD):
            library.mallopt(option, value)


def say(text: str) -> None:
    """Print a line without buffering."""
    print(text, flush=True)


def train_command() -> str:
    """The training command in the form in which this process was started, for messages."""
    return "python train.py" if Path(sys.argv[0]).name == "train.py" else "xplanes train"


def resume_command(run: Path) -> str:
    """The shell command that resumes a run."""
    return f"{train_command()} {shlex.quote(f'resume={run}')}"
