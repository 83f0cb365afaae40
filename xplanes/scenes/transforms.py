"""Files of cameras and times (transforms_train.json and its kin), read and checked."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from xplanes.scenes.cameras import focal_length
from xplanes.scenes.errors import SceneError

SUFFIXES = ("", ".png", ".jpg", ".jpeg")
RIGID_TOLERANCE = 1e-3
PIXELS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")
OTHER_MODELS = ("FISHEYE", "EQUIRECTANGULAR", "ORTHO")


@dataclass(frozen=True)
class Lens:
    """What a file tells about the camera of one image, as instant-ngp and nerfstudio write it.

    Attributes:
        per_width: Focal length in image widths; None where ``fl_x`` tells it.
        fl_x: Focal length along x in pixels of an image of ``w`` x ``h``.
        fl_y: The same along y; None for square pixels.
        cx: Principal point, from the left; None for the middle.
        cy: Principal point, from the top; None for the middle.
        w: Width of the image that these numbers speak of; None for that of the image file.
        h: Its height.
    """

    per_width: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: float | None = None
    h: float | None = None

    def scaled(
        self, native: tuple[int, int], size: tuple[int, int]
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """Focal lengths and principal point of the image in its final size.

        Args:
            native: Height and width of the image file.
            size: Those after it was resized.
        """
        (rows, columns), (height, width) = native, size
        # Of an image of another size only one side may be told.
        wide = self.w or (columns if self.h is None else columns * self.h / rows)
        high = self.h or (rows if self.w is None else rows * self.w / columns)
        per_width = self.per_width if self.fl_x is None else self.fl_x / wide
        assert per_width is not None
        focal_x = per_width * width
        if self.fl_y is not None:
            focal_y = self.fl_y / high * height
        else:
            focal_y = focal_x * ((height / rows) / (width / columns))
        centre_x = 0.5 * width if self.cx is None else self.cx / wide * width
        centre_y = 0.5 * height if self.cy is None else self.cy / high * height
        return (focal_x, focal_y), (centre_x, centre_y)


@dataclass(frozen=True)
class Transforms:
    """The frames that one transforms file lists.

    Attributes:
        paths: Image files. [V]
        files: The same files by their names within the scene's folder. [V]
        camera_to_world: Rigid camera poses. [V, 4, 4]
        times: Time of each image, from 0 to 1; all 0 for a static scene. [V]
        lenses: Focal length and principal point of each image, as far as they are told. [V]
        timed: Whether the file tells the times.
    """

    paths: tuple[Path, ...]
    files: tuple[str, ...]
    camera_to_world: Tensor
    times: Tensor
    lenses: tuple[Lens, ...]
    timed: bool

    def subset(self, indices: Sequence[int]) -> "Transforms":
        """The frames at ``indices``, in that order. [K]"""
        chosen = list(indices)
        return Transforms(
            tuple(self.paths[i] for i in chosen),
            tuple(self.files[i] for i in chosen),
            self.camera_to_world[chosen],
            self.times[chosen],
            tuple(self.lenses[i] for i in chosen),
            self.timed,
        )


def read_transforms(path: Path) -> Transforms:
    """Read and check a transforms file of the D-NeRF or Blender format.

    Raises:
        SceneError: Anything is missing, out of range, repeated, or outside the scene's folder.
    """
    content = _read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise SceneError(f'{path} lists no frames. Its key "frames" must hold at least one.')
    labels = []
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise SceneError(f"{path}: frame {index} is {_short(frame)}, not an object with keys.")
        for key in ("file_path", "transform_matrix"):
            if key not in frame:
                raise SceneError(
                    f'{path}: frame {index} has no "{key}". Every frame needs file_path and '
                    f"transform_matrix, and time in a dynamic scene."
                )
        labels.append(f"{path}: frame {index} ({frame['file_path']})")
    folder = path.parent.resolve()
    paths = [
        _image_path(label, folder, frame["file_path"])
        for label, frame in zip(labels, frames, strict=True)
    ]
    poses = np.stack(
        [
            _pose(label, frame["transform_matrix"])
            for label, frame in zip(labels, frames, strict=True)
        ]
    )
    times = _times(path, labels, frames)
    _refuse_repeats(labels, paths, poses, times)
    return Transforms(
        paths=tuple(paths),
        files=tuple(image.relative_to(folder).as_posix() for image in paths),
        camera_to_world=torch.from_numpy(poses).float(),
        times=torch.tensor(times or [0.0] * len(frames), dtype=torch.float32),
        lenses=tuple(
            _lens(str(path), content, label, frame)
            for label, frame in zip(labels, frames, strict=True)
        ),
        timed=bool(times),
    )


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as problem:
        raise SceneError(
            f"{path} cannot be read as JSON ({problem}). Export or download it again."
        ) from problem
    if not isinstance(content, dict):
        raise SceneError(f'{path} must hold a JSON object with "frames", not {_short(content)}.')
    return content


def _image_path(label: str, folder: Path, name: Any) -> Path:
    """The file that ``name`` stands for, with or without its suffix, inside ``folder``."""
    if not isinstance(name, str) or not name or "\0" in name:
        raise SceneError(f"{label}: file_path must be text such as ./train/r_000.")
    # Blender on Windows writes backslashes.
    relative = Path(name.replace("\\", "/"))
    if relative.is_absolute() or PureWindowsPath(name).anchor:
        raise SceneError(
            f"{label}: file_path is absolute. Write it relative to {folder}, as in ./train/r_000."
        )
    for suffix in SUFFIXES:
        image = (folder / f"{relative}{suffix}").resolve()
        if not image.is_relative_to(folder):
            raise SceneError(
                f"{label}: file_path leaves the scene's folder {folder} (it leads to {image}). "
                f"Put the image inside the folder and correct file_path."
            )
        if image.is_file():
            return image
    raise SceneError(
        f"{label}: no image {folder / relative}, nor with {', '.join(SUFFIXES[1:])} added. "
        f"Add the file or take the frame out of the list."
    )


def _pose(label: str, matrix: Any) -> np.ndarray:
    """A camera-to-world matrix: finite, rigid, right-handed. float64 [4, 4]"""
    try:
        pose = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape != (4, 4):
        raise SceneError(
            f"{label}: transform_matrix must be 4 rows of 4 numbers, not {_short(matrix)}."
        )
    if not np.isfinite(pose).all():
        raise SceneError(f"{label}: transform_matrix holds NaN or infinity. Export it again.")
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > RIGID_TOLERANCE:
        raise SceneError(
            f"{label}: the last row of transform_matrix is {pose[3].tolist()}, not [0, 0, 0, 1]. "
            f"Poses are camera-to-world, written row by row (perhaps this one is transposed)."
        )
    rotation = pose[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > RIGID_TOLERANCE:
        raise SceneError(
            f"{label}: the rotation in transform_matrix is not orthonormal (off by {error:.2g}, "
            f"allowed {RIGID_TOLERANCE:g}). Set the camera's scale to 1 and export again."
        )
    if np.linalg.det(rotation) < 0:
        raise SceneError(
            f"{label}: the rotation in transform_matrix mirrors (determinant -1, must be +1). "
            f"Axes are OpenGL's: x right, y up, z backward; negate one column."
        )
    return pose


def _times(path: Path, labels: list[str], frames: list[dict[str, Any]]) -> list[float]:
    """Times of all frames; empty where no frame has one."""
    timed = [label for label, frame in zip(labels, frames, strict=True) if "time" in frame]
    if not timed:
        return []
    if len(timed) < len(frames):
        bare = next(label for label in labels if label not in timed)
        raise SceneError(
            f'{bare} has no "time", but {len(timed)} of {len(frames)} frames of {path.name} do. '
            f"Give every frame a time in [0, 1], or none for a static scene."
        )
    for label, frame in zip(labels, frames, strict=True):
        time = frame["time"]
        number = isinstance(time, int | float) and not isinstance(time, bool)
        if not number or not 0 <= time <= 1:
            raise SceneError(
                f"{label}: time is {_short(time)}; it must be a number in [0, 1]. Divide frame "
                f"numbers by the last one."
            )
    return [float(frame["time"]) for frame in frames]


def _refuse_repeats(
    labels: list[str], paths: list[Path], poses: np.ndarray, times: list[float]
) -> None:
    files: dict[Path, str] = {}
    seen: dict[tuple[bytes, float], str] = {}
    for index, label in enumerate(labels):
        other = files.setdefault(paths[index], label)
        if other is not label:
            raise SceneError(f"{label} shows the same file as {other}. Remove one of the two.")
        # Paths around a static object may pass the same place twice, so only times convict.
        if not times:
            continue
        other = seen.setdefault((poses[index].tobytes(), times[index]), label)
        if other is not label:
            raise SceneError(
                f"{label} has the same camera and time as {other}. Remove one of the two, or "
                f"correct its time."
            )


def _lens(where: str, content: Mapping[str, Any], label: str, frame: Mapping[str, Any]) -> Lens:
    """The lens of a frame: its own keys, those of the file where it has none."""
    for name, keys in ((where, content), (label, frame)):
        _refuse_other_lenses(name, keys)
    shared, own = _pixels(where, content), _pixels(label, frame)
    name, keys = where, content
    if "camera_angle_x" in frame and "fl_x" not in own:
        # Focal lengths of the file are not those of this frame.
        shared = {key: value for key, value in shared.items() if key not in ("fl_x", "fl_y")}
        name, keys = label, frame
    known = shared | own
    if "fl_x" in known:
        return Lens(**known)
    if "camera_angle_x" not in keys:
        raise SceneError(
            f'{where} has no "camera_angle_x" (horizontal field of view in radians). Add it, or '
            f"fl_x and w (focal length and image width in pixels, both above 0)."
        )
    angle = keys["camera_angle_x"]
    if not _is_positive(angle) or angle >= math.pi:
        raise SceneError(
            f"{name}: camera_angle_x is {_short(angle)}; it must lie between 0 and pi radians."
        )
    return Lens(per_width=focal_length(angle, 1), **known)


def _pixels(name: str, keys: Mapping[str, Any]) -> dict[str, float]:
    """The keys in pixels that are given; null, and 0 where it can be no size, stand for none."""
    if all(keys.get(key) is None for key in PIXELS[:4]):
        # A size alone says nothing: whatever it is, it is not looked at.
        return {key: keys[key] for key in ("w", "h") if _is_positive(keys.get(key))}
    found = {}
    for key in PIXELS:
        value = keys.get(key)
        middle = key in ("cx", "cy")
        if value is None or (value == 0 and not middle):
            continue
        if not (_is_number(value) if middle else _is_positive(value)):
            raise SceneError(
                f"{name}: {key} is {_short(value)}; it must be a number"
                f"{'' if middle else ' above 0'}, in pixels, or be left out."
            )
        found[key] = float(value)
    return found


def _refuse_other_lenses(name: str, keys: Mapping[str, Any]) -> None:
    """Refuse what no pinhole can stand for."""
    problems = [f"{key}={_short(keys[key])}" for key in DISTORTIONS if keys.get(key)]
    model = str(keys.get("camera_model", ""))
    if any(word in model.upper() for word in OTHER_MODELS):
        problems.append(f"camera_model={model}")
    if keys.get("is_fisheye"):
        problems.append("is_fisheye")
    if problems:
        raise SceneError(
            f"{name}: {', '.join(problems)} describe a distorted image, which is not read here. "
            f"Cameras are pinholes: undistort the images first."
        )


def _is_number(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(value)


def _is_positive(value: Any) -> bool:
    return _is_number(value) and value > 0


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
