"""Locks between processes; the system releases a lock even if its process is killed."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from xplanes.errors import ConfigError
from xplanes.files import read_json

logger = logging.getLogger(__name__)

RUN_LOCK = ".lock"
"""File in a run directory that the running process locks."""

_UNLOCKABLE = OSError, NotImplementedError
"""Errors of file systems without locks, such as NFS without a lock daemon."""


@contextmanager
def in_turn(path: Path | None) -> Iterator[bool]:
    """Wait for a lock, and hold it within the block.

    Args:
        path: The lock's file; None: no lock.

    Returns:
        Whether this process holds it; False also where files cannot be locked.
    """
    if path is None:
        yield False
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        logger.warning("waiting for another process that is making %s", path.with_suffix(""))
        lock.acquire()
    except _UNLOCKABLE as problem:
        logger.warning("%s cannot be locked (%s): several processes may make it", path, problem)
    try:
        yield lock.is_locked
    finally:
        lock.release()


@contextmanager
def if_free(path: Path) -> Iterator[bool]:
    """Hold a lock within the block, unless another process holds it.

    Returns:
        Whether this process holds it; False also where files cannot be locked.
    """
    lock = FileLock(path)
    with suppress(*_UNLOCKABLE):  # A timeout is an OSError, too.
        lock.acquire(timeout=0)
    try:
        yield lock.is_locked
    finally:
        lock.release()


@contextmanager
def alone_in(run: Path) -> Iterator[None]:
    """Lock a run directory, so that no second process writes into it.

    Raises:
        ConfigError: If another process holds it.
    """
    run.mkdir(parents=True, exist_ok=True)
    lock = FileLock(run / RUN_LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        process = "another process"
        with suppress(OSError, ValueError, KeyError):
            process = f"process {read_json(run / 'run.json')['process']}"
        raise ConfigError(
            f"{run} is in use by {process}: wait for it to end, stop it, or choose another folder"
        ) from None
    except _UNLOCKABLE as problem:
        logger.warning("%s cannot be locked (%s): start no second process in it", run, problem)
    try:
        yield
    finally:
        lock.release()
