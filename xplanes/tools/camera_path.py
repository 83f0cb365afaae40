"""Camera paths in JSON files: the format of nerfstudio's viewer, and transforms files."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from xplanes.errors import SceneError
from xplanes.readers.entries import checked_pose, is_number, is_positive, read_object, short
from xplanes.scenes.views import Views

logger = logging.getLogger(__name__)

OVERSHOOT = 0.25  # Tolerance of times beyond 0 and 1: splines through key frames overshoot.


@dataclass(frozen=True)
class CameraPath:
    """Cameras and times of a video, as read from a file.

    Attributes:
        poses: Camera-to-world matrices. [F, 4, 4]
        times: Time of each frame, from 0 to 1. [F]
        tangents: Tangent of half the field of view of each frame, along ``upright``. [F]
        upright: Whether the field of view is vertical; otherwise it is horizontal.
        height: Rows of a frame; None if the file does not contain them.
        width: Columns of a frame; None if the file does not contain them.
        fps: Frames per second; None if the file does not contain it.
    """

    poses: Tensor
    times: Tensor
    tangents: Tensor
    upright: bool
    height: int | None = None
    width: int | None = None
    fps: int | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def focal(self, height: int, width: int) -> Tensor:
        """Focal length of each frame in pixels, for frames of the given size. [F]"""
        return 0.5 * (height if self.upright else width) / self.tangents


def read_camera_path(path: Path) -> CameraPath:
    """Read and check a camera path in one of two formats.

    ``camera_path.json`` of nerfstudio's viewer has ``camera_path``, a list of objects with
    ``camera_to_world`` (16 numbers, row by row), ``fov`` (vertical, in degrees) and optionally
    ``render_time`` or ``time``; ``render_height``, ``render_width``, and ``fps`` or ``seconds``.
    A transforms file has ``frames``, a list of objects with ``transform_matrix`` [4, 4] and
    optionally ``time``; ``camera_angle_x`` (horizontal, in radians), once or in each frame;
    optionally ``w``, ``h`` and ``fps``.

    If the file has no times, they run from 0 to 1 over the path.

    Args:
        path: The file. Poses are in the run's world coordinates, with OpenGL's axes.

    Raises:
        SceneError: If the file is missing or damaged, or an entry is missing or out of range.
    """
    if not path.is_file():
        raise SceneError(f"{path}: there is no such camera path")
    content = read_object(path, '"camera_path" (nerfstudio) or "frames"')
    nerfstudio = "camera_path" in content
    if nerfstudio and (kind := content.get("camera_type", "perspective")) != "perspective":
        raise SceneError(
            f"{path}: camera_type is {short(kind)}; only perspective cameras are rendered"
        )
    entries = _entries(path, content, "camera_path" if nerfstudio else "frames")
    fps, seconds = _count(path, content, "fps"), content.get("seconds")
    if fps is None and nerfstudio and is_positive(seconds):
        fps = max(1, round(len(entries) / seconds))
    height, width = ("render_height", "render_width") if nerfstudio else ("h", "w")
    key = "camera_to_world" if nerfstudio else "transform_matrix"
    poses = [checked_pose(label, entry.get(key), key) for label, entry in entries.items()]
    return CameraPath(
        poses=torch.from_numpy(np.stack(poses)).float(),
        times=_times(path, entries, ("render_time", "time") if nerfstudio else ("time",)),
        tangents=_tangents(path, content, entries, nerfstudio=nerfstudio),
        upright=nerfstudio,
        height=_count(path, content, height),
        width=_count(path, content, width),
        fps=fps,
    )


def path_contents(views: Views, fps: int) -> dict[str, dict[str, Any]]:
    """Camera paths through the cameras of views, in the order of their times, for `write_json`.

    Cameras of a path are perspective with a centred principal point: distortion and principal
    points are lost, the vertical field of view of each image is kept.

    Returns:
        Contents of ``camera_path.json`` (nerfstudio's format) and ``transforms.json``, by name.
    """
    order = views.times.argsort(stable=True)
    tangents = 0.5 * views.intrinsics.size[order, 0] / views.intrinsics.pinhole[order, 1]
    aspect = views.width / views.height
    fov = (2 * tangents.atan()).rad2deg().tolist()
    across = (2 * (aspect * tangents).atan()).tolist()
    poses, times = views.camera_to_world[order].tolist(), views.times[order].tolist()
    flat = views.camera_to_world[order].flatten(1).tolist()
    keys = [
        {"camera_to_world": pose, "fov": angle, "aspect": aspect, "render_time": time}
        for pose, angle, time in zip(flat, fov, times, strict=True)
    ]
    frames = [
        {"transform_matrix": pose, "camera_angle_x": angle, "time": time}
        for pose, angle, time in zip(poses, across, times, strict=True)
    ]
    size = {"render_height": views.height, "render_width": views.width}
    rate = {"fps": fps, "seconds": len(views) / fps}
    return {
        "camera_path.json": {"camera_type": "perspective", **size, **rate, "camera_path": keys},
        "transforms.json": {"w": views.width, "h": views.height, "fps": fps, "frames": frames},
    }


Entries = dict[str, Mapping[str, Any]]  # Cameras of a path by their names in messages.


def _entries(path: Path, content: Mapping[str, Any], key: str) -> Entries:
    found = content.get(key)
    if not isinstance(found, list) or not found:
        raise SceneError(
            f'{path} holds no cameras. Its key "camera_path" (nerfstudio) or "frames" must contain '
            "at least one"
        )
    entries = {f"{path}: {key}[{index}]": entry for index, entry in enumerate(found)}
    for label, entry in entries.items():
        if not isinstance(entry, dict):
            raise SceneError(f"{label} is {short(entry)}, not an object with keys")
    return entries


def _tangents(
    path: Path, content: Mapping[str, Any], entries: Entries, *, nerfstudio: bool
) -> Tensor:
    """Tangent of half the field of view of each camera. [F]"""
    name, most, words = "camera_angle_x", math.pi, "pi radians"
    if nerfstudio:
        name, most, words = "fov", 180.0, "180 degrees"
    tangents = []
    for label, entry in entries.items():
        # A transforms file may have one angle for all frames.
        holder, where = (entry, label) if nerfstudio or name in entry else (content, path)
        angle = holder.get(name)
        if not is_positive(angle) or angle >= most:
            raise SceneError(
                f"{where}: {name} is {short(angle)}; it must lie between 0 and {words}"
            )
        tangents.append(math.tan(0.5 * math.pi * angle / most))
    return torch.tensor(tangents)


def _times(path: Path, entries: Entries, keys: tuple[str, ...]) -> Tensor:
    """Time of each camera; from 0 to 1 over the path if no camera has one. [F]"""
    found = [next((e[k] for k in keys if e.get(k) is not None), None) for e in entries.values()]
    if all(time is None for time in found):
        return torch.linspace(0, 1, len(entries))
    for label, time in zip(entries, found, strict=True):
        if not is_number(time) or not -OVERSHOOT <= time <= 1 + OVERSHOOT:
            raise SceneError(
                f"{label}: {keys[0]} is {short(time)}; it must be a number from 0 to 1 in every "
                f"camera of {path.name}, or in none"
            )
    times = torch.tensor(found, dtype=torch.float32)
    within = times.clamp(0, 1)
    if beyond := int((within != times).sum()):
        logger.warning(
            "%s: %d of %d times lie a little below 0 or above 1, as splines overshoot; they are "
            "clamped to 0 or 1",
            *(path, beyond, len(times)),
        )
    return within


def _count(path: Path, content: Mapping[str, Any], key: str) -> int | None:
    value = content.get(key)
    if value is None:
        return None
    if not is_positive(value) or round(value) < 1:
        raise SceneError(f"{path}: {key} is {short(value)}; it must be a whole number above 0")
    return round(value)
