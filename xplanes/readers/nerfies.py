"""Captures in the format of Nerfies, HyperNeRF and DyCheck: one camera file per image."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from xplanes.errors import BrokenFrameError, SceneError, some, warn
from xplanes.readers.capture import CaptureSettings
from xplanes.readers.entries import (
    checked_number,
    checked_pose,
    image_path,
    is_number,
    mask_files,
    read_array,
    read_object,
    short,
    unit_times,
    usable,
)
from xplanes.readers.formats import ENDINGS
from xplanes.readers.images import native_sizes, width_rank
from xplanes.readers.listing import Calibration, Listing, held_out, time_source
from xplanes.scenes.views import Scene
from xplanes.settings import Location

logger = logging.getLogger(__name__)

TIMES = ("time_id", "warp_id", "appearance_id")
"""Keys of the timestep in metadata.json; the first one that all images have is used."""

EXAMPLE = '{"warp_id": 0, "camera_id": 0}'
"""An entry of metadata.json."""

DOWNLOAD = "Download or unpack the capture again."


@dataclass(frozen=True, kw_only=True)
class NerfiesSettings(CaptureSettings):
    """A capture in the format of Nerfies, HyperNeRF or DyCheck."""

    files: ClassVar = "dataset.json, metadata.json, scene.json, camera/ and rgb/"

    # Name of DyCheck's splits to use, such as mono or intl; null: those in splits/train.json if it
    # exists, otherwise those in dataset.json.
    protocol: str | None
    # Folder of masks, with the subfolders and file names of rgb, black outside the foreground; null
    # for none. DyCheck's co-visibility masks are unsuitable: they do not mark the foreground.
    masks: Location | None

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        return (folder / "dataset.json").is_file() and (folder / "camera").is_dir()

    def load(self, splits: Sequence[str]) -> Scene:
        folder = self.folder
        if not (folder / "dataset.json").is_file():
            raise self.no_scene()
        chosen, source = _splits(folder, self.protocol)
        names = list(dict.fromkeys(name for part in chosen.values() for name in part))
        pictures, lost = _picture_folder(folder, names, self.resolution)
        names = [name for name in names if name not in lost]
        listing, points = self._listing(names, pictures)
        places = {name: place for place, name in enumerate(listing.names)}
        found = {
            split: [places[name] for name in part if name in places]
            for split, part in chosen.items()
        }
        if not found.get("val"):
            found = held_out(listing, self.eval_every)
        return self.capture(listing, found, splits, source, points)

    def _listing(self, names: Sequence[str], pictures: str) -> tuple[Listing, np.ndarray | None]:
        """The usable images in a subfolder of rgb, and the points."""
        folder = self.folder
        root = folder.resolve()
        scale, centre = _scene(folder / "scene.json")
        path, metadata = folder / "metadata.json", {}
        if not self.static:
            metadata = read_object(path, "the timestep of each image")

        def camera_of(name: str) -> tuple[str, np.ndarray, Calibration]:
            label = str(folder / "dataset.json")
            if not self.static and not isinstance(metadata.get(name), dict):
                raise BrokenFrameError(f"{path} has no object for {name}, such as {EXAMPLE}.")
            return name, *_camera(image_path(label, root, f"camera/{name}.json", "ids"))

        cameras = usable("images", camera_of, names)
        names, poses, calibrations = zip(*cameras, strict=True)
        poses = np.stack(poses)
        poses[:, :3, 3] = (poses[:, :3, 3] - centre) * scale
        points = _points(folder / "points.npy")
        if points is not None:
            points = (points - centre) * scale
        labels = [f"{folder / 'dataset.json'}: {name}" for name in names]
        paths = [
            image_path(label, root, f"rgb/{pictures}/{name}", "ids")
            for label, name in zip(labels, names, strict=True)
        ]
        times, source = self._times(names, metadata)
        masks = ()
        if self.masks is not None:
            kinds = [(f"{pictures}/{name}", name) for name in names]
            masks = mask_files(folder / self.masks, kinds)
        listing = Listing.checked(
            folder,
            labels,
            paths,
            poses,
            times,
            files=tuple(path.relative_to(root).as_posix() for path in paths),
            calibrations=calibrations,
            masks=masks,
            time_source=source,
            names=names,
        )
        return listing, points

    def _times(self, names: Sequence[str], metadata: Mapping[str, Any]) -> tuple[list[float], str]:
        """Times from 0 to 1, and their source; no times if the scene is static."""
        if self.static:
            return [], ""
        path, entries = self.folder / "metadata.json", [metadata[name] for name in names]
        key = next((key for key in TIMES if all(key in entry for entry in entries)), None)
        if key is None:
            raise SceneError(
                f"{path}: not all images have one of {', '.join(TIMES)}. Add the number of the "
                "timestep to each image, or set data.static=true."
            )
        times = [checked_number(path, f"{key} of {name}", metadata[name][key]) for name in names]
        logger.info(
            "%s: %s from %s to %s is mapped to times from 0 to 1",
            *(path, key, min(times), max(times)),
        )
        return unit_times(times), time_source(key, names, times)


def _splits(folder: Path, protocol: str | None) -> tuple[dict[str, list[str]], Path]:
    """Names of the training and validation images, and the file that lists them.

    If no images are listed for scoring, all images are training images.
    """
    ending = "" if protocol is None else f"_{protocol}"
    path = folder / "splits" / f"train{ending}.json"
    found: dict[str, list[str]] = {}
    if protocol is not None and not path.is_file():
        names = sorted(
            other.stem.removeprefix("train_") for other in path.parent.glob("train_*.json")
        )
        raise SceneError(
            f"data.protocol={protocol}: {path} does not exist. "
            + (f"Set it to {' or '.join(names)}." if names else "Set it to null.")
        )
    if path.is_file():
        for split in ("train", "val"):
            listed = path.with_name(f"{split}{ending}.json")
            if listed.is_file():
                content = read_object(listed, '"frame_names"')
                found[split] = _names(listed, content, "frame_names")
    else:
        path = folder / "dataset.json"
        content = read_object(path, '"ids"')
        for split in ("train", "val"):
            if content.get(f"{split}_ids"):
                found[split] = _names(path, content, f"{split}_ids")
        if "train" not in found:
            scored = set(found.get("val", ()))
            names = [name for name in _names(path, content, "ids") if name not in scored]
            found = {"train": names} | found
    shared = sorted(set(found["train"]) & set(found.get("val", ())))
    if shared:
        raise SceneError(
            f"{path}: {len(shared)} images are listed both for training and for scoring: "
            f"{some(shared)}. Remove them from one of the two lists."
        )
    return found, path


def _names(path: Path, content: Mapping[str, Any], key: str) -> list[str]:
    names = content.get(key)
    if not (isinstance(names, list) and names and all(isinstance(n, str | int) for n in names)):
        raise SceneError(
            f"{path}: {key} is {short(names)}; it must be a list of one or more names of images."
        )
    texts = [str(name) for name in names]
    if outside := [name for name in texts if ".." in name.split("/")]:
        raise SceneError(f"{path}: {key} leaves the scene's folder: {some(outside)}.")
    if len(set(texts)) < len(texts):
        twice = next(name for name in texts if texts.count(name) > 1)
        raise SceneError(f"{path}: {key} lists {twice} twice. Remove one of the two.")
    return texts


def _scene(path: Path) -> tuple[float, np.ndarray]:
    """Scale and centre that normalise positions: ``(position - centre) * scale``."""
    content = read_object(path, "scale and center")
    scale = checked_number(path, "scale", content.get("scale"), positive=True)
    return float(scale), _numbers(path, content, "center", 3)


def _numbers(path: Path, content: Mapping[str, Any], key: str, count: int) -> np.ndarray:
    """A list of finite numbers. float64 [count]"""
    values = content.get(key)
    if not (isinstance(values, list) and len(values) == count and all(map(is_number, values))):
        # NaN and infinity are those of one camera, not of another format.
        broken = isinstance(values, list) and {"nan", "inf", "-inf"} & {*map(str, values)}
        raise (BrokenFrameError if broken else SceneError)(
            f"{path}: {key} is {short(values)}; it must be {count} numbers. {DOWNLOAD}"
        )
    return np.array(values, dtype=np.float64)


def _camera(path: Path) -> tuple[np.ndarray, Calibration]:
    """The pose of a camera file, before it is centred and scaled, and its lens."""
    content = read_object(path, "orientation, position and focal_length")
    rows = content.get("orientation")
    if not isinstance(rows, list) or len(rows) != 3:
        raise SceneError(f"{path}: orientation is {short(rows)}; it must be 3 rows of 3 numbers.")
    table = {f"row {index} of orientation": row for index, row in enumerate(rows)}
    orientation = np.stack([_numbers(path, table, key, 3) for key in table])
    if np.linalg.det(orientation) < 0:
        raise SceneError(
            f"{path}: orientation mirrors (determinant -1, must be +1). Its rows are the camera's "
            "axes in the world: right, down, forward. Negate one of them."
        )
    pose = np.eye(4)
    # OpenGL's cameras have y up and look along -z.
    pose[:3, :3] = orientation.T * [1, -1, -1]
    pose[:3, 3] = _numbers(path, content, "position", 3)
    checked_pose(str(path), pose, "orientation")
    focal = checked_number(path, "focal_length", content.get("focal_length"), positive=True)
    aspect = content.get("pixel_aspect_ratio", 1.0)
    aspect = checked_number(path, "pixel_aspect_ratio", aspect, positive=True)
    skew = checked_number(path, "skew", content.get("skew", 0))
    width, height = _numbers(path, content, "image_size", 2)
    if width < 1 or height < 1:
        raise SceneError(
            f"{path}: image_size is {width:g} x {height:g}; it must be at least one pixel. "
            f"{DOWNLOAD}"
        )
    centre_x, centre_y = _numbers(path, content, "principal_point", 2)
    # The first captures use another key.
    tangential = "tangential" if "tangential" in content else "tangential_distortion"
    none = {"radial_distortion": [0, 0, 0], tangential: [0, 0]}
    radial = _numbers(path, none | content, "radial_distortion", 3)
    distortion = [*radial, *_numbers(path, none | content, tangential, 2)]
    calibration = Calibration(
        fl_x=float(focal),
        fl_y=focal * aspect,
        cx=float(centre_x),
        cy=float(centre_y),
        w=float(width),
        h=float(height),
        distortion=dict(zip(("k1", "k2", "k3", "p1", "p2"), map(float, distortion), strict=True)),
        skew=float(skew),
    )
    return pose, calibration


def _picture_folder(
    folder: Path, names: Sequence[str], resolution: int | None
) -> tuple[str, set[str]]:
    """The folder in rgb of the width that `width_rank` prefers, and the images that it lacks.

    If it lacks some, the one that lacks the fewest is used, preferably of the next larger scale.
    """
    widths: dict[str, int] = {}
    lost: dict[str, list[str]] = {}
    scales = [path.name for path in (folder / "rgb").glob("*x") if path.name[:-1].isdecimal()]
    for scale in scales or ["."]:
        files = {name: _image_of(folder / "rgb" / scale, name) for name in names}
        if found := [file for file in files.values() if file is not None]:
            widths[scale] = native_sizes(found[:1])[0][1]
            lost[scale] = [name for name, file in files.items() if file is None]
    if not widths:
        raise SceneError(
            f"{folder / 'rgb'} has no folder, such as 1x or 4x, with an image of {names[0]}. "
            f"{DOWNLOAD}"
        )
    wanted = min(widths, key=lambda name: width_rank(widths[name], resolution))

    def rank(name: str) -> tuple[int, bool, int]:
        wider = widths[name] - widths[wanted]
        return len(lost[name]), wider < 0, abs(wider)

    chosen = min(widths, key=rank)
    if lost[wanted]:
        rest = f", without {some(lost[chosen])}" if lost[chosen] else ""
        warn(
            f"{len(lost[wanted])} of {len(names)} images are not in {folder / 'rgb' / wanted}: "
            f"{some(lost[wanted])}. Those of rgb/{chosen} are read{rest}."
        )
    return chosen, {*lost[chosen]}


def _image_of(folder: Path, name: str) -> Path | None:
    return next(filter(Path.is_file, (folder / f"{name}{end}" for end in ENDINGS)), None)


def _points(path: Path) -> np.ndarray | None:
    """Points of the background, before they are centred and scaled. float64 [N, 3]"""
    if not path.is_file():
        return None
    advice = f"{DOWNLOAD} Or remove it: it is not needed."
    points = read_array(path, advice)
    numbers = points.dtype.kind in "fiu"
    if not (numbers and points.ndim == 2 and points.shape[1] == 3 and np.isfinite(points).all()):
        raise SceneError(
            f"{path} holds an array {list(points.shape)}; it must be finite positions [N, 3]. "
            f"{advice}"
        )
    return points.astype(np.float64)
