"""Downloads, checks and unpacks the public D-NeRF scenes."""

import json
import shutil
import time
import zipfile
import zlib
from http.client import HTTPException, HTTPResponse
from pathlib import Path, PurePosixPath
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from xplanes.errors import SceneError
from xplanes.files import storage_errors
from xplanes.process import say

CHUNK_BYTES = 1 << 20
TIMEOUT_SECONDS = 30
ATTEMPTS = 5
PAUSE_SECONDS = 2.0
PROGRESS_SECONDS = 5.0
SPACE = 2.1
"""Free space needed for the archive, in multiples of its size: its images hardly compress, so
unpacking takes the same space again."""


class FetchError(Exception):
    """A file could not be downloaded; the message is the reason."""


class _BrokenTransferError(Exception):
    """The transfer was interrupted; another attempt may succeed."""


def fetch(url: str, path: Path) -> None:
    """Download ``url`` to ``path``; an incomplete download is kept in ``path``.part.

    Another call resumes an interrupted download if the server supports range requests. It does not
    check whether the file has changed on the server meanwhile: the caller checks the content.

    Args:
        url: Address, http or https.
        path: The file, which is written atomically.

    Raises:
        FetchError: The server cannot be reached or refuses, or the disk is too full.
    """
    if not url.startswith(("http://", "https://")):
        raise FetchError(f"{url} is not an http or https address.")
    part = path.with_name(f"{path.name}.part")
    for attempt in range(ATTEMPTS):
        try:
            _advance(url, part)
        except _BrokenTransferError as problem:
            unreachable = attempt == 0 and isinstance(problem.__cause__, URLError)
            if unreachable or attempt == ATTEMPTS - 1:
                kept = ""
                if part.exists():
                    kept = f" {part.stat().st_size / 1e6:.1f} MB are kept in {part}."
                raise FetchError(f"{problem}.{kept}") from problem
            say(f"{problem}; trying again")
            time.sleep(PAUSE_SECONDS)
        else:
            part.replace(path)
            return


def _advance(url: str, part: Path) -> None:
    """Download the rest of ``part``, or all of it if it cannot be resumed."""
    start = part.stat().st_size if part.exists() else 0
    headers = {"User-Agent": "xplanes", "Accept-Encoding": "identity"}
    if start:
        headers["Range"] = f"bytes={start}-"
    try:
        response = urlopen(Request(url, headers=headers), timeout=TIMEOUT_SECONDS)
    except HTTPError as problem:
        with problem:
            if start and problem.code == 416:
                if problem.headers.get("Content-Range", "").endswith(f"*/{start}"):
                    return
                part.unlink()
                raise _BrokenTransferError(f"{url} has changed since the download began") from None
            raise FetchError(f"{url} answered {problem.code} {problem.reason}.") from problem
    except (OSError, HTTPException) as problem:
        raise _BrokenTransferError(f"{url} cannot be reached ({problem})") from problem
    with response:
        if response.status == 206:
            say(f"Continuing {url} after {start / 1e6:.1f} MB")
        elif response.headers.get_content_type() == "text/html":  # ``part`` is kept.
            raise FetchError(f"{url} answered with a web page instead of a file.")
        else:
            start = 0
        _receive(url, response, part, start)


def _receive(url: str, response: HTTPResponse, part: Path, start: int) -> None:
    total = None if response.length is None else start + response.length
    if total is not None:
        _check_space(part.parent, int(SPACE * total) - start)
    received, reported = start, time.monotonic()
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
                say(f"{received / 1e6:.0f}{of_total} MB")
    # Python returns an empty chunk if the connection ends early.
    if total is not None and received < total:
        raise _BrokenTransferError(
            f"The connection to {url} ended after {received / 1e6:.1f} of {total / 1e6:.1f} MB"
        )


def _check_space(folder: Path, needed: int) -> None:
    """Raise `FetchError` if fewer than ``needed`` bytes are free on the disk of ``folder``."""
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise FetchError(
            f"{folder} needs {needed / 1e6:.0f} MB of free space and has {free / 1e6:.0f} MB. "
            f"Make room or choose a folder on another disk."
        )


# From the README of github.com/albertpumarola/D-NeRF; dl=1 requests the file itself.
# No checksum of the archive is published, so its CRCs and the table below are checked.
DNERF_URL = "https://www.dropbox.com/s/0bf6fl0ye2vz3vr/data.zip?dl=1"
ARCHIVE = "dnerf.zip"

# Number of training views of each scene.
TRAIN_VIEWS = {
    "bouncingballs": 150,
    "hellwarrior": 100,
    "hook": 100,
    "jumpingjacks": 200,
    "lego": 50,
    "mutant": 150,
    "standup": 150,
    "trex": 200,
}
TEST_VIEWS = 20
SPLITS = ("train", "val", "test")


def download_dnerf(root: Path, *, url: str = DNERF_URL) -> Path:
    """Download the eight D-NeRF scenes into ``root``; incomplete scenes are never left there.

    The next call resumes an interrupted download. Existing scenes are not changed. An archive that
    was downloaded manually is used if it is in ``root`` as dnerf.zip.

    Args:
        root: Folder for one folder per scene; created if missing.
        url: Address of the archive.

    Returns:
        The folder of the scenes, which is the value for data.root.

    Raises:
        SceneError: The archive cannot be fetched, is damaged, or is not the expected one.
        StorageError: The disk is full, or cannot be written.
    """
    root = Path(root).absolute()
    with storage_errors(root):
        _download_missing(root, url)
    return root


def _download_missing(root: Path, url: str) -> None:
    missing = [name for name in TRAIN_VIEWS if not (root / name / "transforms_train.json").exists()]
    if not missing:
        say(f"All D-NeRF scenes are already in {root}")
        return
    for name in missing:
        if (root / name).exists():
            raise SceneError(
                f"{root / name} is in the way: it holds no transforms_train.json, so it is not "
                f"the scene. Move it elsewhere and try again."
            )
    root.mkdir(parents=True, exist_ok=True)
    archive = root / ARCHIVE
    by_hand = archive.exists()
    try:
        if by_hand:
            say(f"Using {archive}, which is already there")
        else:
            say(f"Downloading {url} to {archive}")
            fetch(url, archive)
        _install(archive, root, missing)
    except FetchError as problem:
        raise SceneError(
            f"{problem} Try again later to continue; or fetch {DNERF_URL} by hand, save it as "
            f"{archive} and run this again; or train on the built-in scene with data=demo."
        ) from problem
    except _BadArchiveError as problem:
        if not by_hand:
            archive.unlink()
        fate = "Replace it or delete it" if by_hand else "It was deleted: try again"
        raise SceneError(
            f"{archive} cannot be used: {problem}. {fate}. The archive is published at {DNERF_URL}."
        ) from problem
    if not by_hand:
        archive.unlink()
    say(f"Scenes in {root}: {', '.join(sorted(TRAIN_VIEWS))}")


class _BadArchiveError(Exception):
    """The archive is damaged or not the expected one."""


def _install(archive: Path, root: Path, names: list[str]) -> None:
    """Unpack into a temporary folder, check all scenes, and only then move them into place."""
    workspace = root / ".dnerf-unpacking"
    shutil.rmtree(workspace, ignore_errors=True)
    try:
        _unpack(archive, workspace, names)
        for name in names:
            _check_scene(workspace / name)
        for name in names:
            (workspace / name).rename(root / name)
    finally:
        shutil.rmtree(workspace, ignore_errors=True)


def _unpack(archive: Path, workspace: Path, names: list[str]) -> None:
    wanted = []
    try:
        with zipfile.ZipFile(archive) as source:
            for member in source.infolist():
                target = None if member.is_dir() else _target(member.filename)
                if target is not None and target.parts[0] in names:
                    member.filename = str(target)
                    wanted.append(member)
            _check_space(archive.parent, sum(member.file_size for member in wanted))
            source.extractall(workspace, wanted)  # Verifies CRCs.
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError) as problem:
        raise _BadArchiveError(f"it is damaged or no zip file ({problem})") from problem


def _target(member: str) -> PurePosixPath | None:
    """Path of a member, as scene/...; None if it is not part of a scene."""
    path = PurePosixPath(member)
    if path.is_absolute() or ".." in path.parts or "\\" in member or ":" in member:
        raise _BadArchiveError(f"its member {member!r} leads out of the folder")
    parts = path.parts[1:] if path.parts[:1] == ("data",) else path.parts
    return PurePosixPath(*parts) if len(parts) > 1 and parts[0] in TRAIN_VIEWS else None


def _check_scene(folder: Path) -> None:
    """Compare an unpacked scene with the known contents of the data set."""
    name = folder.name
    for split in SPLITS:
        try:
            content = json.loads((folder / f"transforms_{split}.json").read_text(encoding="utf-8"))
            files = [frame["file_path"] for frame in content["frames"]]
        except (OSError, ValueError, KeyError, TypeError) as problem:
            raise _BadArchiveError(
                f"{name}/transforms_{split}.json is missing or unreadable ({problem})"
            ) from problem
        for file in files:
            if not (folder / f"{file}.png").is_file():
                raise _BadArchiveError(f"{name} lacks {file}.png, which its {split} split names")
        if split == "train" and len(files) != TRAIN_VIEWS[name]:
            raise _BadArchiveError(
                f"{name} has {len(files)} training views instead of {TRAIN_VIEWS[name]}"
            )
        # The number of test views is not certain, so a difference is no error.
        if split == "test" and len(files) != TEST_VIEWS:
            say(f"Note: {name} has {len(files)} test views; {TEST_VIEWS} are usual")
