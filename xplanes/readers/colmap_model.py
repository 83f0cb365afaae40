"""COLMAP's sparse models: cameras, images and points, from binary and text files.

The files are read here because pycolmap 4.2 hangs, takes all memory or returns wrong cameras for a
truncated file, and its errors do not name the file.
"""

import math
import os
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np

from xplanes.errors import BrokenFrameError, SceneError
from xplanes.readers.entries import decoded, number_in, reading, short, usable
from xplanes.readers.listing import Calibration
from xplanes.scenes.lenses import COEFFICIENTS, LensModel

LENSES: dict[str, tuple[int, LensModel, str]] = {
    "SIMPLE_PINHOLE": (0, LensModel.PERSPECTIVE, "f cx cy"),
    "PINHOLE": (1, LensModel.PERSPECTIVE, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, LensModel.PERSPECTIVE, "f cx cy k1"),
    "RADIAL": (3, LensModel.PERSPECTIVE, "f cx cy k1 k2"),
    "OPENCV": (4, LensModel.PERSPECTIVE, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, LensModel.FISHEYE, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, LensModel.PERSPECTIVE, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "FOV": (7, LensModel.FOV, "fx fy cx cy omega"),
    "SIMPLE_RADIAL_FISHEYE": (8, LensModel.FISHEYE, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, LensModel.FISHEYE, "f cx cy k1 k2"),
    "THIN_PRISM_FISHEYE": (10, LensModel.FISHEYE, "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s3"),
    "SIMPLE_FISHEYE": (14, LensModel.FISHEYE, "f cx cy"),
    "FISHEYE": (15, LensModel.FISHEYE, "fx fy cx cy"),
}
"""COLMAP's camera models: their numbers in binary files, and their parameters in order."""

PANORAMA = "EQUIRECTANGULAR"
UNREAD = {
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
    12: "SIMPLE_DIVISION",
    13: "DIVISION",
    16: "EUCM",
    17: PANORAMA,
}
"""Camera models that are not read, by their numbers."""

MODELS = ("sparse/0", "sparse", "colmap/sparse/0", "sparse_/0", "sparse_", "colmap/sparse")
"""Usual folders of sparse models. A model in colmap/ was converted to a transforms.json."""

DEEPEST = 3
"""Levels of folders in which models are searched for, as in dense/0/sparse."""

UNIT_TOLERANCE = 1e-2
"""Largest deviation of a quaternion's length from 1."""

CAMERA = struct.Struct("<IiQQ")
IMAGE = struct.Struct("<I7dI")
COUNT = struct.Struct("<Q")
POINT = struct.Struct("<Q3d3BdQ")
POINT_IN_IMAGE, TRACK_ENTRY = 24, 8
"""Bytes of a point seen in an image, and of an image that sees a point."""

Parsed = TypeVar("Parsed")

Lens = tuple[str, int, int, Sequence[float]]
"""A camera's model, width, height and parameters."""


@dataclass(frozen=True)
class SparseModel:
    """A sparse model: the images that COLMAP registered, in the order of their names.

    Attributes:
        source: The file that lists the images.
        names: Image files, relative to the folder that COLMAP was run on. [V]
        camera_to_world: Poses with OpenGL's axes, in COLMAP's world. float64 [V, 4, 4]
        calibrations: Cameras and lenses. [V]
        points: Triangulated points; None if there is no file of points. float64 [N, 3]
        error: Mean reprojection error of the points in pixels; NaN if unknown.
    """

    source: Path
    names: tuple[str, ...]
    camera_to_world: np.ndarray
    calibrations: tuple[Calibration, ...]
    points: np.ndarray | None
    error: float = math.nan


def find_model(folder: Path, names: Sequence[str] = MODELS) -> Path | None:
    """The first of the named folders inside ``folder`` that contains a sparse model."""
    places = (folder / name for name in names)
    return next((place for place in places if _found(place, "cameras") is not None), None)


def models_inside(folder: Path) -> list[Path]:
    """All folders with sparse models, down to `DEEPEST` levels inside ``folder``."""
    found = []
    for place, folders, files in os.walk(folder):
        if any({f"cameras{end}", f"images{end}"} <= {*files} for end in (".bin", ".txt")):
            found.append(Path(place))
        depth = len(Path(place).relative_to(folder).parts)
        folders[:] = [] if depth >= DEEPEST else sorted(folders)
    return found


def image_count(folder: Path) -> int:
    """Number of images in the sparse model in ``folder``; 0 if its list of images is damaged."""
    with suppress(SceneError):
        path = _part(folder, "images")
        if path.suffix != ".bin":
            return sum(1 for _ in _images(path))
        with _binary(path) as file:
            (count,) = file.take(COUNT, "the number of images")
            return min(count, file.length // IMAGE.size)  # A damaged file may state any number.
    return 0


def read_model(folder: Path) -> SparseModel:
    """Read and check a sparse model; binary files take precedence over text files.

    Args:
        folder: Folder of cameras, images and points3D, each .bin or .txt.

    Raises:
        SceneError: If a file is missing, damaged, or has a lens that is not supported.
    """
    cameras_path, images_path = _part(folder, "cameras"), _part(folder, "images")
    cameras: dict[int, Calibration] = {}
    for label, number, lens in _cameras(cameras_path):
        if number in cameras:
            raise SceneError(f"{label} is listed twice. Remove one of the two.")
        cameras[number] = _calibration(label, *lens)
    images = sorted(_images(images_path), key=lambda image: image[0])
    if not images:
        raise SceneError(
            f"{images_path} lists no images: COLMAP has registered none. Run its mapper again, or "
            "choose another model."
        )
    images = usable("images", lambda image: (*image[:2], _pose(*image[2:])), images)
    for (name, *_), (after, *_) in pairwise(images):
        if name == after:
            raise SceneError(f"{images_path} lists {name} twice. Remove one of the two.")
    for name, camera, _ in images:
        if camera not in cameras:
            raise SceneError(
                f"{images_path}: {name} was taken by camera {camera}, which {cameras_path.name} "
                f"does not list. Both files must be of one model: copy or export them again."
            )
    names, numbers, poses = zip(*images, strict=True)
    points_path = _found(folder, "points3D")
    points, error = (None, math.nan) if points_path is None else _points(points_path)
    calibrations = tuple(cameras[camera] for camera in numbers)
    return SparseModel(images_path, names, np.stack(poses), calibrations, points, error)


def _found(folder: Path, name: str) -> Path | None:
    """A file of a model; the binary one takes precedence."""
    paths = (folder / f"{name}.{end}" for end in ("bin", "txt"))
    return next((path for path in paths if path.is_file()), None)


def _part(folder: Path, name: str) -> Path:
    if (path := _found(folder, name)) is not None:
        return path
    raise SceneError(
        f"{folder} holds neither {name}.bin nor {name}.txt. Export the model again, or copy all of "
        "it there."
    )


class _Binary:
    """A binary file, read sequentially."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file = path, file
        self.length = os.fstat(file.fileno()).st_size

    def take(self, kind: struct.Struct, what: str) -> tuple:
        """The next values; ``what`` describes them for messages."""
        content = self.file.read(kind.size)
        if len(content) < kind.size:
            raise self._truncated(what)
        return kind.unpack(content)

    def text(self, what: str) -> str:
        """The next null-terminated string."""
        letters = bytearray()
        while (letter := self.file.read(1)) != b"\0":
            if not letter:
                raise self._truncated(what)
            letters += letter
        return os.fsdecode(bytes(letters))

    def skip(self, count: int, what: str) -> None:
        """Skip bytes of ``what``."""
        if count > self.length - self.file.tell():
            raise self._truncated(what)
        self.file.seek(count, os.SEEK_CUR)

    def entries(self, kind: str) -> Iterator[str]:
        """Labels of the entries; the file must end after the last one."""
        (count,) = self.take(COUNT, f"the number of {kind}s")
        for index in range(count):
            yield f"{kind} {index + 1} of {count}"
        if rest := self.length - self.file.tell():
            raise SceneError(
                f"{self.path} is damaged: {rest} bytes follow the {count} {kind}s that it says it "
                f"holds. {_AGAIN}"
            )

    def _truncated(self, what: str) -> SceneError:
        return SceneError(
            f"{self.path} is truncated or damaged: its {self.length} bytes end within {what}. "
            f"{_AGAIN}"
        )


_AGAIN = "Copy it again, or export the model again with colmap model_converter."


@contextmanager
def _binary(path: Path) -> Iterator[_Binary]:
    with reading(path), path.open("rb") as file:
        yield _Binary(path, file)


HEADER = 4096
"""Number of bytes at the beginning of a text file that contain its comments."""


def _text_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Lines that are not comments, each with its label."""
    with reading(path, "as text", _AGAIN):
        text = decoded(path.read_bytes())
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.startswith("#"):
            yield f"{path}: line {number}", line.strip()


def _parsed(
    label: str, line: str, kind: str, parse: Callable[[list[str]], Parsed], most: int = -1
) -> Parsed:
    """Result of ``parse`` for a line's words, split at most ``most`` times."""
    try:
        return parse(line.split(maxsplit=most))
    except (ValueError, IndexError, OverflowError) as problem:
        raise SceneError(
            f"{label} is {short(line)}, but must be {kind}. The file is truncated or damaged: "
            "export the model again."
        ) from problem


def _cameras(path: Path) -> Iterator[tuple[str, int, Lens]]:
    """Label, number and lens of each camera of a file."""
    if path.suffix == ".bin":
        models = {number: (name, len(kind.split())) for name, (number, _, kind) in LENSES.items()}
        with _binary(path) as file:
            for what in file.entries("camera"):
                camera, number, width, height = file.take(CAMERA, what)
                model, count = models.get(number, (UNREAD.get(number, f"number {number}"), 0))
                values = file.take(struct.Struct(f"<{count}d"), what)
                yield f"{path}: camera {camera}", camera, (model, width, height, values)
        return

    def parse(words: list[str]) -> tuple[int, Lens]:
        camera, model, width, height, *values = words
        return int(camera), (model, int(width), int(height), [*map(float, values)])

    for label, line in _text_lines(path):
        if line:
            camera, lens = _parsed(label, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS", parse)
            yield f"{label} (camera {camera})", camera, lens


def _images(path: Path) -> Iterator[tuple[str, int, str, Sequence[float]]]:
    """Name, camera, label and world-to-camera pose of each image of a file."""
    if path.suffix == ".bin":
        with _binary(path) as file:
            for what in file.entries("image"):
                _, *motion, camera = file.take(IMAGE, what)
                name = file.text(what)
                (count,) = file.take(COUNT, what)
                file.skip(POINT_IN_IMAGE * count, f"{what} ({name})")
                yield name, camera, f"{path}: {name}", motion
        return

    def parse(words: list[str]) -> tuple[list[float], int, str]:
        return [float(word) for word in words[1:8]], int(words[8]), words[9]

    count = 0
    for label, line in _text_lines(path):
        # Every other line lists observed points, three numbers each; some programs omit it.
        words = line.split()
        # Such a line has only numbers; an image's line has a name among its first twelve words.
        if len(words) % 3 == 0 and all(number_in(word) is not None for word in words[:12]):
            continue
        # Names may contain spaces.
        motion, camera, name = _parsed(
            label, line, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", parse, most=9
        )
        count += 1
        yield name, camera, f"{label} ({name})", motion
    with path.open("rb") as file:
        stated = re.search(rb"# Number of images: (\d+)", file.read(HEADER))
    if stated and count < int(stated[1]):
        raise SceneError(
            f"{path} says that it lists {int(stated[1])} images, but it ends after {count}: it is "
            "truncated. Export the model again."
        )


def _points(path: Path) -> tuple[np.ndarray, float]:
    """The points of a file, float64 [N, 3], and their mean reprojection error; NaN if unknown."""
    points = []
    if path.suffix == ".bin":
        with _binary(path) as file:
            for what in file.entries("point"):
                _, *position, _, _, _, error, seen_by = file.take(POINT, what)
                file.skip(TRACK_ENTRY * seen_by, what)
                points.append((*position, error))
    else:

        def parse(words: list[str]) -> tuple[float, ...]:
            error = float(words[7]) if len(words) > 7 else math.nan
            return float(words[1]), float(words[2]), float(words[3]), error

        points = [
            _parsed(label, line, "POINT3D_ID X Y Z ...", parse, most=8)
            for label, line in _text_lines(path)
            if line
        ]
    values = np.array(points, dtype=np.float64).reshape(-1, 4)
    positions, errors = values[:, :3], values[:, 3]
    bad = ~np.isfinite(positions).all(axis=1)
    if bad.any():
        raise SceneError(
            f"{path}: point {int(bad.argmax()) + 1} of {len(points)} lies at "
            f"{positions[bad][0].tolist()}. Remove it, or export the model again."
        )
    errors = errors[np.isfinite(errors) & (errors >= 0)]  # COLMAP writes -1 for unknown ones.
    return positions, float(errors.mean()) if len(errors) else math.nan


def _calibration(
    label: str, model: str, width: int, height: int, values: Sequence[float]
) -> Calibration:
    if model not in LENSES:
        undistort = "Undistort the images with colmap image_undistorter, or use one of these"
        cut = "COLMAP does not undistort it: cut perspective images out of it, and calibrate them"
        raise SceneError(
            f"{label} has the camera model {model}, which is not read. These are: "
            f"{', '.join(LENSES)}. {cut if model == PANORAMA else undistort}."
        )
    _, lens, kind = LENSES[model]
    names = kind.split()
    if len(values) != len(names):
        raise SceneError(
            f"{label} has {len(values)} parameters, but a {model} camera has {len(names)}: {kind}. "
            "Export the model again."
        )
    known = dict(zip(names, values, strict=True))
    sizes = {"width": width, "height": height} | {
        key: known[key] for key in ("f", "fx", "fy") if key in known
    }
    for key, value in {**known, **sizes}.items():
        if not math.isfinite(value) or (key in sizes and value <= 0):
            raise SceneError(
                f"{label} has {key}={value}; it must be a finite number"
                f"{' above 0' if key in sizes else ''}. Export the model again, or calibrate again."
            )
    distortion = {name: known[name] for name in COEFFICIENTS if name in known}
    if lens == LensModel.FOV:
        distortion = {"k1": known["omega"]}
        if not 0 <= known["omega"] < math.pi:
            raise SceneError(
                f"{label} has omega={known['omega']}; it must lie between 0 and pi radians. "
                "Calibrate again, or with another camera model."
            )
    return Calibration(
        fl_x=known.get("f", known.get("fx")),
        fl_y=known.get("f", known.get("fy")),
        cx=known["cx"],
        cy=known["cy"],
        w=width,
        h=height,
        model=lens,
        distortion=distortion,
    )


def _pose(label: str, motion: Sequence[float]) -> np.ndarray:
    """Camera-to-world matrix from world-to-camera quaternion, real part first, and translation."""
    values = np.array(motion, dtype=np.float64)
    if not np.isfinite(values).all():
        raise BrokenFrameError(f"{label}: the pose is {values.tolist()}. Export the model again.")
    length = math.hypot(*values[:4])
    if abs(length - 1) > UNIT_TOLERANCE:
        raise SceneError(
            f"{label}: the pose is {values.tolist()}; it must be a unit quaternion QW QX QY QZ and "
            "a finite translation TX TY TZ. The file is damaged: export the model again."
        )
    w, x, y, z = values[:4] / length
    world_to_camera = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    # COLMAP's cameras have y down and look along +z.
    pose[:3, :3] = world_to_camera.T * [1, -1, -1]
    pose[:3, 3] = -world_to_camera.T @ values[4:]
    return pose
