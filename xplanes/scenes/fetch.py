"""Large files fetched over HTTP and continued after an interruption."""

import json
import shutil
import time
from collections.abc import Callable
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

CHUNK_BYTES = 1 << 20
TIMEOUT_SECONDS = 30
ATTEMPTS = 5
PAUSE_SECONDS = 2.0
PROGRESS_SECONDS = 5.0


class FetchError(Exception):
    """A file could not be fetched; the message says why."""


class _BrokenTransferError(Exception):
    """The transfer stopped before its end; asking again may help."""


def fetch(
    url: str, path: Path, *, announce: Callable[[str], None] = print, space_factor: float = 1.0
) -> None:
    """Download ``url`` to ``path``; what has arrived survives in ``path``.part until then.

    A second call goes on where the first was cut off, provided that the server still has the
    same file (compared by ETag or modification time) and can send parts of it.

    Args:
        url: Address, http or https.
        path: Where the complete file appears, all at once.
        announce: Takes lines about progress.
        space_factor: Free disk space to insist on, in sizes of the file.

    Raises:
        FetchError: The address cannot be reached or refuses, or the disk is too full.
    """
    if not url.startswith(("http://", "https://")):
        raise FetchError(f"{url} is not an http or https address.")
    part = path.with_name(f"{path.name}.part")
    for attempt in range(ATTEMPTS):
        try:
            _advance(url, part, announce, space_factor)
        except _BrokenTransferError as problem:
            unreachable = attempt == 0 and isinstance(problem.__cause__, URLError)
            if unreachable or attempt == ATTEMPTS - 1:
                kept = f" {_size(part)} MB are kept in {part}." if part.exists() else ""
                raise FetchError(f"{problem}.{kept}") from problem
            announce(f"{problem}; trying again")
            time.sleep(PAUSE_SECONDS)
        else:
            part.replace(path)
            _note_path(part).unlink(missing_ok=True)
            return


def _advance(url: str, part: Path, announce: Callable[[str], None], space_factor: float) -> None:
    """Fetch what is missing of ``part``, or all of it if it cannot be continued."""
    validator = _saved_validator(url, part)
    start = part.stat().st_size if validator else 0
    headers = {"User-Agent": "xplanes", "Accept-Encoding": "identity"}
    if start and validator:
        headers |= {"Range": f"bytes={start}-", "If-Range": validator}
    try:
        response = urlopen(Request(url, headers=headers), timeout=TIMEOUT_SECONDS)
    except HTTPError as problem:
        with problem:
            if start and problem.code == 416:
                if problem.headers.get("Content-Range", "").endswith(f"*/{start}"):
                    return
                _discard(part)
                raise _BrokenTransferError(f"{url} has changed since the download began") from None
            raise FetchError(f"{url} answered {problem.code} {problem.reason}.") from problem
    except (OSError, HTTPException) as problem:
        raise _BrokenTransferError(f"{url} cannot be reached ({problem})") from problem
    with response:
        if response.status == 206:
            if not _continues(response, start, validator):
                _discard(part)
                raise _BrokenTransferError(f"{url} has changed since the download began")
            announce(f"Continuing {url} after {_size(part)} MB")
        else:
            start = 0
            _save_validator(url, part, response)
        _receive(url, response, part, start, announce, space_factor)


def _receive(
    url: str,
    response: HTTPResponse,
    part: Path,
    start: int,
    announce: Callable[[str], None],
    space_factor: float,
) -> None:
    if response.headers.get_content_type() == "text/html":
        _discard(part)
        raise FetchError(f"{url} answered with a web page instead of a file.")
    total = None if response.length is None else start + response.length
    if total is not None:
        check_space(part.parent, int(space_factor * total) - start)
    received = start
    reported = time.monotonic()
    with part.open("ab" if start else "wb") as file:
        while True:
            try:
                chunk = response.read(CHUNK_BYTES)
            except (OSError, HTTPException) as problem:
                raise _BrokenTransferError(
                    f"The connection to {url} broke ({problem})"
                ) from problem
            if not chunk:
                break
            file.write(chunk)
            received += len(chunk)
            if time.monotonic() - reported > PROGRESS_SECONDS:
                reported = time.monotonic()
                of_total = f" of {total / 1e6:.0f}" if total else ""
                announce(f"{received / 1e6:.0f}{of_total} MB")
    # Python reports a connection that ends early as the end of the file.
    if total is not None and received < total:
        raise _BrokenTransferError(
            f"The connection to {url} ended after {received / 1e6:.1f} of {total / 1e6:.1f} MB"
        )


def check_space(folder: Path, needed: int) -> None:
    """Refuse to fill a disk.

    Raises:
        FetchError: Fewer than ``needed`` bytes are free where ``folder`` lies.
    """
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise FetchError(
            f"{folder} needs {needed / 1e6:.0f} MB of free space and has {free / 1e6:.0f} MB. "
            f"Make room or choose a folder on another disk."
        )


def _continues(response: HTTPResponse, start: int, validator: str | None) -> bool:
    """Whether a partial answer starts where the file ends and belongs to the same file."""
    begins = response.headers.get("Content-Range", "").startswith(f"bytes {start}-")
    return begins and _validator(response) in (None, validator)


def _validator(response: HTTPResponse) -> str | None:
    """What names this version of the file: a strong ETag, else the modification time."""
    tag = response.headers.get("ETag")
    if tag and not tag.startswith("W/"):
        return tag
    return response.headers.get("Last-Modified")


def _saved_validator(url: str, part: Path) -> str | None:
    """The version that ``part`` is the beginning of, if that is known."""
    if not part.exists():
        return None
    try:
        note = json.loads(_note_path(part).read_text(encoding="utf-8"))
        return note["validator"] if note["url"] == url else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _save_validator(url: str, part: Path, response: HTTPResponse) -> None:
    # First the old beginning goes, so that it never stands beside the new version's name.
    _discard(part)
    note = {"url": url, "validator": _validator(response)}
    _note_path(part).write_text(json.dumps(note), encoding="utf-8")


def _discard(part: Path) -> None:
    part.unlink(missing_ok=True)
    _note_path(part).unlink(missing_ok=True)


def _note_path(part: Path) -> Path:
    return part.with_name(f"{part.name}.json")


def _size(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.1f}"
