"""Calibrations of rigs by EasyMocap, of Google's immersive videos, and of CMU Panoptic.

All three give rotations and translations from the world to cameras with OpenCV's axes.
"""

import re
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from xplanes.errors import SceneError, some, warn
from xplanes.readers.entries import checked_pose, decoded, parsed, reading, short, usable
from xplanes.readers.listing import Calibration
from xplanes.readers.transforms_lenses import read_calibration

FILES = ("extri.yml", "models.json", "calibration_*.json", "*/extri.yml", "*/calibration_*.json")
"""Files of EasyMocap (with intri.yml beside it), of immersive videos and of CMU Panoptic."""

MATRIX = re.compile(
    r"^([A-Za-z]+)_([^:\n]+):\s*!!opencv-matrix\s+rows:\s*(\d+)\s+cols:\s*(\d+)\s+dt:\s*\w+\s+"
    r"data:\s*\[([^\]]*)\]|^([HW])_([^:\n]+):[ \t]*([\d.]+(?:[Ee][+-]?\d+)?)\s*$",
    re.M,
)
"""A matrix, or a height or width, in a YAML file of OpenCV."""

OWNER = re.compile(r"^(?:K|Rot|R|T)_([^:\n]+):", re.M)
"""The name of a camera, at the beginning of one of its matrices."""

Camera = tuple[str, Any, Any, dict[str, Any]]
"""Name, rotation and translation from the world, and keys as of a transforms file."""

BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""OpenCV's order of coefficients of perspective lenses."""

NONE = 1e-6
"""Skew and coefficients of distortion up to this stand for none."""


def find_calibration(folder: Path, patterns: Sequence[str] = FILES) -> Path | None:
    """The file of a calibration in a folder or, for some formats, in the only one inside."""
    for pattern in patterns:
        found = sorted(path for path in folder.glob(pattern) if path.is_file())
        if len({path.parent for path in found}) == 1:  # Several folders are as many scenes.
            return found[0]
    return None


def read_calibrations(path: Path) -> list[tuple[str, str, np.ndarray, Calibration]]:
    """Name, label, pose and calibration of each camera.

    Args:
        path: Result of `find_calibration`.

    Raises:
        SceneError: If the file is not such a calibration, or if it is one of several.
    """
    advice = "Export it again, or write a transforms.json with a frame of each camera."
    rivals = sorted(each.name for each in path.parent.glob("calibration_*.json"))
    if path.name in rivals[:1] and len(rivals) > 1:
        raise SceneError(
            f"{path.parent} holds {len(rivals)} calibrations: {some(rivals)}. Keep only one there."
        )
    with reading(path, "as the calibration of cameras", advice):
        try:
            read = _easymocap if path.suffix == ".yml" else _in_json
            cameras = [*read(path, decoded(path.read_bytes()))]
            if not cameras:
                raise ValueError("it holds no camera")
            return usable("cameras", partial(_placed, path), cameras)
        except (LookupError, TypeError) as problem:
            raise ValueError(f"an entry is missing or of another kind: {problem}") from problem


def _placed(path: Path, camera: Camera) -> tuple[str, str, np.ndarray, Calibration]:
    """Name, label, pose and calibration of a camera."""
    name, rotation, shift, keys = camera
    if not isinstance(name, str):
        raise TypeError(f"name is {short(name)}")
    label, turn = f"{path}: {name}", np.array(rotation, dtype=np.float64)
    turn = turn if turn.size == 9 else _rotation(turn.ravel())
    pose = np.eye(4)
    pose[:3, :3] = turn.T * [1, -1, -1]
    pose[:3, 3] = -turn.T @ np.array(shift, dtype=np.float64).ravel()
    pose = checked_pose(label, pose, "the pose")
    return name, label, pose, read_calibration(label, {}, label, keys)


def _rotation(vector: np.ndarray) -> np.ndarray:
    """The rotation about a vector by its length in radians. [3, 3]"""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle else vector
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across


def _lens(label: str, matrix: Any, distortion: Any, corner: float = 0) -> dict[str, Any]:
    """Keys of a transforms file for OpenCV's intrinsics, and the place of its origin."""
    (fl_x, skew, cx), (_, fl_y, cy), _ = np.array(matrix, dtype=np.float64).tolist()
    sides = {"fl_x": fl_x, "fl_y": fl_y, "cx": cx + corner, "cy": cy + corner}
    lens = _coefficients(label, BROWN, distortion, skew)
    return {"camera_model": "FULL_OPENCV", **sides, **lens}


def _coefficients(
    label: str, names: Sequence[str], values: Any, skew: float = 0
) -> dict[str, float]:
    """Coefficients of distortion by name; refuses others, and skew."""
    found = np.array(values, dtype=np.float64).ravel().tolist()
    if lost := [value for value in (skew, *found[len(names) :]) if abs(value) > NONE]:
        raise SceneError(
            f"{label}: skew or coefficients after {names[-1]} are not read, but are {short(lost)}. "
            "Undistort the images, or calibrate without them."
        )
    return dict(zip(names, found, strict=False))


def _easymocap(path: Path, content: str) -> Iterable[Camera]:
    found: dict[tuple[str, str], Any] = {}
    text = f"{content}\n{decoded(path.with_name('intri.yml').read_bytes())}"
    for kind, name, rows, columns, data, side, owner, length in MATRIX.findall(text):
        if side:
            found[side, owner.strip()] = float(length)
        else:
            numbers = re.split(r"[,\s]+", data.strip(", \r\n"))
            values = [float(number.lstrip(".") if "a" in number else number) for number in numbers]
            found[kind, name.strip()] = np.reshape(values, (int(rows), int(columns)))
    names = [*dict.fromkeys(map(str.strip, OWNER.findall(text)))]
    wanted = [("K",), ("T",), ("R", "Rot")]
    lost = [
        name
        for name in names
        if not all(any((key, name) in found for key in keys) for keys in wanted)
    ]
    if lost and len(lost) < len(names):  # EasyMocap leaves out cameras that saw no board.
        warn(f"{path} and intri.yml: {some(lost)} lack K, R or T, and are left out.")
        names = [name for name in names if name not in lost]
    for name in names:
        rotation = found["Rot", name] if ("Rot", name) in found else found["R", name]
        distortion = found.get(("dist", name), found.get(("D", name), []))
        size = {key.lower(): found[key, name] for key in "WH" if (key, name) in found}
        label = f"{path.with_name('intri.yml')}: {name}"
        # Pixel centres are at whole numbers in OpenCV.
        lens = _lens(label, found["K", name], distortion, corner=0.5)
        if np.any(np.abs(found.get(("rdist", name), 0)) > NONE):
            raise SceneError(
                f"{label}: rdist, a fisheye lens of EasyVolcap, is not read. Undistort the images."
            )
        yield name, rotation, found["T", name], lens | size


def _in_json(path: Path, content: str) -> Iterable[Camera]:
    cameras = parsed(content)
    if isinstance(cameras, dict):  # Of CMU Panoptic.
        for camera in cameras["cameras"]:
            size = dict(zip("wh", camera["resolution"], strict=True))
            lens = _lens(f"{path}: {camera['name']}", camera["K"], camera["distCoef"])
            yield camera["name"], camera["R"], camera["t"], lens | size
        return
    for camera in cameras:
        if camera["projection_type"] != "fisheye":
            raise SceneError(
                f"{path}: projection_type is {camera['projection_type']}, and fisheye alone is "
                "read. Undistort the videos, and write a transforms.json with a frame of each."
            )
        (cx, cy), focal = camera["principal_point"], camera["focal_length"]
        down, label = focal * camera.get("pixel_aspect_ratio", 1), f"{path}: {camera['name']}"
        keys = {"camera_model": "OPENCV_FISHEYE", "fl_x": focal, "fl_y": down, "cx": cx, "cy": cy}
        keys |= {"w": camera["width"], "h": camera["height"]}
        skew = camera.get("skew", 0)
        keys |= _coefficients(label, ("k1", "k2"), camera["radial_distortion"], skew)
        rotation = _rotation(np.array(camera["orientation"], dtype=np.float64))
        yield camera["name"], rotation, -rotation @ np.array(camera["position"]), keys
