"""Reading and checking of names, poses, numbers and times in camera files."""

import itertools
import json
import logging
import math
import os
import re
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, TypeGuard, TypeVar
from urllib.parse import unquote

import numpy as np
import torch
from torch import Tensor

from xplanes.errors import (
    BrokenFrameError,
    MissingSplitError,
    SceneError,
    first_of,
    refuse_all,
    warn,
)
from xplanes.files import stand_in
from xplanes.readers.formats import ENDINGS, is_image, orientation
from xplanes.scenes.cameras import upright

logger = logging.getLogger(__name__)

Item = TypeVar("Item")
Found = TypeVar("Found")

SUFFIXES = ("", *ENDINGS)
SPLIT_FOLDERS = ("train", "val", "test", "video")
RIGID_TOLERANCE = 1e-3

FARTHEST = 1e15
"""Largest coordinate of a camera; its square still fits single precision."""

SAME_PLACE = 1e-4
"""Largest difference, in world units, between positions of a fixed camera."""

FAR_OFF = 60
"""Angle in degrees between the cameras' mean up vector and the z axis, above which z is not up."""

ROUNDING = 1e-4
"""Largest rounding error of camera positions in single precision, as a share of their extent."""


def image_path(label: str, folder: Path, name: Any, key: str = "file_path") -> Path:
    """The file that ``name`` refers to inside ``folder``.

    The suffix may be missing or that of another format, and the name may differ in case or in the
    encoding of accents, as long as only one file matches; it may be percent-encoded. If there is no
    such path, its first folders are dropped one by one, as it may be a path of another machine.
    Relative names keep the folder of a split, and all folders if the last one exists. A name
    without folders is also looked up in the folder ``images``.

    Args:
        label: The file and frame that name it, for messages.
        folder: The scene's folder.
        name: Name relative to ``folder``, or an absolute path into it.
        key: The key of the name.

    Raises:
        BrokenFrameError: If there is no such file, or it is empty.
        SceneError: If it is not a name, or leaves the folder.
    """
    choices = [*paths_inside(label, folder, name, key, "./train/r_000")]
    choices += [folder / "images" / path.name for path in choices if path.parent == folder]
    found = itertools.chain(filter(Path.is_file, choices), filter(None, map(_similar, choices)))
    if (image := next(found, None)) is not None:
        if image.stat().st_size == 0:
            raise BrokenFrameError(f"{label}: {image} holds 0 bytes. Copy the file again.")
        return image
    if (plain := unquote(name)) != name:  # Percent-encoded, as in URLs.
        return image_path(label, folder, plain, key)
    if Path(name).is_absolute() and Path(name).is_file():
        raise BrokenFrameError(
            f"{label}: {key} leaves the scene's folder {folder}. Put a link to {Path(name).parent} "
            f"inside the folder and correct {key}."
        )
    raise BrokenFrameError(
        f"{label}: no image {folder / name}, nor with {', '.join(SUFFIXES[1:4])}, ... added. "
        f"Add the file or take the frame out of the list."
    )


def usable(what: str, read: Callable[[Item], Found], items: Sequence[Item]) -> list[Found]:
    """Results of a function for usable frames; warns about the others.

    Args:
        what: Name of the frames, for the warning.
        read: The function; raises `BrokenFrameError` for a frame that is to be left out.
        items: The frames.

    Raises:
        MissingSplitError: If all frames are left out.
        SceneError: If ``read`` raises other errors; the message has all of them.
    """
    found: list[Found] = []
    left_out, wrong = [], []
    for item in items:
        try:
            found.append(read(item))
        except BrokenFrameError as problem:
            left_out.append(str(problem))
        except SceneError as problem:
            wrong.append(str(problem))
    refuse_all(wrong)
    if not found:
        raise MissingSplitError(first_of(left_out))
    if left_out:
        warn(f"{len(left_out)} of {len(items)} {what} are left out:\n{first_of(left_out)}")
    return found


@lru_cache(maxsize=64)
def _stems(folder: Path, changed: int) -> dict[str, list[Path]]:
    """Images of a folder, changed at a time, by name without suffix, in lower case."""
    found: dict[str, list[Path]] = {}
    inside = sorted(folder.iterdir())
    if len(inside) == 1 and inside[0].is_dir():  # The archive was unpacked one level too deep.
        inside = sorted(inside[0].iterdir())
    for path in filter(Path.is_file, filter(is_image, inside)):
        found.setdefault(_normalised(path.stem), []).append(path)
    return found


def _normalised(name: str) -> str:
    """A name in lower case and normalised; macOS stores accents as separate characters."""
    return unicodedata.normalize("NFC", name).casefold()


def _like(folder: Path) -> Path | None:
    """A folder, or the only one beside it whose name differs only in case or accents."""
    if folder.is_dir() or folder.parent == folder:
        return folder
    if (parent := _like(folder.parent)) is None:
        return None
    wanted = _normalised(folder.name)
    names = [path for path in parent.iterdir() if _normalised(path.name) == wanted]
    return names[0] if len(names) == 1 and names[0].is_dir() else None


def _similar(image: Path) -> Path | None:
    """An image, or else the only one whose name differs in case, accents or format alone."""
    if image.is_file():
        return image
    if (parent := _like(image.parent)) is None:
        return None
    wanted = image.stem if image.suffix.lower() in ENDINGS else image.name
    found = _stems(parent, parent.stat().st_mtime_ns).get(_normalised(wanted), [])
    same = [path for path in found if _normalised(path.name) == _normalised(image.name)]
    chosen = [path for path in same if path.suffix == image.suffix] or same or found
    return chosen[0] if len(chosen) == 1 else None


def spelt(name: Any) -> str:
    """A name in one spelling: with slashes, and without . and .. where they change nothing."""
    return os.path.normpath(str(name).replace("\\", "/"))


def paths_inside(label: str, folder: Path, name: Any, key: str, example: str) -> Iterator[Path]:
    """Paths that a name may refer to inside ``folder``, unchanged and with image suffixes.

    Links are followed, even out of the folder; ``..`` must not leave it, unless nothing is there
    and the rest of the name leads to a file inside.

    Args:
        label: The file and frame that name it, for messages.
        folder: The scene's folder.
        name: Name relative to ``folder``, or an absolute path.
        key: The key of the name.
        example: A valid name, for messages.

    Raises:
        BrokenFrameError: If it is empty or null.
        SceneError: If it is not a name, or leaves the folder.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        problem = BrokenFrameError if name in ("", None) else SceneError
        raise problem(f"{label}: {key} is {short(name)}; it must be text such as {example}.")
    # Blender on Windows writes backslashes.
    whole = Path(os.path.normpath(folder / spelt(name)))
    parts = whole.parts
    if whole.is_relative_to(folder):
        parts = whole.relative_to(folder).parts
    elif not PureWindowsPath(name).anchor:
        # The file of the cameras may have been moved, out of a folder beside the images.
        outer = PurePosixPath(spelt(name).replace("../", "")).parts
        tails = [PurePosixPath(*outer[first:]) for first in range(max(1, len(outer) - 1))]

        def is_there(place: Path) -> bool:
            return any(Path(f"{place}{end}").exists() for end in SUFFIXES)

        inner = next((tail for tail in tails if is_there(folder / tail)), None)
        if inner is None or is_there(whole):
            raise SceneError(
                f"{label}: {key} leaves the scene's folder {folder} (it is {name}). Put its files "
                f"inside the folder and correct {key}."
            )
        name, parts = inner.as_posix(), inner.parts
    # If the path does not exist, its first folders are dropped one by one. That of a split tells
    # apart files such as train/0001.png and test/0001.png, and so does a folder that exists. Images
    # for training may lie without such a folder.
    last, own = len(parts), parts[:-1]
    if own and not PureWindowsPath(name).anchor:
        kept = SPLIT_FOLDERS[not (folder / SPLIT_FOLDERS[0]).is_dir() :]
        splits = [place for place, part in enumerate(own) if part.lower() in kept]
        last = 1 if folder.joinpath(*own).is_dir() else min([*(p + 1 for p in splits), last])
    for first in range(max(1, last)):
        relative = Path(*parts[first:])
        if relative.is_absolute() or (first and not (folder / relative).parent.is_dir()):
            continue
        for suffix in (*SUFFIXES, *(suffix.upper() for suffix in SUFFIXES[1:])):
            yield folder / f"{relative}{suffix}"


def mask_files(folder: Path, names: Sequence[Sequence[str]]) -> tuple[Path | None, ...]:
    """The mask of each image; None for images without a mask.

    Args:
        folder: Folder of masks.
        names: Possible names of each image's mask without the ending, in order of preference. [V]

    Raises:
        SceneError: If no image has a mask.
    """
    # PNG takes precedence over other endings.
    choices = [[folder / f"{name}.png" for name in each] for each in names]
    masks = tuple(next(filter(None, map(_similar, each)), None) for each in choices)
    if not any(masks):
        where = "holds" if _like(folder) else "does not exist, so there is"
        raise SceneError(
            f"data.masks: {folder} {where} no mask of any image, such as {names[0][0]}.png. Put "
            "the masks there, or set data.masks=null."
        )
    return masks


def read_array(path: Path, advice: str) -> np.ndarray:
    """An array from a file of NumPy, mapped to memory.

    Raises:
        SceneError: If it cannot be read; ``advice`` is added to the message.
    """
    with reading(path, "as an array", advice):
        return np.lib.format.open_memmap(path, mode="r")


def unit_times(times: Sequence[float], span: tuple[float, float] | None = None) -> list[float]:
    """Times in any unit, mapped to [0, 1]; all 0 if they are equal.

    Args:
        times: The times. [V]
        span: First and last time of the capture; those of ``times`` when None.
    """
    # Subtracted before conversion to float, which cannot represent clocks in nanoseconds exactly.
    first, last = span or (min(times), max(times))
    return [(time - first) / (last - first) if last > first else 0.0 for time in times]


def read_object(path: Path, content: str) -> dict[str, Any]:
    """A JSON object from a file.

    Args:
        path: The file.
        content: Required content, for messages.

    Raises:
        SceneError: If it cannot be read, or is not an object.
    """
    with reading(path, "as JSON", "Export or download it again."):
        found = parsed(_text(path))
    if not isinstance(found, dict):
        raise SceneError(f"{path} must hold a JSON object with {content}, not {short(found)}.")
    return found


def _text(path: Path) -> str:
    """A file's text; warns if it is in none of Unicode's encodings."""
    content = path.read_bytes()
    try:
        return decoded(content)
    except UnicodeDecodeError:
        warn(f"{path} is not in UTF-8 and is read as Latin-1. Save it as UTF-8 if names are wrong.")
        return content.decode("latin-1")


def parsed(text: str) -> Any:
    """Parse JSON that may have comments and trailing commas."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        bare = re.sub(rf"{STRING}|//[^\n]*|#[^\n]*|/\*.*?\*/", r"\1", text, flags=re.S)
        bare = re.sub(rf"{STRING}|,(?=\s*[}}\]])", r"\1", bare)
        with suppress(json.JSONDecodeError):
            return json.loads(bare)
        raise


def decoded(content: bytes) -> str:
    """Text in UTF-8, UTF-16 or UTF-32, with or without a byte order mark."""
    return content.decode(json.detect_encoding(content))


@contextmanager
def reading(path: Path, how: str = "", advice: str = "") -> Iterator[None]:
    """Refuse a file that was not fetched, such as a pointer of Git LFS, or that cannot be read.

    Args:
        path: The file that is read in the block.
        how: How it is read, such as "as JSON", for the message.
        advice: Further text of the message.

    Raises:
        SceneError: With the kind of placeholder, or the problem in the block.
    """
    if (other := stand_in(path)) is not None:
        raise SceneError(f"{path} {other}.")
    try:
        yield
    except SceneError:
        raise
    except (OSError, ValueError, EOFError, RecursionError) as problem:
        words = " ".join(filter(None, [str(path), "cannot be read", how, f"({problem}).", advice]))
        raise SceneError(words) from problem


def checked_pose(label: str, matrix: Any, key: str = "transform_matrix") -> np.ndarray:
    """A camera-to-world matrix: finite, rigid, right-handed.

    Args:
        label: Its file and frame, for messages.
        matrix: 4 rows of 4 numbers; the last row may be missing.
        key: Its key there.

    Returns:
        The matrix. float64 [4, 4]

    Raises:
        BrokenFrameError: If it is not finite, or missing.
        SceneError: If it is not such a matrix.
    """
    if matrix is None:
        raise BrokenFrameError(f"{label} has no {key}: the camera is unknown.")
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape in ((12,), (16,)):
        pose = pose.reshape(-1, 4)
    if pose.shape == (3, 4):  # Some programs leave the last row out.
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4):
        raise SceneError(f"{label}: {key} must be 4 rows of 4 numbers, not {short(matrix)}.")
    if not np.isfinite(pose).all():
        raise BrokenFrameError(f"{label}: {key} holds NaN or infinity. Export it again.")
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > RIGID_TOLERANCE:
        raise SceneError(
            f"{label}: the last row of {key} is {pose[3].tolist()}, not [0, 0, 0, 1]. "
            f"Poses are camera-to-world, written row by row (perhaps this one is transposed)."
        )
    rotation = pose[:3, :3]
    # A uniform scale of the camera does not change its rays.
    if (scale := np.cbrt(abs(np.linalg.det(rotation)))) > 0:
        rotation /= scale
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > RIGID_TOLERANCE:
        raise SceneError(
            f"{label}: the rotation in {key} is not orthonormal (off by {error:.2g}, "
            f"allowed {RIGID_TOLERANCE:g}). Set the camera's scale to 1 on all axes and export "
            "again."
        )
    if np.linalg.det(rotation) < 0:
        raise SceneError(
            f"{label}: the rotation in {key} mirrors (determinant -1, must be +1). "
            f"Axes are OpenGL's: x right, y up, z backward; negate one column."
        )
    return pose


STRING = r'("(?:[^"\\]|\\.)*")'
"""A string in JSON."""

UP = {3: (0, -1), 4: (0, -1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
"""The up vector in the stored pixels (right, up) by EXIF orientation; (0, 1) for others."""


def world_turn(
    poses: Tensor, paths: Sequence[Path], orient: bool | None, stated: Tensor | None = None
) -> tuple[Tensor | None, str]:
    """Rotation of the world that makes the cameras' mean up vector its z axis, and a description.

    Up in an image follows its EXIF orientation; pixels and cameras stay as they are.

    Args:
        poses: Cameras with OpenGL's axes. [V, 4, 4]
        paths: Their images; empty for frames of videos. [V]
        orient: Whether to rotate the world. None rotates it if the mean up vector is more than
            `FAR_OFF` degrees from the z axis, or as ``stated``.
        stated: The up vector that the files give, if any. float64 [3]

    Returns:
        The rotation, float64 [3, 3], or None if the world is unchanged; and a description.
    """
    if stated is not None and orient is None:
        x, y, z = stated.tolist()
        return upright(stated[None]), f"({x:g}, {y:g}, {z:g}) of the files, by their key up"
    tags = [orientation(path) for path in paths] or [1] * len(poses)
    if turned_photos := sum(tag in UP for tag in tags):
        logger.info(
            "%d of %d images have an EXIF orientation that rotates them: pixels are read as they "
            "are stored, and up vectors follow EXIF",
            *(turned_photos, len(paths)),
        )
    image_up = torch.tensor([UP.get(tag, (0, 1)) for tag in tags], dtype=torch.float64)
    up = (poses[:, :3, :2].double() * image_up[:, None]).sum(dim=2)
    if (rotation := upright(up)) is None:
        if orient:
            warn(
                "The up vectors of the cameras cancel out, so the world keeps the axes of the "
                "files. data.orient=false confirms this."
            )
        return None, "the z axis of the files; the cameras' up vectors cancel out"
    off = math.degrees(math.acos(min(1.0, max(-1.0, float(rotation[2, 2])))))
    if orient or (orient is None and off > FAR_OFF):
        why = "data.orient=true" if orient else "data.orient=false keeps their axes"
        return rotation, (
            f"the cameras' mean up vector: the world is turned, as it is {off:.3g} degrees off "
            f"the z axis of the files ({why})"
        )
    return None, f"the z axis of the files; the cameras' mean up vector is {off:.3g} degrees off"


def origin_near(source: Path, positions: np.ndarray, movable: bool = True) -> np.ndarray:
    """A point relative to which single precision resolves the cameras: if possible, the origin.

    Captures in map coordinates lie millions of metres away, where numbers are half a metre apart.

    Args:
        source: File of the cameras, for messages.
        positions: Positions of all cameras of a capture. float64 [V, 3]
        movable: Whether it may be another point than the origin.

    Returns:
        float64 [3]

    Raises:
        SceneError: If there is no such point.
    """
    extent = float(np.ptp(positions, axis=0).max())
    fixed = extent <= SAME_PLACE
    room = FARTHEST if fixed else ROUNDING * extent / float(np.finfo(np.float32).eps)
    origin = np.zeros(3)
    largest = float(np.abs(positions).max())
    if movable and not largest <= min(room, FARTHEST):
        origin = positions.mean(axis=0).round()
        largest = float(np.abs(positions - origin).max())
    if not largest <= min(room, FARTHEST):
        raise SceneError(
            f"{source}: the cameras lie up to {largest:.3g} world units from the origin and "
            f"{extent:.3g} apart, which single precision cannot resolve. Subtract the same vector "
            "from the positions of all cameras, as colmap model_transformer does, or correct them."
        )
    if origin.any():
        x, y, z = origin.tolist()
        warn(
            f"{source}: the origin is far away, so positions are read relative to "
            f"({x:.0f}, {y:.0f}, {z:.0f}): data.centre and exports are as well."
        )
    return origin


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value read from a file is a finite number."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        # JSON may contain integers too large for a float.
        return False


def is_positive(value: Any) -> TypeGuard[float]:
    """Whether a value read from a file is a finite number above 0."""
    return is_number(value) and value > 0


def checked_number(
    where: str | Path, key: str, value: Any, positive: bool = False, more: str = ""
) -> float:
    """A finite number, or one above 0, read from a file.

    Raises:
        SceneError: If it is none; ``more`` is added to the sentence.
    """
    if not (is_positive(value) if positive else is_number(value)):
        above = " above 0" if positive else ""
        raise SceneError(f"{where}: {key} is {short(value)}; it must be a number{above}{more}.")
    return value


def number_in(text: str) -> float | None:
    """The finite number in a string, an int if it is written as one; None for other strings."""
    for kind in (int, float):
        with suppress(ValueError):
            number = kind(text)
            return number if is_number(number) else None
    return None


def short(value: Any) -> str:
    """A value read from a file, for messages."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
