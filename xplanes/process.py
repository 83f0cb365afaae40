"""This process: its start, OpenMP's threads, what oneDNN keeps, the user's home, its command line.

Must stay quick: its caller has yet to import torch, whose libraries read the environment once.
"""

import os
import shlex
import sys
import time
from collections.abc import Mapping
from pathlib import Path

STARTED = time.perf_counter()
"""When this process began, as `time.perf_counter` counts."""

WAIT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "10000"}
"""Threads spin briefly, then sleep: spinning for long wastes the cores of a shared machine."""


KEEP = {"ONEDNN_PRIMITIVE_CACHE_CAPACITY": "256"}
"""Compiled products that are kept, of 0.4 MB each, scattered over memory that is free in between.

Every number of samples has its own. With oneDNN's 1024 a process grows by 150 MB at each evaluation
of eleven 400 px images; from 64 on training is as fast.
"""


NOWHERE = {"HOME": os.devnull}
"""A home in which no library can make a folder, for users who have none, as in containers.

Without it some fail, and others write into a folder called ``~`` of the working directory.
"""


def defaults(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables to add. Of `WAIT` none where one is set, since they only work together."""
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


def train_command() -> str:
    """The command that trains, as this process was started: for messages that name it."""
    return "python train.py" if Path(sys.argv[0]).name == "train.py" else "xplanes train"


def resume_command(run: Path) -> str:
    """What a user types in a shell to go on with a run."""
    return f"{train_command()} {shlex.quote(f'resume={run}')}"
