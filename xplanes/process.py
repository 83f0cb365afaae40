"""This process: how OpenMP's threads wait, and the command that started it.

Must stay quick: its caller has yet to import torch, whose OpenMP reads the environment once.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

WAIT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "10000"}
"""Threads spin briefly, then sleep: spinning for long wastes the cores of a shared machine."""


def waiting(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables to add: none where one of them is set, since they only work together."""
    return {} if WAIT.keys() & environment.keys() else dict(WAIT)


def train_command() -> str:
    """The command that trains, as this process was started: for messages that name it."""
    return "python train.py" if Path(sys.argv[0]).name == "train.py" else "xplanes train"
