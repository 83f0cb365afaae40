"""Atomic file writing: a reader never sees a partially written file."""

import csv
import errno
import json
import math
import os
import re
import shutil
import tempfile
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from xplanes.errors import ConfigError, XPlanesError

MARK = ".tmp-"
"""Part of the name of every file that is still being written."""

DAY = 86_400.0
"""Seconds of a day; older unfinished files in a cache count as abandoned."""


class StorageError(XPlanesError, OSError):
    """A file cannot be written; the message names the file, the reason and the remedy."""


@contextmanager
def storage_errors(path: Path | None = None) -> Iterator[None]:
    """Report problems of the disk within the block as `StorageError`; others pass unchanged.

    Args:
        path: The file to be written; when None, the one that the original error names.
    """
    try:
        yield
    except OSError as problem:
        code = problem.errno or 0
        if code not in _WAYS_OUT or (path is None and code not in _ONLY_WRITING):
            raise
        place = path if path is not None else Path(problem.filename or "a file")
        room = ""
        if code in (errno.ENOSPC, errno.EDQUOT):
            with suppress(OSError):
                room = f" ({shutil.disk_usage(existing(place)).free / 2**20:.1f} MB free)"
        raise StorageError(
            f"{place} cannot be written: {os.strerror(code)}{room}. {_WAYS_OUT[code]}"
        ) from problem


_FREE = "Free some space, or choose a folder on another disk; existing files are intact"
_OPEN = "Choose a folder that can be written"
_IN_THE_WAY = "A file is in the place of a folder: choose another folder"
_WAYS_OUT = {
    errno.ENOSPC: _FREE,
    errno.EDQUOT: _FREE,
    errno.EFBIG: "Raise the limit on the size of files (ulimit -f)",
    errno.EROFS: _OPEN,
    errno.EACCES: _OPEN,
    errno.EPERM: _OPEN,
    errno.ENOTDIR: _IN_THE_WAY,
    errno.EEXIST: _IN_THE_WAY,
    errno.EIO: "The disk or its connection is failing; choose a folder on another disk",
}

_ONLY_WRITING = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}
"""Errors that only writing can raise."""


def natural(name: str) -> list[str | int]:
    """A sort key of alternating text and numbers: frame_10 comes after frame_9."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def existing(path: Path) -> Path:
    """The path itself or the nearest folder above it that exists."""
    return next((p for p in (path, *path.absolute().parents) if is_there(p)), Path("/"))


def is_there(path: Path) -> bool:
    """Whether a path exists; files in a folder that cannot be entered count as missing."""
    try:
        return path.exists()
    except PermissionError:
        return False


def stand_in(path: Path) -> str | None:
    """Why a file is only a placeholder for the real one, and the remedy; None if it is not.

    Args:
        path: The file; None is returned if it cannot be opened.
    """
    try:
        with path.open("rb") as file:
            head = file.read(256)
    except OSError:
        return None
    start = head.lstrip().lower()
    if re.match(rb"version https?://(git-lfs|hawser|git-media)", start):
        return (
            "is a pointer of Git LFS, not the file itself: run git lfs pull in its repository, or "
            "download the file"
        )
    if b"/annex/objects/" in start:
        return "is a pointer of git-annex, not the file itself: run git annex get on it"
    if start.startswith((b"<!doctype html", b"<html")):
        return "is a web page, not the file itself: download it again, from its direct address"
    return None


def require_writable(folder: Path) -> None:
    """Refuse a folder in which no file can be written; it need not exist yet.

    Raises:
        StorageError: If no file can be written.
    """
    place = existing(folder.absolute())
    with storage_errors(folder):
        if not place.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, "", str(place))
        with tempfile.TemporaryFile(dir=place) as file:
            file.write(bytes(1 << 16))


def require_empty(folder: Path) -> None:
    """Refuse a path that is a file or a folder with files; it need not exist yet.

    Raises:
        ConfigError: If it is a file, or a folder with files.
    """
    if folder.is_file():
        raise ConfigError(f"{folder} is a file: name a folder")
    if folder.is_dir() and any(folder.iterdir()):
        raise ConfigError(f"{folder} already contains files: empty it, or name another with --out")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path``, renamed to it when the block succeeds.

    Raises:
        StorageError: If the disk is full, cannot be written, or fails.
    """
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}{MARK}{uuid.uuid4().hex[:8]}{path.suffix}")
        temporary.touch(exist_ok=False)  # With the permissions of any new file.
        try:
            yield temporary
            with temporary.open("r+b") as file:  # Windows syncs only files open for writing.
                os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def clear_unfinished(folder: Path, older_than: float = 0.0) -> None:
    """Remove half-written files that killed processes left below a folder.

    Args:
        folder: Searched recursively.
        older_than: Least age in seconds of removed files; newer ones may still be in use.
    """
    for place, _, names in os.walk(folder):  # Goes on if another process removes a folder.
        for name in names:
            path = Path(place, name)
            if not (name.startswith(".") and MARK in name):
                continue
            with suppress(OSError):  # Another process has removed it, or the folder is read-only.
                if time.time() - path.stat().st_mtime >= older_than:
                    path.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically; numbers that are not finite become null."""
    write_text(path, json.dumps(_finite(content), indent=2) + "\n")


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        ValueError: If the file is damaged; the message names it.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged: not a JSON object")
    return content


def write_rows(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a CSV file atomically."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file by column name; empty if there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
