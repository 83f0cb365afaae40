"""Decoded images that need not fit in memory: files of tiles, written once and read in pieces.

A file holds the tiles of all images one after the other, each image's row by row, then
`FLAG_BYTES` a tile that say what the silhouette holds of it: a bit for each of its cells that has
any pixel of it, row by row, and a byte that is 1 if all pixels are; images without alpha have three
channels and no such bytes. Its name is a hash of the sources and of how they were decoded, so it
needs no header: a file of that name and of the right length is the right one. Its time of change is
when it was used last.

Tiles are read, not mapped: pages of a mapping count as the process's own memory, those that reading
leaves in the system's cache do not.
"""

import hashlib
import json
import os
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
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

IN_MEMORY = 2**30
"""Bytes up to which the decoded images of a split are held in memory."""

TILE = 64
"""Rows and columns of a tile: 12 kB without alpha, 16 kB with it, whole pages either way."""

CELL = 8
"""Rows and columns of the cells in which the silhouettes are known."""

FLAG_BYTES = (TILE // CELL) ** 2 // 8 + 1
"""Bytes that say what the silhouette holds of a tile."""

VERSION = 3
"""Version of the files; increase it whenever images are decoded to other bytes or flags."""

SPARE = 2**28
"""Bytes of the disk that are left free."""

UNUSED_DAYS = 30
"""Days after which a file of the user's cache that no run has used is removed."""

NAME = re.compile(r"[0-9a-f]{32}\.tiles")
"""Names of the files."""

Job = Callable[[], Iterable[tuple[int, np.ndarray]]]
"""Decodes some of the images: gives their numbers and pixels, uint8 [h, w, 3 or 4]."""


class StoredImages:
    """The images of some views, in files of tiles. Read-only.

    Args:
        files: Where the tiles are.
        places: Number of the file, and of the image in it, for each view. int64 [V, 2]
    """

    def __init__(self, files: Sequence["TileFile"], places: Tensor) -> None:
        self.files, self.places = tuple(files), places
        self._of_view = places.tolist()
        sizes = [self.files[file].sizes[image] for file, image in self._of_view]
        self.sizes = torch.tensor(sizes, dtype=torch.int64).view(-1, 2)
        """Height and width of each image. int64 [V, 2]"""

    @classmethod
    def all_of(cls, file: "TileFile") -> "StoredImages":
        """All images of a file, in its order."""
        return cls([file], torch.tensor([[0, image] for image in range(len(file.sizes))]))

    def __len__(self) -> int:
        return len(self._of_view)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """That of the images as one tensor: their number, largest height and width, 4."""
        height, width = self.sizes.amax(dim=0).tolist() if len(self) else (0, 0)
        return len(self), height, width, 4

    @property
    def nbytes(self) -> int:
        """Bytes that the images take on disk."""
        tiles = (-(-self.sizes // TILE)).prod(dim=1)
        channels = torch.tensor([self.files[file].channels for file, _ in self._of_view])
        return int((tiles * channels).sum()) * TILE**2

    @property
    def identity(self) -> list[Any]:
        """What tells these images from others, as builtins."""
        return [[file.key for file in self.files], self._of_view]

    def image(self, index: int) -> Tensor:
        """Premultiplied colour and alpha of a view. uint8 [h, w, 4]"""
        file, image = self._of_view[index]
        return self.files[file].image(image)

    def lit(self, index: int) -> Tensor:
        """Which cells hold some of a view's silhouette. bool [h / CELL, w / CELL] (ceiled)"""
        file, image = self._of_view[index]
        return self.files[file].lit(image)

    def solid(self, index: int) -> Tensor:
        """Which tiles a view's silhouette holds whole. bool [rows, columns]"""
        file, image = self._of_view[index]
        return self.files[file].solid(image)

    def pixels(self, views: Tensor, tiles: Tensor, inside: Tensor) -> Tensor:
        """Pixels of some tiles.

        Args:
            views: The view of each tile. int64 [K]
            tiles: Numbers of the tiles in their images, row by row. int64 [K]
            inside: Numbers of the pixels in their tiles, row by row. int64 [K, P]

        Returns:
            Premultiplied colour and alpha. uint8 [K, P, 4]
        """
        wanted = inside.numpy()
        found = np.full((*wanted.shape, 4), 255, np.uint8)
        for row, (view, tile) in enumerate(zip(views.tolist(), tiles.tolist(), strict=True)):
            number, image = self._of_view[view]
            file = self.files[number]
            found[row, :, : file.channels] = file.tiles(image, tile, 1)[wanted[row]]
        return torch.from_numpy(found)

    def prefetch(self, views: Tensor, tiles: Tensor) -> None:
        """Let the system begin to read some tiles. int64 [K], int64 [K]"""
        for view, tile in zip(views.tolist(), tiles.tolist(), strict=True):
            file, image = self._of_view[view]
            self.files[file].prefetch(image, tile)

    def subset(self, indices: Tensor) -> "StoredImages":
        """The images at ``indices``, in that order. [K]"""
        return StoredImages(self.files, self.places[indices])

    def joined(self, other: "StoredImages") -> "StoredImages":
        """These, then the others."""
        shift = torch.tensor([len(self.files), 0])
        return StoredImages(
            self.files + other.files, torch.cat([self.places, other.places + shift])
        )


class TileFile:
    """A file of tiles, or the same in memory.

    Args:
        source: The file, or the tiles of all images. uint8 [tiles, TILE**2, C]
        key: Hash of what the images come from.
        sizes: Height and width of each image.
        channels: 3 for images without alpha, else 4.
        flags: What the silhouettes hold; None for images without alpha. uint8 [tiles, FLAG_BYTES]
    """

    def __init__(
        self,
        source: Path | np.ndarray,
        key: str,
        sizes: Sequence[tuple[int, int]],
        channels: int,
        flags: np.ndarray | None = None,
    ) -> None:
        self.source, self.key, self.sizes, self.channels = source, key, tuple(sizes), channels
        self.first = _firsts(sizes)
        self._file = source.open("rb", buffering=0) if isinstance(source, Path) else None
        if channels == 4 and flags is None:
            assert isinstance(source, Path)
            total = self.first[-1]
            end = total * TILE**2 * channels
            flags = np.fromfile(source, np.uint8, total * FLAG_BYTES, offset=end)
            flags = flags.reshape(total, FLAG_BYTES)
        self._flags = flags

    def __reduce__(self) -> Any:
        return TileFile, (self.source, self.key, self.sizes, self.channels, self._flags)

    @classmethod
    def of(cls, images: Iterable[Tensor]) -> "TileFile":
        """The same in memory, of images with alpha. uint8 [h, w, 4] each"""
        images = list(images)
        tiles = np.concatenate([to_tiles(image.numpy()) for image in images])
        flags = np.concatenate([_alpha_flags(image.numpy()) for image in images])
        sizes = [(image.shape[0], image.shape[1]) for image in images]
        return cls(tiles, hashlib.sha256(tiles.data).hexdigest(), sizes, 4, flags)

    def image(self, index: int) -> Tensor:
        """Premultiplied colour and alpha of an image. uint8 [h, w, 4]"""
        (height, width), channels = self.sizes[index], self.channels
        rows, columns = _grid(height, width)
        tiles = self.tiles(index, 0, rows * columns).reshape(rows, columns, TILE, TILE, channels)
        whole = np.full((rows * TILE, columns * TILE, 4), 255, np.uint8)
        whole.reshape(rows, TILE, columns, TILE, 4)[..., :channels] = tiles.swapaxes(1, 2)
        return torch.from_numpy(whole)[:height, :width]

    def lit(self, index: int) -> Tensor:
        """Which cells hold some of an image's silhouette. bool, as in `StoredImages.lit`"""
        height, width = self.sizes[index]
        cells = -(-height // CELL), -(-width // CELL)
        if self._flags is None:
            return torch.ones(cells, dtype=torch.bool)
        part = self._flags[self.first[index] : self.first[index + 1], :-1]
        return _from_tiles(unpacked(part), _grid(height, width))[: cells[0], : cells[1]]

    def solid(self, index: int) -> Tensor:
        """Which tiles an image's silhouette holds whole. bool [rows, columns]"""
        grid = _grid(*self.sizes[index])
        if self._flags is None:
            return torch.ones(grid, dtype=torch.bool)
        part = self._flags[self.first[index] : self.first[index + 1], -1]
        return torch.from_numpy(part > 0).view(grid)

    def tiles(self, index: int, tile: int, count: int) -> np.ndarray:
        """Tiles of an image, ``tile`` the first. uint8 [count, TILE**2, C]; of 1 [TILE**2, C]"""
        number = self.first[index] + tile
        shape = (TILE**2, self.channels) if count == 1 else (count, TILE**2, self.channels)
        if isinstance(self.source, np.ndarray):
            return self.source[number : number + count].reshape(shape)
        length = TILE**2 * self.channels
        content = self._read(number * length, count * length)
        return np.frombuffer(content, np.uint8).reshape(shape)

    def _read(self, offset: int, length: int) -> bytes:
        assert self._file is not None
        if hasattr(os, "pread"):
            content = os.pread(self._file.fileno(), length, offset)
        else:
            # Windows has no such call, and a position shared by threads would not do.
            assert isinstance(self.source, Path)
            with self.source.open("rb", buffering=0) as file:
                file.seek(offset)
                content = file.read(length)
        if len(content) < length:
            raise StorageError(
                f"{self.source} ends too early: it was cut off while in use. Delete it and start "
                "again; it is decoded again"
            )
        return content

    def prefetch(self, index: int, tile: int) -> None:
        """Let the system begin to read a tile, where it can be told."""
        if self._file is not None and hasattr(os, "posix_fadvise"):
            length = TILE**2 * self.channels
            offset = (self.first[index] + tile) * length
            os.posix_fadvise(self._file.fileno(), offset, length, os.POSIX_FADV_WILLNEED)


def default_cache() -> Path:
    """The folder of decoded images in the user's cache directory."""
    try:
        home = Path.home()
    except RuntimeError:  # The user has none, as in containers: no folder can be made in a file.
        home = Path(os.devnull)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or home / ".cache"
    return Path(base) / "xplanes" / "images"


def is_needed(sizes: Sequence[tuple[int, int]]) -> bool:
    """Whether images of these heights and widths are too much for memory."""
    height, width = _largest(sizes)
    return 4 * len(sizes) * height * width > IN_MEMORY


def in_memory(sizes: Sequence[tuple[int, int]], jobs: Sequence[Job]) -> Tensor:
    """Decode images to one tensor, padded with zeros at the bottom and on the right.

    Args:
        sizes: Height and width of each image. [V]
        jobs: Decode the images, each some of them. They run in threads.

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


def decoded(
    sources: Sequence[Path],
    recipe: Any,
    sizes: Sequence[tuple[int, int]],
    channels: int,
    jobs: Sequence[Job],
    folder: Path | None,
) -> StoredImages:
    """Decode images to a file of the cache, unless it is there already.

    Of processes that want the same images one decodes, the others wait. What a process that was
    killed left behind is removed by the next one. Before the user's cache takes a new file, those
    that were not used for `UNUSED_DAYS` are removed from it.

    Args:
        sources: Files that the images come from; the result belongs to their sizes and times.
        recipe: Builtins that say how they are decoded.
        sizes: Height and width of each image.
        channels: 3 if no image has alpha, else 4.
        jobs: Decode the images, each some of them. They run in threads.
        folder: The cache; that of the user when None.

    Raises:
        StorageError: If the disk lacks the space, or cannot be written.
    """
    is_default = folder is None
    folder = default_cache() if folder is None else folder
    states = [(str(path.resolve()), path.stat()) for path in sources]
    files = [[name, state.st_size, state.st_mtime_ns] for name, state in states]
    content = json.dumps([VERSION, TILE, channels, list(sizes), recipe, files])
    key = hashlib.sha256(content.encode()).hexdigest()
    path = folder / f"{key[:32]}.tiles"
    total = _firsts(sizes)[-1]
    length = total * (TILE**2 * channels + (FLAG_BYTES if channels == 4 else 0))

    def found() -> StoredImages | None:
        try:
            if path.stat().st_size != length:
                return None
            with suppress(OSError):  # The cache may be another user's, or on a read-only disk.
                os.utime(path)
            return StoredImages.all_of(TileFile(path, key, sizes, channels))
        except (FileNotFoundError, NotADirectoryError, PermissionError):
            return None

    if (ready := found()) is not None:
        return ready
    try:
        require_writable(folder)
    except StorageError as problem:
        raise StorageError(f"{problem}: data.cache names the one for decoded images") from problem
    with in_turn(path.with_suffix(".lock")):
        if (ready := found()) is not None:
            return ready
        # Whoever holds the lock owns what others left unfinished under this name.
        for leftover in folder.glob(f".{path.name}{MARK}*"):
            leftover.unlink(missing_ok=True)
        if is_default:
            _remove_unused(folder)
        _require_space(folder, length)
        height, width = _largest(sizes)
        print(
            f"{len(sizes)} images of up to {width}x{height} px take {length / 2**30:.1f} GB "
            f"decoded, too much for memory: decoding them once to {path} (it can be deleted when "
            "no run needs it"
            f"{f', and is after {UNUSED_DAYS} days without use' if is_default else ''})",
            flush=True,
        )
        with replacing(path) as temporary:
            _write(temporary, sizes, channels, jobs, length)
    ready = found()
    assert ready is not None
    return ready


def _remove_unused(folder: Path) -> None:
    """Remove files of tiles that were not used for long, and what killed writers left behind."""
    clear_unfinished(folder, older_than=DAY)
    oldest, freed = time.time() - UNUSED_DAYS * DAY, 0
    for path in folder.glob("*.tiles"):
        # Windows does not remove what is open; elsewhere readers keep what they have opened.
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


def _require_space(folder: Path, length: int) -> None:
    free = shutil.disk_usage(existing(folder)).free
    if free < length + SPARE:
        raise StorageError(
            f"{folder} has {free / 2**30:.1f} GB free, but the decoded images take "
            f"{length / 2**30:.1f} GB. Free some space, set data.cache to a folder on another "
            "disk, or take fewer or smaller images"
        )


def _write(
    path: Path, sizes: Sequence[tuple[int, int]], channels: int, jobs: Sequence[Job], length: int
) -> None:
    """Decode all images to a file. In memory is one image a thread."""
    from tqdm import tqdm

    first = _firsts(sizes)
    flags = np.zeros((first[-1], FLAG_BYTES), np.uint8)
    written = np.zeros(len(sizes), bool)
    turn = threading.Lock()
    with path.open("r+b", buffering=0) as file:
        file.truncate(length)
        bar = tqdm(
            total=len(sizes),
            desc="decoding",
            unit="image",
            leave=False,
            disable=not sys.stderr.isatty(),
        )

        def keep(index: int, pixels: np.ndarray) -> None:
            pixels = _with_channels(pixels, channels)
            assert pixels.shape == (*sizes[index], channels)
            if channels == 4:
                flags[first[index] : first[index + 1]] = _alpha_flags(pixels)
            content = to_tiles(pixels).data.cast("B")
            with turn:
                file.seek(first[index] * TILE**2 * channels)
                # A write may take less than it is given, at most 2 GB on Linux.
                while len(content):
                    content = content[file.write(content) :]
                bar.update()
            written[index] = True

        try:
            _run(jobs, keep)
        finally:
            bar.close()
        assert written.all()
        if channels == 4:
            file.seek(first[-1] * TILE**2 * channels)
            file.write(flags.tobytes())


def _run(jobs: Sequence[Job], keep: Callable[[int, np.ndarray], None]) -> None:
    """Run jobs in threads, until one fails; each image is handed on as it is decoded."""
    stop = threading.Event()

    def run(job: Job) -> None:
        try:
            for index, pixels in job():
                if stop.is_set():
                    return
                keep(index, pixels)
        except BaseException:
            stop.set()  # Other jobs may be long.
            raise

    # Decoders work without the interpreter lock, so threads are enough.
    pool = ThreadPoolExecutor(min(8, os.cpu_count() or 1, len(jobs)))
    try:
        list(pool.map(run, jobs))
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)


def _with_channels(pixels: np.ndarray, channels: int) -> np.ndarray:
    """Pixels with 3 or 4 channels: alpha is cut off, or 255. uint8 [h, w, C]"""
    if pixels.shape[-1] >= channels:
        return pixels[..., :channels]
    whole = np.full((*pixels.shape[:2], channels), 255, np.uint8)
    whole[..., : pixels.shape[-1]] = pixels
    return whole


def to_tiles(pixels: np.ndarray) -> np.ndarray:
    """An image cut into tiles, row by row, zeros beyond its edges.

    Args:
        pixels: The image. uint8 [h, w, C]

    Returns:
        Its tiles. uint8 [tiles, TILE**2, C]
    """
    height, width, channels = pixels.shape
    rows, columns = _grid(height, width)
    whole = np.zeros((rows * TILE, columns * TILE, channels), np.uint8)
    whole[:height, :width] = pixels
    tiles = whole.reshape(rows, TILE, columns, TILE, channels).swapaxes(1, 2)
    return tiles.reshape(rows * columns, TILE**2, channels)


def count_in_squares(mask: Tensor, side: int) -> Tensor:
    """How many pixels a mask holds in each square of an image.

    Args:
        mask: Pixels. bool [h, w]
        side: Rows and columns of a square.

    Returns:
        Their numbers. int64 [h / side, w / side], rounded up
    """
    height, width = mask.shape
    padded = F.pad(mask, (0, -width % side, 0, -height % side))
    return padded.view(-(-height // side), side, -(-width // side), side).sum(dim=(1, 3))


def by_tile(cells: Tensor) -> Tensor:
    """What is known of an image's cells, tile by tile, zeros beyond its edges.

    Args:
        cells: One value a cell. [h / CELL, w / CELL], rounded up

    Returns:
        The same. [tiles, (TILE / CELL)**2]
    """
    side = TILE // CELL
    height, width = cells.shape
    padded = F.pad(cells, (0, -width % side, 0, -height % side))
    tiles = padded.view(-(-height // side), side, -(-width // side), side).transpose(1, 2)
    return tiles.reshape(-1, side**2)


def packed(cells: Tensor) -> np.ndarray:
    """Flags of the cells of tiles as bits. bool [K, (TILE / CELL)**2] -> uint8 [K, B]"""
    return np.packbits(cells.numpy(), axis=1)


def unpacked(bits: np.ndarray) -> Tensor:
    """The flags that `packed` made bits of. uint8 [K, B] -> bool [K, (TILE / CELL)**2]"""
    return torch.from_numpy(np.unpackbits(bits, axis=1)).bool()


def _from_tiles(cells: Tensor, grid: tuple[int, int]) -> Tensor:
    """The inverse of `by_tile`, with what lies beyond the edges."""
    side = TILE // CELL
    rows, columns = grid
    whole = cells.view(rows, columns, side, side).transpose(1, 2)
    return whole.reshape(rows * side, columns * side)


def _alpha_flags(pixels: np.ndarray) -> np.ndarray:
    """What the silhouette holds of the tiles. uint8 [h, w, 4] -> uint8 [tiles, FLAG_BYTES]"""
    seen = silhouette_of(torch.from_numpy(np.ascontiguousarray(pixels[..., 3])))
    lit = packed(by_tile(count_in_squares(seen, CELL) > 0))
    # The padding of the tiles at the edges is neither lit nor bare.
    solid = (count_in_squares(~seen, TILE) == 0).flatten().byte().numpy()
    return np.concatenate([lit, solid[:, None]], axis=1)


def _largest(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Largest height and largest width."""
    return max(height for height, _ in sizes), max(width for _, width in sizes)


def _grid(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of tiles of an image."""
    return -(-height // TILE), -(-width // TILE)


def _firsts(sizes: Sequence[tuple[int, int]]) -> list[int]:
    """Number of the first tile of each image, and that of all tiles."""
    counts = [rows * columns for rows, columns in (_grid(*size) for size in sizes)]
    return [0, *np.cumsum(counts).tolist()]
