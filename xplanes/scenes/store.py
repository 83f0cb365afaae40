"""Decoded images that need not fit in memory: a file of pixels, written once and read in pieces.

A file contains the pixels of all images in order, row by row. For images with alpha, one bit per
pixel follows at the end: whether the pixel belongs to the silhouette. The file's name is a hash of
the sources and of the decoding, so that it needs no header: a file with that name and the right
length is valid. Its modification time is the time of its last use.

Pixels are read rather than memory-mapped: pages of a mapping count as memory of the process, and
truncating a mapped file kills the process.
"""

import hashlib
import json
import os
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from xplanes.files import (
    DAY,
    MARK,
    StorageError,
    clear_unfinished,
    existing,
    replacing,
    require_writable,
)
from xplanes.locks import if_free, in_turn
from xplanes.scenes.matte import silhouette_of

Size = tuple[int, int]
"""Height and width."""

IN_MEMORY = 2**30
"""Largest size in bytes of a split's decoded images in memory."""

RUN = 4096
"""Consecutive pixels of an image that are read together: 12 kB without alpha, 16 kB with it."""

VERSION = 4
"""Version of the files; increase it whenever decoding gives different bytes."""

SPARE = 2**28
"""Bytes to leave free on the disk."""

UNUSED_DAYS = 30
"""Days without use after which a file in the user's cache is removed."""

NAME = re.compile(r"[0-9a-f]{32}\.(pixels|tiles)")
"""Pattern of the files' names, including those of earlier versions."""

Job = Callable[[], Iterable[tuple[int, np.ndarray]]]
"""Decodes some of the images: yields their indices and pixels, uint8 [h, w, 3 or 4]."""


class PixelFile:
    """A file of pixels, or its content in memory.

    Args:
        source: The file, or its bytes. uint8 [N]
        key: Hash of the images' sources.
        sizes: Height and width of each image.
        channels: 3 for images without alpha, else 4.
    """

    def __init__(
        self, source: Path | np.ndarray, key: str, sizes: Sequence[Size], channels: int
    ) -> None:
        self.source, self.key, self.sizes, self.channels = source, key, tuple(sizes), channels
        self.first = _firsts(sizes)
        self._file = source.open("rb", buffering=0) if isinstance(source, Path) else None
        self._lock = threading.Lock()

    def __reduce__(self) -> Any:
        return PixelFile, (self.source, self.key, self.sizes, self.channels)

    @classmethod
    def of(cls, images: Iterable[Tensor]) -> "PixelFile":
        """Build in memory from images with alpha. uint8 [h, w, 4] each"""
        arrays = [image.numpy() for image in images]
        sizes = [(array.shape[0], array.shape[1]) for array in arrays]
        first, content = _firsts(sizes), np.zeros(_length(sizes, 4), np.uint8)
        for index, array in enumerate(arrays):
            for offset, part in _parts(first, 4, index, array):
                content[offset : offset + len(part)] = part
        return cls(content, hashlib.sha256(content.data).hexdigest(), sizes, 4)

    def pixels(self, index: int, start: int, count: int) -> np.ndarray:
        """Consecutive pixels of an image, fewer at its end. uint8 [count, C]"""
        first, end = self.first[index] + start, self.first[index + 1]
        content = self.read(first * self.channels, min(count, end - first) * self.channels)
        return content.reshape(-1, self.channels)

    def prefetch(self, index: int, start: int, count: int) -> None:
        """Ask the operating system to read pixels ahead, if it supports that."""
        if self._file is not None and hasattr(os, "posix_fadvise"):
            span = (self.first[index] + start) * self.channels, count * self.channels
            os.posix_fadvise(self._file.fileno(), *span, os.POSIX_FADV_WILLNEED)

    def read(self, offset: int, length: int) -> np.ndarray:
        """Consecutive bytes. uint8 [length]"""
        if isinstance(self.source, np.ndarray):
            return self.source[offset : offset + length]
        assert self._file is not None
        if hasattr(os, "pread"):  # Forked processes share the position in the file.
            content = os.pread(self._file.fileno(), length, offset)
        else:
            with self._lock:
                self._file.seek(offset)
                content = self._file.read(length)
        if len(content) < length:
            raise StorageError(
                f"{self.source} ends too early: it was truncated while in use. Delete it and start "
                "again to decode the images once more"
            )
        return np.frombuffer(content, np.uint8)


class StoredImages:
    """The images of some views, in files of pixels. Read-only.

    Args:
        places: The file of each view, and the index of its image there. [V]
    """

    def __init__(self, places: Iterable[tuple[PixelFile, int]]) -> None:
        self.places = tuple(places)
        sizes = [file.sizes[image] for file, image in self.places]
        self.sizes = torch.tensor(sizes, dtype=torch.int64).view(-1, 2)
        """Height and width of each image. int64 [V, 2]"""

    @classmethod
    def all_of(cls, file: PixelFile) -> "StoredImages":
        """All images of a file, in its order."""
        return cls((file, image) for image in range(len(file.sizes)))

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of the images as one tensor: their number, largest height and width, 4."""
        height, width = self.sizes.amax(dim=0).tolist() if self.places else (0, 0)
        return len(self.places), height, width, 4

    @property
    def nbytes(self) -> int:
        """Bytes that the images take on disk."""
        channels = torch.tensor([file.channels for file, _ in self.places])
        return int((self.sizes.prod(dim=1) * channels).sum())

    @property
    def identity(self) -> list[Any]:
        """Key that identifies these images, as builtins."""
        return [[file.key, image] for file, image in self.places]

    def image(self, index: int) -> Tensor:
        """Premultiplied colour and alpha of a view. uint8 [h, w, 4]"""
        file, image = self.places[index]
        height, width = file.sizes[image]
        found = np.full((height * width, 4), 255, np.uint8)
        found[:, : file.channels] = file.pixels(image, 0, height * width)
        return torch.from_numpy(found).view(height, width, 4)

    def silhouette(self, index: int) -> Tensor:
        """The silhouette of a view, see `silhouette_of`. bool [h, w]"""
        file, image = self.places[index]
        height, width = file.sizes[image]
        if file.channels == 3:
            return torch.ones(height, width, dtype=torch.bool)
        count = height * width
        bits = file.read(_bits(file.first, image), -(-count // 8))
        return torch.from_numpy(np.unpackbits(bits, count=count)).bool().view(height, width)

    def pixels(self, views: Tensor, runs: Tensor, inside: Tensor) -> Tensor:
        """Pixels of some runs of `RUN` pixels.

        Args:
            views: The view of each run. int64 [K]
            runs: Indices of the runs in their images. int64 [K]
            inside: Indices of the pixels in their runs. int64 [K, P]

        Returns:
            Premultiplied colour and alpha. uint8 [K, P, 4]
        """
        found = np.full((*inside.shape, 4), 255, np.uint8)
        runs_of = zip(views.tolist(), runs.tolist(), inside.numpy(), strict=True)
        for row, (view, run, wanted) in enumerate(runs_of):
            file, image = self.places[view]
            found[row, :, : file.channels] = file.pixels(image, run * RUN, RUN)[wanted]
        return torch.from_numpy(found)

    def prefetch(self, views: Tensor, runs: Tensor) -> None:
        """Ask the operating system to read some runs ahead. int64 [K], int64 [K]"""
        for view, run in zip(views.tolist(), runs.tolist(), strict=True):
            file, image = self.places[view]
            file.prefetch(image, run * RUN, RUN)

    def __getitem__(self, indices: Tensor) -> "StoredImages":
        """The images at ``indices``, in that order. [K]"""
        return StoredImages(self.places[index] for index in indices.tolist())

    def joined(self, other: "StoredImages") -> "StoredImages":
        """These images, then the others."""
        return StoredImages(self.places + other.places)


def default_cache() -> Path:
    """The folder of decoded images in the user's cache directory."""
    try:
        home = Path.home()
    except RuntimeError:  # No home directory, as in containers; the path below cannot be created.
        home = Path(os.devnull)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or home / ".cache"
    return Path(base) / "xplanes" / "images"


def images(
    sizes: Sequence[Size],
    jobs: Sequence[Job],
    sources: Sequence[Path],
    recipe: Any,
    has_alpha: Callable[[], bool],
    folder: Path | None,
) -> "Tensor | StoredImages":
    """Decode images to memory, or to a file of the cache if they take more than `IN_MEMORY` bytes.

    If several processes need the same images, one decodes them and the others wait. Leftovers of a
    killed process are removed by the next one. Before a new file is added to the user's cache,
    files that were not used for `UNUSED_DAYS` are removed from it.

    Args:
        sizes: Height and width of each image. [V]
        jobs: Each decodes some of the images, in a thread.
        sources: Files of the images; their sizes and modification times are part of the key.
        recipe: Parameters of the decoding, as builtins.
        has_alpha: Whether any image has alpha.
        folder: The cache; the user's when None.

    Raises:
        StorageError: If the disk is full or cannot be written.
    """
    height, width = _largest(sizes)
    if 4 * len(sizes) * height * width <= IN_MEMORY:
        return in_memory(sizes, jobs)
    channels = 4 if has_alpha() else 3
    is_default = folder is None
    folder = default_cache() if folder is None else folder
    states = [(str(path.resolve()), path.stat()) for path in sources]
    files = [[name, state.st_size, state.st_mtime_ns] for name, state in states]
    content = json.dumps([VERSION, channels, list(sizes), recipe, files])
    key = hashlib.sha256(content.encode()).hexdigest()
    path = folder / f"{key[:32]}.pixels"
    length = _length(sizes, channels)

    def stored() -> StoredImages | None:
        try:
            if path.stat().st_size != length:
                return None
            with suppress(OSError):  # The cache may belong to another user, or be read-only.
                os.utime(path)
            return StoredImages.all_of(PixelFile(path, key, sizes, channels))
        except (FileNotFoundError, NotADirectoryError, PermissionError):
            return None

    if (ready := stored()) is not None:
        return ready
    try:
        require_writable(folder)
    except StorageError as problem:
        raise StorageError(f"{problem}; data.cache sets the folder of decoded images") from problem
    with in_turn(path.with_suffix(".lock")) as alone:
        if (ready := stored()) is not None:
            return ready
        # The lock's owner may remove unfinished files of this name.
        for leftover in folder.glob(f".{path.name}{MARK}*") if alone else ():
            leftover.unlink(missing_ok=True)
        if is_default:
            _remove_unused(folder)
        free = shutil.disk_usage(existing(folder)).free
        if free < length + SPARE:
            raise StorageError(
                f"{folder} has {free / 2**30:.1f} GB free, but the decoded images take "
                f"{length / 2**30:.1f} GB. Free some space, set data.cache to a folder on another "
                "disk, or take fewer or smaller images"
            )
        print(
            f"{len(sizes)} images of up to {width}x{height} px take {length / 2**30:.1f} GB "
            f"decoded, too much for memory: decoding them once to {path} (delete it when no run "
            "needs it"
            f"{f'; it is deleted after {UNUSED_DAYS} days without use' if is_default else ''})",
            flush=True,
        )
        with replacing(path) as temporary:
            _write(temporary, sizes, channels, jobs)
    ready = stored()
    assert ready is not None
    return ready


def in_memory(sizes: Sequence[Size], jobs: Sequence[Job]) -> Tensor:
    """Decode images to one tensor, padded with zeros at the bottom and on the right.

    Args:
        sizes: Height and width of each image. [V]
        jobs: Each decodes some of the images, in a thread.

    Returns:
        Premultiplied colour and alpha. uint8 [V, H, W, 4]
    """
    empty = torch.empty if len(set(sizes)) == 1 else torch.zeros
    images = empty(len(sizes), *_largest(sizes), 4, dtype=torch.uint8)

    def keep(index: int, pixels: np.ndarray) -> None:
        height, width = sizes[index]
        images[index, :height, :width] = torch.from_numpy(_with_channels(pixels, 4))

    _run(jobs, keep)
    return images


def _remove_unused(folder: Path) -> None:
    """Remove files that were not used for long, and unfinished files of killed processes."""
    clear_unfinished(folder, older_than=DAY)
    oldest, freed = time.time() - UNUSED_DAYS * DAY, 0
    for path in folder.iterdir():
        # Windows does not remove open files; elsewhere readers keep their open files.
        with suppress(OSError):
            if not NAME.fullmatch(path.name) or path.stat().st_mtime > oldest:
                continue
            with if_free(path.with_suffix(".lock")) as free:
                if free and (state := path.stat()).st_mtime <= oldest:
                    path.unlink()
                    freed += state.st_size
    if freed:
        print(
            f"removed {freed / 2**30:.1f} GB of decoded images that no run has used for "
            f"{UNUSED_DAYS} days from {folder}",
            flush=True,
        )


def _write(path: Path, sizes: Sequence[Size], channels: int, jobs: Sequence[Job]) -> None:
    """Decode all images to a file, with one image per thread in memory."""
    from tqdm import tqdm

    first, lock = _firsts(sizes), threading.Lock()
    how = {"unit": "image", "leave": False, "disable": not sys.stderr.isatty()}
    with (
        path.open("r+b", buffering=0) as file,
        tqdm(total=len(sizes), desc="decoding", **how) as bar,
    ):
        file.truncate(_length(sizes, channels))

        def keep(index: int, pixels: np.ndarray) -> None:
            assert pixels.shape[:2] == sizes[index]
            for offset, part in _parts(first, channels, index, pixels):
                content = part.data
                with lock:
                    file.seek(offset)
                    # One call may write only a part, at most 2 GB on Linux.
                    while len(content):
                        content = content[file.write(content) :]
            bar.update()

        _run(jobs, keep)


def _run(jobs: Sequence[Job], keep: Callable[[int, np.ndarray], None]) -> None:
    """Run jobs in threads until one fails; each decoded image is passed to ``keep``."""
    stop = threading.Event()

    def run(job: Job) -> None:
        try:
            for index, pixels in job():
                if stop.is_set():
                    return
                keep(index, pixels)
        except BaseException:
            stop.set()  # Ends other jobs early.
            raise

    # Decoders release the interpreter lock, so that threads suffice.
    pool = ThreadPoolExecutor(min(8, os.cpu_count() or 1, len(jobs)))
    try:
        list(pool.map(run, jobs))
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)


def _with_channels(pixels: np.ndarray, channels: int) -> np.ndarray:
    """Pixels with 3 or 4 channels: alpha is dropped, or added as 255. uint8 [h, w, C]"""
    if pixels.shape[-1] >= channels:
        return pixels[..., :channels]
    return np.pad(pixels, ((0, 0), (0, 0), (0, 1)), constant_values=255)


def _parts(
    first: Sequence[int], channels: int, index: int, pixels: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:
    """The bytes of image ``index`` in a file, and their offsets. uint8 [h, w, C] -> uint8 [N]"""
    pixels = np.ascontiguousarray(_with_channels(pixels, channels))
    yield first[index] * channels, pixels.reshape(-1)
    if channels == 4:
        seen = silhouette_of(torch.from_numpy(np.ascontiguousarray(pixels[..., 3])))
        yield _bits(first, index), np.packbits(seen.numpy())


def _bits(first: Sequence[int], index: int) -> int:
    """Offset of the bits of image ``index``; an extra byte per image allows for a partial byte."""
    return first[-1] * 4 + first[index] // 8 + index


def _length(sizes: Sequence[Size], channels: int) -> int:
    first = _firsts(sizes)
    return _bits(first, len(sizes)) if channels == 4 else first[-1] * channels


def _largest(sizes: Sequence[Size]) -> Size:
    return max(height for height, _ in sizes), max(width for _, width in sizes)


def _firsts(sizes: Sequence[Size]) -> list[int]:
    """Index of each image's first pixel, and the number of all pixels."""
    return [0, *np.cumsum([height * width for height, width in sizes]).tolist()]
