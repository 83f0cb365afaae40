"""How OpenMP's threads wait for work.

Must stay quick: its caller has yet to import torch, whose OpenMP reads the environment once.
"""

from collections.abc import Mapping

WAIT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "10000"}
"""A moment awake, then sleep: threads that spin on waste the cores of a shared machine."""


def waiting(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables to add: none where one of them is set, since they only work together."""
    return {} if WAIT.keys() & environment.keys() else dict(WAIT)
