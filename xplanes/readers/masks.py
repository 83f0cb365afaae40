"""Mask files: the meaning of their values and black parts, determined for a whole capture."""

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from xplanes.errors import SceneError, warn
from xplanes.readers.formats import SIXTEEN_BIT_MODES, mask_misfit, open_image, read_header

logger = logging.getLogger(__name__)

MaskUse = Literal["auto", "alpha", "ignore", "lrm"]
"""Meaning of the black parts of masks.

alpha: empty space; ignore: pixels to ignore; lrm: removed only from the LRM's input; auto: empty
space if masks look like silhouettes, else pixels to ignore.
"""

Meaning = Literal["alpha", "ignore"]
"""Meaning of masks by their source or look; a source's own to ignore are white, not black."""

MASKS = re.compile(r"(?i)mask|(?<![a-z])mattes?(?![a-z])|silhouette")
"""Part of the names of masks."""

SURVEYED = 32
"""Number of masks that are sampled to determine the meaning of a capture's masks."""

LOOK = 512
"""Number of rows and columns that are sampled in each mask."""

COLOURED = 16
"""Difference between channels above which a mask is coloured; grey JPEGs stay below it."""

MOST_LABELS = 64
"""Largest number of distinct values if masks contain object labels."""

WHITE = 0.94
"""Largest label, as a share of the largest possible value."""

LOSSY = ("JPEG", "MPO", "WEBP", "AVIF", "JPEG2000")
"""Lossy formats, which change values slightly."""

RUNS = 0.6
"""Least share of pixels with a neighbour of the same value, if masks contain labels."""

NOISE = 8 / 255
"""Largest deviation from black and white in lossy formats and videos."""

SILHOUETTE_EDGE, UNCLEAR = 0.5, (0.4, 0.7)
"""Least masked-out share of the images' edges for silhouettes, and range of ambiguous shares."""

HIDDEN = 0.8
"""Masked-out share of the images' middle above which masks may be inverted silhouettes."""

KEPT = 0.9
"""Mask coverage of a pixel below which it is ignored."""


@dataclass(frozen=True)
class MaskKind:
    """Meaning of the masks of a capture.

    Attributes:
        labels: Whether values are object labels; all except 0 belong to the foreground.
        edge: Masked-out share of the pixels at the images' edges.
        share: Masked-out share of all pixels.
        inverted: Whether white pixels are masked out.
        middle: Masked-out share of the pixels in the images' middle.
        shared: Whether several images share a mask file, which then cannot be a silhouette.
        equal: Whether masks of several images are equal, although their files are separate.
    """

    labels: bool
    edge: float = 0.0
    share: float = 0.0
    inverted: bool = False
    middle: float = 0.0
    shared: bool = False
    equal: bool = False

    @property
    def use(self) -> Meaning:
        """Meaning of the black parts: empty if the masks are silhouettes, else to be ignored."""
        return "alpha" if self.edge >= SILHOUETTE_EDGE and not self.shared else "ignore"

    @property
    def is_unclear(self) -> bool:
        """Whether the meaning is ambiguous."""
        if self.shared:
            return False
        if self.edge >= SILHOUETTE_EDGE:
            return self.equal or self.edge < UNCLEAR[1]
        return self.edge > UNCLEAR[0] or self.middle > HIDDEN


def survey(masks: Sequence[Path | None], inverted: bool = False) -> MaskKind:
    """Determine the meaning of a capture's masks from a sample of them.

    Args:
        masks: A file for each image, or None. [V]
        inverted: Whether white pixels are masked out.

    Raises:
        SceneError: If a mask cannot be decoded.
    """
    given = [mask for mask in masks if mask is not None]
    files = list(dict.fromkeys(given))
    shared = 1 < len(given) >= 2 * len(files)
    files = files[:: -(-len(files) // SURVEYED) or 1]
    numbers: set[float] = set()
    stored = []
    for path in files:
        grey, lossy = _stored(path)
        # Labels need exact values, which lossy formats do not preserve.
        may_be_labels = not lossy and _has_regions(grey)
        numbers |= set(np.unique(grey).tolist()) if may_be_labels else {1}
        stride = -(-max(grey.shape) // LOOK)
        stored.append(grey[::stride, ::stride])
    labels = len(numbers) <= MOST_LABELS and max(numbers, default=0) <= WHITE and 0 in numbers
    kind = MaskKind(labels, inverted=inverted)
    edges, shares, middles = [], [], []
    contents = set()
    for place, grey in enumerate(stored):
        out = 1 - _factors(grey, kind)
        contents.add(hash(out.tobytes()))
        shares.append(float(out.mean()))
        if out.all() and (edges or place < len(stored) - 1):
            continue  # An all-black mask tells nothing.
        rim = np.concatenate([out[0], out[-1], out[1:-1, 0], out[1:-1, -1]])
        edges.append(float(rim.mean()))
        rows, columns = (slice(round(0.45 * n), round(0.55 * n) + 1) for n in out.shape)
        middles.append(float(out[rows, columns].mean()))
    edge, share, middle = (float(np.mean(values)) for values in (edges, shares, middles))
    equal = len(files) > 2 and len(contents) == 1
    return replace(kind, edge=edge, share=share, middle=middle, shared=shared, equal=equal)


def _has_regions(grey: np.ndarray) -> bool:
    """Whether most pixels above 0 have a neighbour of the same value, unlike noise. [H, W]"""
    above = grey > 0
    across = (grey[:, 1:] == grey[:, :-1])[above[:, 1:]]
    down = (grey[1:] == grey[:-1])[above[1:]]
    return not above.any() or any(len(same) and same.mean() >= RUNS for same in (across, down))


def chosen_use(
    use: MaskUse, kind: MaskKind, where: str, told: Meaning | None
) -> tuple[MaskUse, str]:
    """The use of a capture's masks, and a description; warns if it is ambiguous.

    Args:
        use: The setting ``data.mask_use``.
        kind: Result of `survey`.
        where: Source of the masks, for messages.
        told: Meaning as defined by their source; None if undefined.
    """
    if use == "lrm":
        return use, "for LRMs alone (data.mask_use=lrm)"
    found: MaskUse = (told or kind.use) if use == "auto" else use
    meaning = {
        "alpha": "silhouettes: what they leave out is empty",
        "ignore": "pixels to ignore: what they leave out is neither trained on nor scored",
    }
    other: MaskUse = "ignore" if found == "alpha" else "alpha"
    text = f"masks leave out {kind.share:.1%} of the pixels. They are taken for {meaning[found]}"
    if use == "auto" and not told and kind.is_unclear:
        hint = " Silhouettes are white where the scene is." if found == "ignore" else ""
        warn(
            f"{where}: {text}. Both readings are possible: set data.mask_use={found} to "
            f"confirm it, or data.mask_use={other} if they are {meaning[other]}.{hint}"
        )
    else:
        logger.info("%s: %s (data.mask_use=%s)", where, text, found)
    return found, f"{text.removeprefix('masks ')} (data.mask_use={found})"


def read_mask(path: Path, kind: MaskKind, image: Path | None = None) -> np.ndarray:
    """A mask as factors from 0 (masked out) to 1. float32 [H, W]

    Masks with transparency are read from alpha; in coloured masks only black is masked out.

    Args:
        path: The file.
        kind: Meaning of the capture's masks.
        image: The image whose size the mask must have; None for any size.

    Raises:
        SceneError: If it cannot be decoded, or has another size.
    """
    grey, _ = _stored(path)
    if image is not None and grey.shape != (wanted := read_header(image)[0]):
        raise SceneError(mask_misfit(path, grey.shape, image, wanted))
    return _factors(grey, kind)


def _factors(grey: np.ndarray, kind: MaskKind) -> np.ndarray:
    """Convert the values of a mask to factors, see `read_mask`. float32 [H, W]"""
    values = (grey > 0).astype(np.float32) if kind.labels else grey.copy()
    values[values < NOISE], values[values > 1 - NOISE] = 0, 1
    return 1 - values if kind.inverted else values


def ignored_pixels(
    masks: Sequence[Path | None],
    images: Sequence[Path],
    sizes: Sequence[tuple[int, int]],
    kind: MaskKind,
) -> Tensor:
    """Pixels of reduced images whose mask coverage is below `KEPT`, padded. bool [V, H, W]

    Args:
        masks: A file for each image, or None. [V]
        images: The images. [V]
        sizes: Their heights and widths. [V]
        kind: As for `read_mask`.

    Raises:
        SceneError: If a mask cannot be decoded, or has another size than its image.
    """
    height, width = (max(size[axis] for size in sizes) for axis in (0, 1))
    found = torch.zeros(len(masks), height, width, dtype=torch.bool)
    for index, (mask, image, (rows, columns)) in enumerate(zip(masks, images, sizes, strict=True)):
        if mask is not None:
            shown = Image.fromarray(read_mask(mask, kind, image))
            shown = np.asarray(shown.resize((columns, rows), Image.Resampling.BOX))
            found[index, :rows, :columns] = torch.from_numpy(shown < KEPT)
    return found


def _stored(path: Path) -> tuple[np.ndarray, bool]:
    """The values of a mask file from 0 to 1, and whether its format is lossy. float32 [H, W]"""
    with open_image(path) as picture:
        white = 65535 if picture.mode in SIXTEEN_BIT_MODES else 255
        return _grey(picture).astype(np.float32) / white, picture.format in LOSSY


def _grey(picture: Image.Image) -> np.ndarray:
    """The stored values of a mask; for coloured masks, 255 except for black. [H, W]"""
    if picture.mode in SIXTEEN_BIT_MODES:
        return np.asarray(picture)
    colours = np.asarray(picture.convert("RGBA"))
    if colours[..., 3].min() < 255:
        return colours[..., 3]
    channels = colours[..., :3].astype(np.int16)
    if np.ptp(channels, axis=-1).max() > COLOURED:
        least = COLOURED if picture.format in LOSSY else 0
        return np.where(channels.max(axis=-1) > least, 255, 0)
    return np.asarray(picture.convert("L"))
