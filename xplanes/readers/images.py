"""Decodes image files, premultiplies them by alpha and reduces them to the working resolution."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from xplanes.errors import SceneError, all_of, warn
from xplanes.readers.formats import SIXTEEN_BIT_MODES, open_image, read_header
from xplanes.readers.masks import MaskKind, read_mask
from xplanes.scenes import store
from xplanes.scenes.store import Size

EIGHT_BIT_MODES = ("RGBA", "RGB", "CMYK", "LA", "L", "P", "PA", "1")

GREY = MaskKind(labels=False)
"""Kind of grey masks, from black to white."""

MASKS = 3
"""Version of the treatment of masks; increase it whenever decoded images change."""


@dataclass(frozen=True)
class Picture:
    """An image file, and how it is decoded.

    Attributes:
        path: The file.
        size: Height and width of the reduced image.
        mask: File by which alpha is multiplied; None for none.
        kind: Meaning of the mask, see `masks.read_mask`.
        clear: Grey levels, out of 255, that are transparent.
        has_ray: Pixels of the reduced image with a ray; None for all. bool [h, w]
    """

    path: Path
    size: Size
    mask: Path | None = None
    kind: MaskKind = GREY
    clear: tuple[int, ...] = ()
    has_ray: Tensor | None = None

    def decoded(self) -> np.ndarray:
        """Colour, premultiplied by alpha before it is averaged, and alpha. uint8 [h, w, 4]"""
        channels = load_premultiplied(self.path, self.clear)
        if self.mask is not None:
            channels *= read_mask(self.mask, self.kind, self.path)
        height, width = self.size
        return cleared(shrink(channels, width, height), self.has_ray)


def load_images(paths: Sequence[Path], resolution: int | None) -> Tensor:
    """Decode images of one size and reduce them to a width.

    Args:
        paths: Image files, at least one. [V]
        resolution: Width in pixels; None keeps the size of the files.

    Returns:
        Colour, premultiplied by alpha before it is averaged, and alpha. uint8 [V, H, W, 4]

    Raises:
        SceneError: If a file cannot be decoded, or sizes differ.
    """
    advice = "All images must have one size: export or resize them alike."
    size = shared_size(paths, str(paths[0]), advice)
    sizes = final_sizes(paths, [size] * len(paths), resolution)
    return store.in_memory(sizes, _jobs([*map(Picture, paths, sizes)]))


def native_sizes(paths: Sequence[Path]) -> list[Size]:
    """Heights and widths of image files, read from their headers alone.

    Raises:
        SceneError: If files are not images; the message names all of them.
    """
    return all_of(lambda path: read_header(path)[0], paths)


def shared_size(paths: Sequence[Path], first: str, advice: str) -> Size:
    """Height and width of image files that must have one size.

    Args:
        paths: The files, at least one.
        first: Description of the first one, for messages.
        advice: Further text of the message.

    Raises:
        SceneError: If their sizes differ, or files are not images.
    """
    size, *others = native_sizes(paths)
    for path, (height, width) in zip(paths[1:], others, strict=True):
        if (height, width) != size:
            raise SceneError(
                f"{path} has {width}x{height} pixels, but {first} has {size[1]}x{size[0]}. {advice}"
            )
    return size


def width_rank(width: int, resolution: int | None) -> tuple[bool, int]:
    """Sort key of copies of an image: the narrowest that is wide enough first, else the widest.

    Args:
        width: Width of the copy in pixels.
        resolution: Wanted width in pixels; None wants the widest copy.
    """
    is_enough = resolution is not None and width >= resolution
    return not is_enough, width if is_enough else -width


def final_sizes(
    paths: Sequence[Path], native: Sequence[Size], resolution: int | None
) -> list[Size]:
    """Heights and widths of images that are reduced to one width, with their own aspect ratios.

    Narrower images keep their size, with a warning, as enlarged ones have no more detail.

    Args:
        paths: Image files. [V]
        native: Their sizes. [V]
        resolution: Width in pixels; None keeps the sizes.
    """
    if resolution is None:
        return list(native)
    pairs = zip(paths, native, strict=True)
    if narrow := [(width, path) for path, (_, width) in pairs if width < resolution]:
        width, path = min(narrow)
        warn(
            f"data.resolution={resolution} is more than the width of {len(narrow)} of {len(paths)} "
            f"images or cameras, which keep their size: {path} is {width} pixels wide. Set at most "
            f"{width} for equal widths, or null for the native size."
        )
    kept = [(height, width, min(width, resolution)) for height, width in native]
    return [(max(1, round(height * less / width)), less) for height, width, less in kept]


def read_images(
    pictures: Sequence[Picture], cache: Path | None = None
) -> Tensor | store.StoredImages:
    """Decode images of any sizes and reduce them.

    Images that take more than `store.IN_MEMORY` bytes are decoded once to a file in the cache.

    Args:
        pictures: At least one, with one kind of masks and the same transparent levels. [V]
        cache: Folder of decoded images; the user's cache when None.

    Returns:
        The images of `Picture.decoded`, padded with zeros at the bottom and on the right.
        uint8 [V, H, W, 4]

    Raises:
        SceneError: If a file cannot be decoded, or a mask does not fit its image.
        StorageError: If the cache cannot be written.
    """
    kind, clear = pictures[0].kind, pictures[0].clear
    sources = [picture.path for picture in pictures]
    masks = [picture.mask for picture in pictures if picture.mask is not None]
    meaning = [MASKS, kind.labels, kind.inverted]
    masked = [picture.mask is not None for picture in pictures] if masks else []
    has_ray = [picture.has_ray for picture in pictures]
    recipe = ["images", meaning, masked, digests(has_ray), *clear]

    def has_alpha() -> bool:
        changed = clear or masks or any(shown is not None for shown in has_ray)
        return bool(changed) or any(read_header(path)[1] for path in sources)

    sizes, jobs = [picture.size for picture in pictures], _jobs(pictures)
    try:
        return store.images(sizes, jobs, sources + masks, recipe, has_alpha, cache)
    except SceneError:
        # Reports all files that fail, without keeping what the others decode to.
        all_of(lambda picture: picture.decoded().size, pictures)
        raise


def _jobs(pictures: Sequence[Picture]) -> list[store.Job]:
    def decode(index: int) -> list[tuple[int, np.ndarray]]:
        return [(index, pictures[index].decoded())]

    return [partial(decode, index) for index in range(len(pictures))]


def cleared(pixels: np.ndarray, shown: Tensor | None) -> np.ndarray:
    """Pixels, set to 0 outside ``shown``. uint8 [h, w, C], bool [h, w]"""
    if shown is not None:
        pixels[~shown.numpy()] = 0
    return pixels


def digests(masks: Sequence[Tensor | None]) -> list[str]:
    """Hashes of masks; repeated tensors are hashed once."""
    known: dict[int, str] = {id(None): ""}
    for mask in masks:
        if mask is not None and id(mask) not in known:
            known[id(mask)] = hashlib.sha256(mask.numpy().tobytes()).hexdigest()
    return [known[id(mask)] for mask in masks]


def load_premultiplied(path: Path, clear: Sequence[int] = ()) -> np.ndarray:
    """Decode one image to colour times alpha and alpha, from 0 to 255. float32 [4, H, W]

    Pixels with one of the grey levels ``clear`` are transparent.
    """
    with open_image(path) as picture:
        picture.load()
        channels = _straight_channels(path, picture)
    for level in clear:
        channels[3, (channels[:3] == level).all(axis=0)] = 0
    channels[:3] *= channels[3] * np.float32(1 / 255)
    return channels


def shrink(channels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Reduce premultiplied channels: each pixel is the mean over its area.

    Lanczos would cause ringing in colour and alpha around every edge; means are exactly 0 in empty
    areas.

    Args:
        channels: Colour times alpha and alpha, from 0 to 255. float32 [4, h, w]
        width: Columns of the result, at most those of the input.
        height: Rows of the result, at most those of the input.

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
    """Weights that average fine cells into coarse cells by their overlap. [coarse, fine]"""
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
