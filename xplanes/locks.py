"""Keeping processes out of one another's way; the system frees a lock however a process ends."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from xplanes.config import ConfigError

try:
    import fcntl
except ImportError:  # Not on Windows; two processes are then not kept apart.
    fcntl = None

logger = logging.getLogger(__name__)

RUN_LOCK = ".lock"
"""File in a run directory that its process holds."""


@contextmanager
def in_turn(path: Path | None) -> Iterator[bool]:
    """Hold what other processes wait for.

    Args:
        path: The lock's file; None holds nothing.

    Returns:
        Whether this process had to wait.
    """
    if path is None or fcntl is None:
        yield False
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            waited = False
        except BlockingIOError:
            logger.warning("%s: another process is making it; waiting", path.with_suffix(""))
            fcntl.flock(file, fcntl.LOCK_EX)
            waited = True
        yield waited


@contextmanager
def alone_in(run: Path) -> Iterator[None]:
    """Hold a run directory, so that no second process writes into it.

    Raises:
        ConfigError: If another process holds it.
    """
    run.mkdir(parents=True, exist_ok=True)
    if fcntl is None:
        yield
        return
    with (run / RUN_LOCK).open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise ConfigError(
                f"{run} is in use by process {file.read().strip() or '(unknown)'}: wait for it to "
                "end, stop it, or choose another hydra.run.dir"
            ) from None
        except OSError as problem:
            logger.warning("%s cannot be locked (%s): start no second process in it", run, problem)
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield
