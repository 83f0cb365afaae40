"""Files of cameras and times (transforms_train.json and its kin), read and checked."""

import json
import math
from collections.abc import Sequence
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
LENS_TOLERANCE = 0.01
DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")


@dataclass(frozen=True)
class Transforms:
    """The frames that one transforms file lists.

    Attributes:
        paths: Image files. [V]
        files: The same files by their names within the scene's folder. [V]
        camera_to_world: Rigid camera poses. [V, 4, 4]
        times: Time of each image, from 0 to 1; all 0 for a static scene. [V]
        focal_per_width: Focal length in image widths.
        timed: Whether the file tells the times.
    """

    paths: tuple[Path, ...]
    files: tuple[str, ...]
    camera_to_world: Tensor
    times: Tensor
    focal_per_width: float
    timed: bool

    def subset(self, indices: Sequence[int]) -> "Transforms":
        """The frames at ``indices``, in that order. [K]"""
        chosen = list(indices)
        return Transforms(
            tuple(self.paths[i] for i in chosen),
            tuple(self.files[i] for i in chosen),
            self.camera_to_world[chosen],
            self.times[chosen],
            self.focal_per_width,
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
        focal_per_width=_focal_per_width(path, content, frames),
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
    moments: dict[tuple[bytes, float], str] = {}
    for index, label in enumerate(labels):
        other = files.setdefault(paths[index], label)
        if other is not label:
            raise SceneError(f"{label} shows the same file as {other}. Remove one of the two.")
        # Paths around a static object may pass the same place twice, so only times convict.
        if not times:
            continue
        other = moments.setdefault((poses[index].tobytes(), times[index]), label)
        if other is not label:
            raise SceneError(
                f"{label} has the same camera and time as {other}. Remove one of the two, or "
                f"correct its time."
            )


def _focal_per_width(path: Path, content: dict[str, Any], frames: list[dict[str, Any]]) -> float:
    """Focal length in image widths, from camera_angle_x or fl_x and w."""
    _refuse_other_lenses(path, content, frames)
    if "camera_angle_x" in content:
        angle = content["camera_angle_x"]
        if not _is_positive(angle) or angle >= math.pi:
            raise SceneError(
                f"{path}: camera_angle_x is {_short(angle)}; it must lie between 0 and pi radians."
            )
        return focal_length(angle, 1)
    if not (_is_positive(content.get("fl_x")) and _is_positive(content.get("w"))):
        raise SceneError(
            f'{path} has no "camera_angle_x" (horizontal field of view in radians). Add it, or '
            f"fl_x and w (focal length and image width in pixels, both above 0)."
        )
    return content["fl_x"] / content["w"]


def _refuse_other_lenses(path: Path, content: dict[str, Any], frames: list[dict[str, Any]]) -> None:
    """Refuse what one focal length and a centred, undistorted image cannot stand for."""
    problems = [key for key in DISTORTIONS if content.get(key)]
    for key, other, expected in (("fl_y", "fl_x", 1), ("cx", "w", 0.5), ("cy", "h", 0.5)):
        value, reference = content.get(key), content.get(other)
        if value is None or reference is None:
            continue
        if not (_is_positive(value) and _is_positive(reference)) or (
            abs(value / reference - expected) > LENS_TOLERANCE
        ):
            problems.append(key)
    problems += [
        f"{key} of single frames"
        for key in ("camera_angle_x", "fl_x")
        if any(key in frame and frame[key] != content.get(key) for frame in frames)
    ]
    if problems:
        raise SceneError(
            f"{path}: {', '.join(problems)} describe a camera that is not read here. Cameras have "
            f"one focal length, a centred image and no distortion: undistort the images first."
        )


def _is_positive(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(value) and value > 0


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
