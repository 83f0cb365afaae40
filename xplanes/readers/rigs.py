"""The cameras of a rig: which videos or folders are theirs, and their calibration.

A calibration is poses_bounds.npy (Neural 3D Video), with rows in the order of the cameras' names; a
transforms.json that names each camera's video, its folder of images, or one of these images; a
model of COLMAP that has registered one image per camera, with the name of the camera; or a file of
another program (`calibrations`).
"""

import functools
import json
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from xplanes.errors import BrokenFrameError, SceneError, some, warn
from xplanes.files import natural
from xplanes.readers import videos
from xplanes.readers.calibrations import FILES, find_calibration, read_calibrations
from xplanes.readers.colmap_model import MODELS, SparseModel, find_model, image_count, read_model
from xplanes.readers.entries import (
    checked_pose,
    is_positive,
    paths_inside,
    read_array,
    spelt,
    usable,
)
from xplanes.readers.formats import is_image
from xplanes.readers.listing import Calibration
from xplanes.readers.masks import MASKS
from xplanes.readers.transforms import (
    TIMES,
    TRANSPARENT,
    read_frames,
    warn_of_unknown,
)
from xplanes.readers.transforms_lenses import read_calibration

POSES = "poses_bounds.npy"
TRANSFORMS = "transforms.json"

CAMERAS = re.compile(r"(?i)cam(?!.*(path|calib|traj|param|vis))(?!eras$)")
"""Beginning of the names of cameras, but not of camera_paths, cam_calib and the like."""

NUMBERED = re.compile(r"(?i)((view|camera|c|v)[_-]?\d+|\d\d+)")
"""Pattern of camera names other than cam*."""

DYNAMIC = ("motion_masks", "mv_images", "flow_i1", "flow", "disp")
"""Folders of dynamic scenes in LLFF's format, as used by NSFF and DynamicNeRF."""

STATIC = "none, as in LLFF's static captures (data.static=false takes those in the names)"
"""Source of the times of captures with poses_bounds.npy that have no such folder."""

TIMESTEPS = "mv_images"
"""Folder with a subfolder for each timestep, as in Nvidia's Dynamic Scenes."""

UNREAD = (
    *("mask_path", *TRANSPARENT, *TIMES),
    *("train_filenames", "val_filenames", "test_filenames"),
)
"""Keys of transforms files that are read of captures, but not of several fixed cameras."""

OTHER_KINDS = re.compile(
    r"(?i)(?<![a-z])(masks?|mattes?|silhouettes?|depths?|disp|seg|segmentations?|normals?|flow)"
    r"(?![a-z])"
)
"""Part of the names of images that show something else than colours."""

IMAGES = ("images", "image", "rgb", "frames")
"""Names of the subfolder with a camera's images, if the camera has several subfolders."""

SAME_POSE = 1e-4
"""Largest difference between poses of a fixed camera."""


@dataclass(frozen=True)
class Camera:
    """A fixed camera and the source of its frames.

    Attributes:
        name: Name of its video, or of its folder of images.
        source: The video, or the folder of images.
        pose: Camera-to-world matrix with OpenGL's axes. float64 [4, 4]
        calibration: Its focal length, principal point and lens.
        label: The file and entry of its calibration, for messages.
    """

    name: str
    source: Path
    pose: np.ndarray
    calibration: Calibration
    label: str


def read_cameras(folder: Path) -> tuple[list[Camera], Mapping[str, Any]]:
    """The calibrated cameras of a folder, in the order of its calibration.

    Returns:
        The cameras, and the content of transforms.json; empty for other calibrations.

    Raises:
        SceneError: If it has no calibration, or one that does not fit its videos and images.
    """
    content: Mapping[str, Any] = {}
    if (folder / POSES).is_file():
        cameras = _from_poses_bounds(folder)
    elif (folder / TRANSFORMS).is_file():
        content = read_frames(folder / TRANSFORMS)
        cameras = _from_transforms(folder, content)
    elif (model := find_model(folder)) is not None:
        cameras = _from_colmap(folder, model)
    elif (path := find_calibration(folder)) is not None:
        cameras = _from_calibration(folder, path)
    else:
        found = ", ".join(sorted(path.name for path in folder.iterdir())[:8]) or "nothing"
        raise SceneError(
            f"{folder} holds neither {POSES} (Neural 3D Video) nor {TRANSFORMS} (a frame for each "
            f"camera) nor {MODELS[0]} (COLMAP's model of an image of each) nor extri.yml "
            f"(EasyMocap), but {found}. Add the calibration of the cameras."
        )
    cameras = _named_apart(cameras)
    names = [camera.name for camera in cameras]
    if twice := [name for name in names if names.count(name) > 1]:
        raise SceneError(
            f"{folder}: several cameras are called {twice[0]}. Rename their videos or folders."
        )
    return [replace(camera, source=with_frames(camera.source)) for camera in cameras], content


def _named_apart(cameras: Sequence[Camera]) -> list[Camera]:
    """Cameras of equal names are called by the folders in which they differ (cam0/images)."""
    folders = [camera.source.parts[:-1] for camera in cameras]
    levels = [level for level in zip(*folders, strict=False) if len({*level}) > 1]
    if len({camera.name for camera in cameras}) == len(cameras) or not levels:
        return list(cameras)
    return [
        replace(camera, name="_".join(parts))
        for camera, parts in zip(cameras, zip(*levels, strict=True), strict=True)
    ]


def recordings_of_cameras(folder: Path) -> list[Path]:
    """Videos and folders called cam*, else those with numbers such as 00 or view_01, by name."""
    inside = _colours(sorted(filter(_is_recording, folder.iterdir())))
    numbered = [path for path in inside if NUMBERED.fullmatch(camera_name(path))]
    named = [path for path in inside if CAMERAS.match(camera_name(path))]
    counted = [path for path in named if re.search(r"\d", camera_name(path))]
    named = [path for path in named if path in counted or _is_filled(path)]
    return named if counted or len(named) > 1 else numbered


def is_dynamic(folder: Path) -> bool:
    """Whether a capture in LLFF's format has folders of a dynamic scene."""
    return any((folder / name).is_dir() for name in DYNAMIC)


def are_registered(folder: Path) -> bool:
    """Whether COLMAP registered an image of each of several cameras, not those of a capture."""
    # A transforms.json that was converted from another model takes precedence.
    place = find_model(folder, MODELS[:2] if (folder / TRANSFORMS).is_file() else MODELS)
    if place is None or len(recordings_of_cameras(folder)) > 1:
        return place is not None
    found = recordings_below(folder, "images")
    return len(found) > 1 and 1 < image_count(place) <= len(found)


def is_calibrated(folder: Path) -> bool:
    """Whether another program's calibration is the only one, and names two recordings or more."""
    with suppress(OSError):  # The user may not have access to some files.
        path = find_calibration(folder)
        if path and not (any(folder.glob("transforms*.json")) or find_model(folder)):
            content = path.read_bytes()
            text = content.decode(json.detect_encoding(content), "replace")
            names = _recordings_of_any_name(folder, path)
            known = [name for name in names if re.search(rf'["_]{re.escape(name)}(?!\w)', text)]
            return len(names if path.suffix == ".yml" else known) > 1
    return False


def _recordings_of_any_name(folder: Path, calibration: Path) -> dict[str, Path]:
    """Videos, or else folders of images, in a folder or in one inside, by camera."""
    inside = _colours(sorted(p for p in folder.iterdir() if p.is_dir() and _is_recording(p)))
    # Other folders with a calibration are other scenes.
    own = [p for p in inside if p == calibration.parent or not find_calibration(p, FILES[:3])]
    found = [path for p in (folder, *own) for path in sorted(filter(_is_recording, p.iterdir()))]
    # EasyMocap extracts images from videos, and programs write folders of the same names.
    found.sort(key=lambda path: (path.is_file(), path.parent.name.lower() in IMAGES))
    return {re.sub("^(hd|vga)_", "", camera_name(p)): p for p in found if _is_filled(p)}


def recordings_below(folder: Path, *others: str) -> list[Path]:
    """Recordings in a folder, or in its only subfolder, but for ``others``, that has some."""
    if found := recordings_of_cameras(folder):
        return found
    others = (TIMESTEPS, *others)
    inside = [path for path in folder.iterdir() if path.is_dir() and path.name not in others]
    deeper = [paths for path in inside if (paths := recordings_of_cameras(path))]
    kept = [paths for paths in deeper if not OTHER_KINDS.search(paths[0].parent.name)]
    if kept or any((folder / name).is_dir() for name in others):
        deeper = kept
    if len(deeper) > 1:  # Of videos and images extracted from them, videos are read.
        named = [paths for paths in deeper if paths[0].parent.name.lower() in IMAGES]
        deeper = [paths for paths in deeper if all(map(Path.is_file, paths))] or named
    return deeper[0] if len(deeper) == 1 else []


def recordings_of_rows(folder: Path) -> list[Path]:
    """Recordings with rows in poses_bounds.npy: of any name if there are only videos."""
    inside = sorted(path for path in folder.iterdir() if path.name[0] != ".")
    loose = _colours([*filter(videos.is_video, inside)])
    images = any(path.name.startswith("images") or path.name.lower() in IMAGES for path in inside)
    return recordings_below(folder) or ([] if images or len(loose) < 2 else loose)


def _colours(paths: Sequence[Path]) -> list[Path]:
    """Recordings but for masks, depths and the like, if others remain."""
    return [path for path in paths if not OTHER_KINDS.search(camera_name(path))] or [*paths]


def is_rig(folder: Path) -> bool:
    """Whether the frames of transforms.json name different videos or folders of several images.

    If so, they are cameras rather than the images of a capture. A folder whose images are all of
    different kinds, such as rgb.png beside depth.png, is a view of a capture.
    """
    sources: set[Path] = set()
    try:
        frames, named = read_frames(folder / TRANSFORMS)["frames"], _videos_by_name(folder)
        for frame in frames:
            with suppress(BrokenFrameError):
                source = with_frames(_source("", folder.resolve(), frame["file_path"], named))
                kinds = [] if source.is_file() else [_kind(path) for path in images_in(source)]
                if source in sources or (kinds and len({*kinds}) == len(kinds)):
                    return False
                if kinds or source.is_file():
                    sources.add(source)
    except SceneError:
        return False
    return len(sources) > 1


def camera_name(path: Path) -> str:
    """Name of the camera of a folder, or of a video, whose ending is no part of it."""
    return path.stem if path.suffix.lower() in videos.SUFFIXES else path.name


def _is_filled(path: Path) -> bool:
    """Whether a recording is a video, or a folder with images or one video."""
    return with_frames(path).is_file() or bool(images_in(path))


def _is_recording(path: Path) -> bool:
    return videos.is_video(path) or (path.is_dir() and path.name[0] != ".")


def _from_poses_bounds(folder: Path) -> list[Camera]:
    """Cameras of poses_bounds.npy; its rows are in the order of the videos' or folders' names."""
    path = folder / POSES
    # A video may be beside a folder of images extracted from it.
    sources = list({camera_name(source): source for source in recordings_of_rows(folder)}.values())
    names = [source.name for source in sources]
    if names != sorted(names, key=natural):
        pairs = ", ".join(f"row {row} is {name}" for row, name in enumerate(names[:3]))
        warn(
            f"{path}: rows are in the plain order of names, as LLFF writes them: {pairs}. If they "
            "have the order of the numbers, write these with leading zeros."
        )
    return read_poses_bounds(path, sources)


def read_poses_bounds(path: Path, sources: Sequence[Path]) -> list[Camera]:
    """The cameras of poses_bounds.npy, whose rows are of images, videos or folders in this order.

    Raises:
        SceneError: If it cannot be read, or has another number of rows.
    """
    rows = read_array(path, "Export or download it again.")
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f":
        raise SceneError(
            f"{path} holds {rows.dtype} {list(rows.shape)}, not one row of 17 numbers for each "
            "camera: a pose of 3 rows and 5 columns, then the nearest and the farthest depth."
        )
    if len(sources) != len(rows):
        names = some([source.name for source in sources]) or "none"
        raise SceneError(
            f"{path} has {len(rows)} cameras, but {path.parent} holds {len(sources)} (cam*, or "
            f"numbers): {names}. Add what is missing, or take the others' rows out."
        )

    def read(index: int) -> Camera:
        row, source = rows[index], sources[index]
        label = f"{path}: row {index} ({source.name})"
        matrix = row[:15].astype(np.float64).reshape(3, 5)
        down, right, back, centre, (height, width, focal) = matrix.T
        pose = np.eye(4)
        pose[:3] = np.stack([right, -down, back, centre], axis=1)
        pose = checked_pose(label, pose, "the pose")
        for key, value in (("height", height), ("width", width), ("focal length", focal)):
            if not is_positive(float(value)):
                raise SceneError(f"{label}: {key} is {value:g}; it must be above 0. Export again.")
        calibration = Calibration(fl_x=float(focal), w=float(width), h=float(height))
        return Camera(camera_name(source), source, pose, calibration, label)

    return usable("rows", read, range(len(rows)))


def _from_transforms(folder: Path, content: Mapping[str, Any]) -> list[Camera]:
    """Cameras of transforms.json: one frame per camera, or several with the same pose."""
    path = folder / TRANSFORMS
    cameras: dict[Path, Camera] = {}
    content_of = functools.cache(with_frames)  # Many frames may be of one camera.
    named = _videos_by_name(folder)

    def located(item: tuple[int, dict[str, Any]]) -> tuple[str, dict[str, Any], Path, np.ndarray]:
        index, frame = item
        label, name = f"{path}: frame {index} ({frame['file_path']})", frame["file_path"]
        source = _source(label, folder.resolve(), name, named)
        if source.is_dir() and is_image(image := Path(spelt(name))):
            # A folder has an image of each camera, all frames of one, or one of its video.
            if source.name not in named:
                source = named.get(image.stem, source)
            elif len(images_in(source)) == 1:
                source = named[source.name]
        return label, frame, source, checked_pose(label, frame["transform_matrix"])

    for label, frame, source, pose in usable("frames", located, [*enumerate(content["frames"])]):
        if (other := cameras.get(content_of(source))) is not None:
            if np.abs(other.pose - pose).max() > SAME_POSE:
                raise SceneError(
                    f"{label} has another pose than {other.label}, but both lead to {source}, "
                    "and cameras must not move. Read a moving camera with data=nerfstudio."
                )
            continue
        calibration = read_calibration(str(path), content, label, frame)
        camera = Camera(camera_name(source), source, pose, calibration, label)
        cameras[content_of(source)] = camera
    warn_of_unknown(path, content, UNREAD)
    return list(cameras.values())


def _from_colmap(folder: Path, place: Path) -> list[Camera]:
    """Cameras of a sparse model with one registered image per camera."""
    model = read_model(place)
    recordings = recordings_below(folder, "images")
    folder = recordings[0].parent if recordings else folder
    sources: dict[str, list[Path]] = defaultdict(list)
    for path in _colours(sorted(filter(_is_recording, folder.iterdir()))):
        sources[camera_name(path)].append(path)
    # Other folders, such as images and sparse, need not be cameras.
    expected = {path for paths in sources.values() for path in paths if path.is_file()}
    expected = sorted(expected | set(recordings))
    sources |= _counted(model, recordings)
    owned: dict[Path, list[str]] = {path: [] for path in expected}
    cameras, problems = [], []
    for name, pose, calibration in zip(
        model.names, model.camera_to_world, model.calibrations, strict=True
    ):
        image = PurePosixPath(name)
        found = [
            path
            for text in dict.fromkeys((image.stem, image.parent.name))
            # A video may be beside a folder of images extracted from it.
            for path in [path for path in sources[text] if path.is_file()] or sources[text]
        ]
        if not set(found) & set(expected):  # cam00/images/0001.png
            outer = {parent.name for parent in image.parents}
            found = [path for path in recordings if path.name in outer] or found
        if not found:  # cam00_0001.png
            part = r"(?<![A-Za-z\d]){}(?![A-Za-z\d])".format
            found = [p for p in expected if re.search(part(re.escape(camera_name(p))), image.stem)]
        for path in found:
            owned.setdefault(path, []).append(name)
            label = f"{model.source}: {name}"
            cameras.append(Camera(camera_name(path), path, pose, calibration, label))
        if len(found) != 1:
            words = " or of ".join(path.name for path in found)
            problems.append(f"{name} may be of {words or 'no video or folder'}")
    known = {camera_name(path) for path, names in owned.items() if names}
    lost = [path.name for path in owned if camera_name(path) not in known]
    for path, names in owned.items():
        if len(names) > 1:
            problems.append(f"{some(names)} belongs to {path.name}")
    if lost and not problems and len(known) > 1:  # COLMAP may lose a camera of a sparse rig.
        warn(
            f"{model.source} has no registered image of {some(lost)}: {len(lost)} of "
            f"{len(lost) + len(known)} cameras are left out."
        )
    else:
        problems += [f"no registered image belongs to {name}" for name in lost]
    folders = Counter(PurePosixPath(name).parent for name in model.names)
    if problems and len(folders) > 1 and min(folders.values()) > 1:
        raise SceneError(
            f"{model.source} has several images of each camera, such as {some(model.names)}. Read "
            "them all, at the times in their names, with data=colmap; data=multicamera reads the "
            "frames of cameras of which one image is registered."
        )
    if problems:
        raise SceneError(
            f"{model.source}: {some(problems)}. One image of each camera must be registered, and "
            "have its name: cam00.png, cam00/0001.png or cam00/images/0001.png for cam00.mp4, or "
            "for the folder cam00. "
            f"Registered images: {some(model.names)}. Videos, and folders of the name cam*, in "
            f"{folder}: {some([path.name for path in expected]) or 'none'}. Move what is not a "
            "camera elsewhere, or read all registered images with data=colmap."
        )
    return cameras


def _from_calibration(folder: Path, path: Path) -> list[Camera]:
    """Those cameras of another program's calibration that have a recording."""
    sources, cameras, lost = _recordings_of_any_name(folder, path), [], []
    for name, label, pose, calibration in read_calibrations(path):
        if (source := sources.get(name)) is None:
            lost.append(name)
        else:
            cameras.append(Camera(name, source, pose, calibration, label))
    if not cameras:
        raise SceneError(
            f"{path}: none of its cameras has a video or a folder of images of its name, such as "
            f"images/{lost[0]} or videos/{lost[0]}.mp4. Add them to {folder}."
        )
    if path.match("calibration_*"):  # Panels of CMU Panoptic are recorded, and fetched, as a whole.
        panels = {camera.name.split("_")[0] for camera in cameras}
        lost = [name for name in lost if name.split("_")[0] in panels]
        kinds = Counter(_kind_of_panel(camera) for camera in cameras)
        usual = max(kinds, key=kinds.__getitem__)
        if len(kinds) > 1:
            slower = [camera.name for camera in cameras if _kind_of_panel(camera) != usual]
            cameras = [camera for camera in cameras if camera.name not in slower]
            warn(
                f"{path}: {usual} cameras are read, and not {some(slower)}, which have other rates."
            )
    read = {camera.source for camera in cameras}
    others = [other for other in _colours([*sources.values()]) if other not in read]
    if others := [other.name for other in others if other.parent in {own.parent for own in read}]:
        warn(
            f"{path} has no camera of {some(others)}. {len(others)} are left out: add their "
            "calibration, or move them elsewhere."
        )
    if lost:
        warn(
            f"{path}: {len(lost)} of {len(lost) + len(cameras)} cameras have no video or folder of "
            f"images of their name and are left out: {some(lost)}."
        )
    return cameras


def _kind_of_panel(camera: Camera) -> str:
    """Kind of a camera of CMU Panoptic by its panel; kinds differ in their rates."""
    return {"00": "HD", "50": "Kinect"}.get(camera.name.split("_")[0], "VGA")


def _counted(model: SparseModel, recordings: Sequence[Path]) -> dict[str, list[Path]]:
    """Recordings by image1, image2, ... (4DGaussians); empty if images have other names."""
    named = {camera_name(path): path for path in recordings}
    names = sorted(named, key=natural)
    # An image has the number of cam01 and the like; without such numbers they are counted.
    numbers = [int(match[0]) for name in names if (match := re.search(r"\d+$", name))]
    if len(numbers) < len(names) or 0 in numbers:
        numbers = range(1, len(names) + 1)
    counted = {f"image{n}": [named[name]] for n, name in zip(numbers, names, strict=True)}
    if not {PurePosixPath(name).stem for name in model.names} <= {*counted}:
        return {}
    warn(
        f"{model.source}: image1, image2, ... are taken for images of {some(names)}, in this "
        "order. If they are not, give them the cameras' names."
    )
    return counted


def _videos_by_name(folder: Path) -> dict[str, Path]:
    """Videos in a folder, or else in one inside that is not of masks, by name without ending."""
    folder = folder.resolve()
    inside = [p for p in sorted(folder.glob("*/*")) if not OTHER_KINDS.search(p.parent.name)]
    found = filter(videos.is_video, [*inside, *sorted(folder.glob("*"))])
    return {path.stem: path for path in found}


def _source(label: str, folder: Path, name: Any, named: Mapping[str, Path]) -> Path:
    """The video or the folder of images that a frame names.

    Args:
        label: The file and frame, for messages.
        folder: The scene's folder.
        name: Name of the video, which may have another ending, of the folder, or of an image in it.
        named: Result of `_videos_by_name`.
    """
    for source in paths_inside(label, folder, name, "file_path", "cam00.mp4"):
        if source.is_dir() or (source.is_file() and source.suffix.lower() in videos.SUFFIXES):
            break
        if source.is_file() and source.parent != folder:
            return source.parent
    else:
        if (video := named.get(PurePosixPath(spelt(name)).stem)) is not None:
            return video
        raise BrokenFrameError(
            f"{label}: {folder / name} is not a video ({', '.join(videos.SUFFIXES)}), a folder "
            "of images or an image in a folder of one camera. Add it, or remove the frame from "
            "the list."
        )
    if source == folder:
        raise SceneError(f"{label}: file_path is the scene's folder, not that of one camera.")
    return source


def with_frames(source: Path) -> Path:
    """A camera's source, or the only video in its folder if no images lie beside it."""
    if source.is_file():
        return source
    inside = [*filter(Path.is_file, source.iterdir())]
    if any(map(is_image, inside)):
        return source
    found = [*filter(videos.is_video, inside)]
    return found[0] if len(found) == 1 else source


def _kind(path: Path) -> str:
    """Name of an image without its numbers, which images of one kind share."""
    return re.sub(r"\d+", "#", path.stem)


def frames_in(folder: Path) -> list[Path]:
    """The images of a folder that are a camera's frames; warns of the others, but for masks.

    Left out are masks, depths and the like beside images of another kind, images without a number
    beside those with one, and copies in another format.
    """
    images = images_in(folder)
    kept = [path for path in images if not OTHER_KINDS.search(path.stem)] or images
    kept = [path for path in kept if not MASKS.search(path.stem)] or kept
    kept = [path for path in kept if re.search(r"\d", path.stem)] or kept
    kept = list({path.stem: path for path in reversed(kept)}.values())[::-1]
    used = {*kept}
    left = [path.name for path in images if path not in used and not MASKS.search(path.name)]
    if left:
        warn(f"{folder}: {some(left)}: no frames beside {kept[0].name}. {len(left)} are left out.")
    return kept


def images_in(folder: Path) -> list[Path]:
    """Images of a folder, or of its only subfolder, in the order of the numbers in their names."""
    inside = sorted(folder.iterdir(), key=lambda path: natural(path.name))
    if found := [path for path in inside if is_image(path)]:
        return found
    folders = [path for path in inside if path.is_dir() and path.name[0] != "."]
    folders = [path for path in folders if not OTHER_KINDS.search(path.name)]
    named = [path for path in folders if path.name.lower() in IMAGES]
    folders = named if len(folders) > 1 else folders
    return images_in(folders[0]) if len(folders) == 1 else []
