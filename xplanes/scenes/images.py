"""Image files decoded, multiplied by alpha and reduced to the working resolution."""

import os
import struct
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from xplanes.scenes import store
from xplanes.scenes.errors import SceneError

Size = tuple[int, int]
"""Height and width."""

FORMATS = ("PNG", "JPEG")
EIGHT_BIT_MODES = ("RGBA", "RGB", "LA", "L", "P", "PA", "1")
SIXTEEN_BIT_MODES = ("I;16", "I;16L", "I;16B", "I")
UNREADABLE = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    struct.error,
    Image.DecompressionBombError,
)


def load_images(paths: Sequence[Path], resolution: int | None) -> Tensor:
    """Decode images of one size and reduce them to ``resolution`` pixels square.

    Args:
        paths: Image files, PNG or JPEG, at least one. [V]
        resolution: Pixels per side; None keeps the size of the files.

    Returns:
        Colour, multiplied by alpha before it was averaged, and alpha. uint8 [V, H, W, 4]

    Raises:
        SceneError: A file cannot be decoded, sizes differ, or the resolution cannot be met.
    """
    common_size(paths)
    native = [_read_header(path)[0] for path in paths]
    return _into_memory(paths, final_sizes(paths, native, resolution))


def read_images(
    paths: Sequence[Path], resolution: int | None, cache: Path | None = None
) -> tuple[Tensor | store.StoredImages, list[Size], list[Size]]:
    """Decode images of any sizes and reduce them to ``resolution`` pixels square.

    Images that take more than `store.IN_MEMORY` bytes are decoded once to a file of the cache.

    Args:
        paths: Image files, PNG or JPEG, at least one. [V]
        resolution: Pixels per side; None keeps the sizes of the files.
        cache: Folder of decoded images; that of the user when None.

    Returns:
        Colour, multiplied by alpha before it was averaged, and alpha, smaller images padded with
        zeros at the bottom and on the right: uint8 [V, H, W, 4]. Then the height and width of each
        file, and those of each image without padding.

    Raises:
        SceneError: A file cannot be decoded, or the resolution cannot be met.
        StorageError: The cache cannot be written.
    """
    headers = [_read_header(path) for path in paths]
    native = [size for size, _ in headers]
    sizes = final_sizes(paths, native, resolution)
    if not store.is_needed(sizes):
        return _into_memory(paths, sizes), native, sizes
    channels = 4 if any(alpha for _, alpha in headers) else 3

    def job(index: int) -> store.Job:
        def decode() -> Iterator[tuple[int, np.ndarray]]:
            yield index, read_image(paths[index], sizes[index])[..., :channels]

        return decode

    jobs = [job(index) for index in range(len(paths))]
    return store.decoded(paths, "images", sizes, channels, jobs, cache), native, sizes


def read_image(path: Path, size: Size) -> np.ndarray:
    """Decode one image and reduce it to a size: premultiplied colour, alpha. uint8 [H, W, 4]"""
    height, width = size
    return shrink(load_premultiplied(path), width, height)


def final_sizes(
    paths: Sequence[Path], native: Sequence[Size], resolution: int | None
) -> list[Size]:
    """Height and width of each image after it is reduced.

    Raises:
        SceneError: If an image of these native sizes cannot be reduced to the resolution.
    """
    if resolution is None:
        return list(native)
    for path, (height, width) in zip(paths, native, strict=True):
        check_resolution(path, width, height, resolution)
    return [(resolution, resolution)] * len(paths)


def _into_memory(paths: Sequence[Path], sizes: Sequence[Size]) -> Tensor:
    """Decode images to one tensor, padded at the bottom and on the right. uint8 [V, H, W, 4]"""
    largest = max(height for height, _ in sizes), max(width for _, width in sizes)
    same = len(set(sizes)) == 1
    images = (torch.empty if same else torch.zeros)(len(paths), *largest, 4, dtype=torch.uint8)

    def fill(index: int) -> None:
        height, width = sizes[index]
        pixels = read_image(paths[index], sizes[index])
        images[index, :height, :width] = torch.from_numpy(pixels)

    # Pillow decodes and resamples without the interpreter lock, so threads are enough.
    pool = ThreadPoolExecutor(min(8, os.cpu_count() or 1, len(paths)))
    try:
        list(pool.map(fill, range(len(paths))))
    finally:
        pool.shutdown(cancel_futures=True)
    return images


def common_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Width and height that all files share, read from their headers alone."""
    sizes = [_read_header(path)[0] for path in paths]
    first_height, first_width = sizes[0]
    for path, (height, width) in zip(paths, sizes, strict=True):
        if (height, width) != sizes[0]:
            raise SceneError(
                f"{path} has {width}x{height} pixels, but {paths[0]} has "
                f"{first_width}x{first_height}. All images must have one size: "
                f"export or resize them alike."
            )
    return first_width, first_height


def check_resolution(path: Path, width: int, height: int, resolution: int) -> None:
    """Refuse a resolution that images of ``width`` x ``height`` pixels cannot be reduced to."""
    if resolution < 1:
        raise SceneError(
            f"data.resolution={resolution} is not a size. Give 1 to {width} pixels, or null "
            f"to keep the {width}x{height} pixels of {path}."
        )
    if width != height:
        raise SceneError(
            f"{path} has {width}x{height} pixels, and data.resolution={resolution} stands for a "
            f"square. Set data.resolution=null to keep the images as they are; shrinking the files "
            f"leaves camera_angle_x as it is, cropping them does not."
        )
    if resolution > width:
        raise SceneError(
            f"data.resolution={resolution} is more than the {width} pixels of {path}. Enlarged "
            f"images hold no more detail: give at most {width}, or null for the native size."
        )


def load_premultiplied(path: Path) -> np.ndarray:
    """Decode one image to colour times alpha and alpha, from 0 to 255. float32 [4, H, W]"""
    try:
        with Image.open(path, formats=FORMATS) as picture:
            picture.load()
            channels = _straight_channels(path, picture)
    except SceneError:
        raise
    except UNREADABLE as problem:
        raise _unreadable(path, problem) from problem
    channels[:3] *= channels[3] * np.float32(1 / 255)
    return channels


def shrink(channels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Reduce premultiplied channels: each pixel becomes the mean of the area that it covers.

    Unlike Lanczos, whose rings put light and alpha around every edge, means stay exact zeros
    where nothing is.

    Args:
        channels: Colour times alpha and alpha, from 0 to 255. float32 [4, h, w]
        width: Columns wanted, at most those given.
        height: Rows wanted, at most those given.

    Returns:
        Rounded pixels with colour <= alpha. uint8 [H, W, 4]
    """
    rows, columns = channels.shape[1:]
    if rows % height == 0 and columns % width == 0:
        factors = (columns // width, rows // height)
        reduced = [Image.fromarray(channel).reduce(factors) for channel in channels]
        channels = np.stack([np.asarray(channel) for channel in reduced])
    else:
        channels = _area_weights(rows, height) @ channels @ _area_weights(columns, width).T
    alpha = channels[3].clip(0, 255)
    colour = channels[:3].clip(0, alpha)
    pixels = np.concatenate([colour, alpha[None]])
    return np.rint(pixels).astype(np.uint8).transpose(1, 2, 0)


def _area_weights(fine: int, coarse: int) -> np.ndarray:
    """Share of each fine cell in each coarse one, both dividing one length. [coarse, fine]"""
    edges = np.arange(coarse + 1) * (fine / coarse)
    cells = np.arange(fine)
    overlap = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
    return (overlap.clip(0) * (coarse / fine)).astype(np.float32)


def _straight_channels(path: Path, picture: Image.Image) -> np.ndarray:
    """Red, green, blue and alpha, from 0 to 255. float32 [4, H, W]"""
    channels = np.empty((4, picture.height, picture.width), np.float32)
    if picture.mode in SIXTEEN_BIT_MODES:
        channels[:3] = np.asarray(picture, np.float32) / 257
        channels[3] = 255
        return channels
    if picture.mode not in EIGHT_BIT_MODES:
        raise SceneError(
            f"{path} holds pixels of kind {picture.mode}. Save it as an RGBA or RGB PNG; "
            f"greyscale and palette images are read too."
        )
    for channel, values in zip(channels, picture.convert("RGBA").split(), strict=True):
        channel[:] = np.asarray(values)
    return channels


def _read_header(path: Path) -> tuple[Size, bool]:
    """Height and width of an image file, and whether it may have alpha."""
    try:
        with Image.open(path, formats=FORMATS) as picture:
            alpha = "A" in picture.getbands() or "transparency" in picture.info
            return (picture.height, picture.width), alpha
    except UNREADABLE as problem:
        raise _unreadable(path, problem) from problem


def _unreadable(path: Path, problem: BaseException) -> SceneError:
    return SceneError(
        f"{path} cannot be decoded as PNG or JPEG ({problem}). It is probably truncated or "
        f"damaged: export or download it again."
    )
