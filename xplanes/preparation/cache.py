"""A content-addressed cache of preparation stages on disk.

An entry is one file of tensors and builtins. Its name is a hash of the stage's inputs, and it
contains a checksum: entries that are truncated, altered or of another version are recomputed.
"""

import hashlib
import json
import logging
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xplanes.backend import warm_up
from xplanes.files import DAY, clear_unfinished, replacing, require_writable
from xplanes.locks import in_turn

logger = logging.getLogger(__name__)

VERSION = 3
"""Version of the stages; increase it whenever a stage gives a different result."""


@dataclass(frozen=True)
class Stage:
    """Result of a stage.

    Attributes:
        content: Tensors and builtins.
        seconds: Time to compute it, also if it came from the cache; warm-up excluded.
        cached: Whether it came from the cache.
        key: Hash of its inputs; empty if nothing is cached.
    """

    content: dict[str, Any]
    seconds: float
    cached: bool
    key: str


class StageCache:
    """A folder of cached stages.

    Args:
        folder: The folder; None disables the cache.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.writable = folder is not None
        try:
            if folder is not None:
                require_writable(folder)
        except OSError:
            self.writable = False
            logger.warning("preparation.cache=%s cannot be written: stages are not cached", folder)

    def stage(
        self,
        name: str,
        inputs: Any,
        make: Callable[[], dict[str, Any]],
        *,
        keep: bool = True,
        alone: bool = False,
    ) -> Stage:
        """Load a stage from the cache, or compute and store it.

        Args:
            name: Name of the stage, part of the file name.
            inputs: Everything that the result depends on: tensors, numbers, strings, lists, dicts.
            make: Computes the result: a dict of tensors and builtins.
            keep: Whether to use the cache for this stage.
            alone: Whether other processes wait while one computes the same stage.
        """
        path, key = self._path(name, inputs)
        path = path if keep else None
        lock = path.with_suffix(".lock") if path and alone and self.writable else None
        if (found := _find(path, key)) is not None:
            return found
        with in_turn(lock):
            # Another process may have finished it before the lock was free.
            if lock is not None and (found := _find(path, key)) is not None:
                return found
            began = time.perf_counter() - warm_up.seconds
            content = make()
            seconds = time.perf_counter() - warm_up.seconds - began
            self._write(path, key, content, seconds)
        return Stage(content, seconds, False, key)

    def find(self, name: str, inputs: Any) -> Stage | None:
        """A cached stage, or None if it does not exist or cannot be used."""
        return _find(*self._path(name, inputs))

    def keep(self, name: str, inputs: Any, content: dict[str, Any], seconds: float) -> None:
        """Store a stage that was just computed."""
        self._write(*self._path(name, inputs), content, seconds)

    @contextmanager
    def workshop(self, name: str, inputs: Any) -> Iterator[Path]:
        """A folder for intermediate results of a stage, reused after an interruption.

        It is removed when the block ends without an error.
        """
        path, _ = self._path(name, inputs)
        if path is None or not self.writable:
            with tempfile.TemporaryDirectory(prefix="xplanes_") as folder:
                yield Path(folder)
            return
        yield path.with_suffix("")
        shutil.rmtree(path.with_suffix(""), ignore_errors=True)

    def _path(self, name: str, inputs: Any) -> tuple[Path | None, str]:
        if self.folder is None:
            return None, ""
        key = fingerprint([VERSION, name, inputs])
        return self.folder / f"{name}-{key[:32]}.pt", key

    def _write(self, path: Path | None, key: str, content: dict[str, Any], seconds: float) -> None:
        """Store an entry; a failure does not stop the run."""
        if path is None or not self.writable:
            return
        payload = {
            "version": VERSION,
            "key": key,
            "checksum": fingerprint([content, seconds]),
            "seconds": seconds,
            "content": content,
        }
        clear_unfinished(path.parent, older_than=DAY)
        try:
            with replacing(path) as temporary:
                torch.save(payload, temporary)
        except (OSError, RuntimeError) as error:
            logger.warning("%s could not be written (%s): it is not cached", path, error)


def _find(path: Path | None, key: str) -> Stage | None:
    """The entry in a file, or None if there is no usable one."""
    if path is None or not path.exists():
        return None
    try:
        payload = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(payload, dict):
            problem = "not an entry of this cache"
        elif payload.get("version") != VERSION:
            problem = f"of version {payload.get('version')}, not {VERSION}"
        elif payload.get("key") != key:
            problem = "the entry of other inputs"
        elif payload["checksum"] != fingerprint([payload["content"], payload["seconds"]]):
            problem = "damaged (wrong checksum)"
        else:
            return Stage(payload["content"], payload["seconds"], True, key)
    except Exception as error:  # A damaged file raises many kinds of errors.
        problem = f"damaged ({type(error).__name__})"
    logger.warning("%s is %s: it is recomputed", path, problem)
    return None


def fingerprint(value: Any) -> str:
    """Hash of nested tensors (type, shape and bytes) and builtins.

    Raises:
        TypeError: For a value of any other kind.
    """
    digest = hashlib.sha256()
    _feed(digest, value)
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    # Types and lengths are hashed first, so that different values give different bytes.
    if isinstance(value, Tensor):
        digest.update(f"tensor {value.dtype} {tuple(value.shape)}:".encode())
        for part in value.detach().reshape(-1).split(1 << 24):
            digest.update(part.cpu().contiguous().view(torch.uint8).numpy())
    elif isinstance(value, Mapping):
        digest.update(f"dict {len(value)}:".encode())
        for name in sorted(value):
            _feed(digest, name)
            _feed(digest, value[name])
    elif isinstance(value, list | tuple):
        digest.update(f"list {len(value)}:".encode())
        for item in value:
            _feed(digest, item)
    elif value is None or isinstance(value, bool | int | float | str):
        text = json.dumps(value)
        digest.update(f"{len(text)} {text}:".encode())
    else:
        raise TypeError(f"{type(value).__name__} cannot be hashed here")
