"""Videos of several fixed cameras: Neural 3D Video, or a folder with a calibration.

Neural 3D Video keeps the calibration in poses_bounds.npy and the cameras as cam00.mp4, cam01.mp4,
... in the same order. In other folders a transforms.json names each camera's video, its folder of
images, or one of these images; or COLMAP has registered one image of each camera, of the camera's
name.
"""

import logging
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from xplanes.errors import ConfigError, MissingSplitError, SceneError, refuse_all, warn
from xplanes.files import natural
from xplanes.scenes import store, videos
from xplanes.scenes.colmap_model import MODELS, find_model, read_model
from xplanes.scenes.entries import (
    checked_pose,
    is_positive,
    paths_inside,
    require_fetched,
    require_precision,
    some,
    unit_times,
)
from xplanes.scenes.formats import ENDINGS, is_image, read_header
from xplanes.scenes.images import (
    Size,
    cleared,
    digests,
    final_sizes,
    native_sizes,
    read_image,
    shrink,
)
from xplanes.scenes.listing import (
    Calibration,
    final_intrinsics,
    misshapen,
    require_rays,
)
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.transforms import read_calibration, read_frames
from xplanes.scenes.views import Scene, Views

logger = logging.getLogger(__name__)

POSES = "poses_bounds.npy"
TRANSFORMS = "transforms.json"

NUMBERED = re.compile(r"(?i)((view|camera|c|v)[_-]?\d+|\d\d+)")
"""Names of cameras that are not called cam*."""

IMAGES = ("images", "image", "rgb", "frames")
"""Folders of a camera that hold its images, where there are others beside them."""

SAME_RATE = 1e-3
"""Share by which frame rates of synchronised cameras differ at most."""

LATE = 1.5
"""How many times the median a gap between frames is if the rate varies."""

SAME_POSE = 1e-4
"""Largest difference between poses of a fixed camera."""


@dataclass(frozen=True, kw_only=True)
class MultiCameraSettings(SceneSettings):
    """Synchronised videos of several fixed cameras."""

    files: ClassVar = (
        "videos or folders cam00, cam01, ... with poses_bounds.npy or a model of COLMAP"
    )

    frames: list[int] | None  # First frame, last frame and stride; null for all frames.
    # Names of the held-out cameras: scored, not trained on. null: cam00, or else the most central.
    test_cameras: list[str] | None
    video_camera: str | None  # Camera whose video the LRM sees; null: the most central one.

    def check(self) -> None:
        if self.frames is None:
            return
        if len(self.frames) != 3:
            raise ConfigError(
                f"frames={self.frames}: must be [first, last, stride], such as [0,299,1], or null"
            )
        first, last, stride = self.frames
        if not 0 <= first <= last or stride < 1:
            raise ConfigError(
                f"frames={self.frames}: the first frame must be 0 or later, the last not before "
                "it, and the stride at least 1"
            )

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        if (folder / POSES).is_file():
            return bool(recordings_of_cameras(folder))
        return find_model(folder, MODELS[:2]) is not None and len(recordings_of_cameras(folder)) > 1

    def load(self, splits: Sequence[str]) -> Scene:
        if self.train_on_video:
            raise SceneError(
                "data.train_on_video=true: the video's camera is one of the training cameras "
                "already; set it to false"
            )
        folder = self.folder
        if not folder.is_dir():
            raise SceneError(
                f"The scene folder {folder.absolute()} does not exist. Set data.root and "
                f"data.scene to a folder with {POSES}, {TRANSFORMS} or {MODELS[0]} and the "
                "cameras' videos."
            )
        cameras = read_cameras(folder)
        parts = _split_cameras(folder, cameras, self.test_cameras)
        for split in splits:
            if split not in parts:
                raise MissingSplitError(
                    f"{folder} has no split {split}: its splits are {', '.join(parts)}. Name "
                    "cameras to score with data.test_cameras=[NAME], or leave data.eval_split out."
                )
        watched = _video_camera(cameras, parts, self.video_camera)
        recordings = [_recording(camera) for camera in cameras]
        numbers = _frame_numbers(folder, recordings, self.frames)
        stamped = _are_stamped(recordings)
        whole = _read_views(recordings, numbers, stamped, self.resolution, self.image_cache)

        def views_of(chosen: Sequence[int]) -> Views:
            count = len(numbers)
            return whole.subset([camera * count + i for camera in chosen for i in range(count)])

        chosen = self.thinned({split: views_of(parts[split]) for split in dict.fromkeys(splits)})
        return Scene(folder.resolve().name, chosen, video=views_of([watched]))


@dataclass(frozen=True)
class Camera:
    """A fixed camera and what it recorded.

    Attributes:
        name: Name of its video, or of its folder of images.
        source: The video or the folder.
        pose: Camera-to-world matrix with OpenGL's axes. float64 [4, 4]
        calibration: Its focal length, principal point and lens.
        label: The file and entry that calibrate it, for messages.
    """

    name: str
    source: Path
    pose: np.ndarray
    calibration: Calibration
    label: str


@dataclass(frozen=True)
class Recording:
    """The frames of a camera.

    Attributes:
        camera: The camera.
        size: Height and width of the frames.
        count: Number of frames.
        rate: Frames per second; None for images and if the video has none.
        images: The image files in the order of time; empty for a video. [count]
        times: Seconds at which a video shows its frames; empty where that is not known. [count]
    """

    camera: Camera
    size: Size
    count: int
    rate: float | None
    images: tuple[Path, ...] = ()
    times: tuple[float, ...] = ()

    @property
    def step(self) -> float:
        """Median seconds between frames; 0 where that is not known."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 0.0


def read_cameras(folder: Path) -> list[Camera]:
    """The calibrated cameras of a folder, in the order of its calibration.

    Raises:
        SceneError: If it has no calibration, or one that does not fit its videos and images.
    """
    if (folder / POSES).is_file():
        cameras = _from_poses_bounds(folder)
    elif (folder / TRANSFORMS).is_file():
        cameras = _from_transforms(folder)
    elif (model := find_model(folder)) is not None:
        cameras = _from_colmap(folder, model)
    else:
        found = ", ".join(sorted(path.name for path in folder.iterdir())[:8]) or "nothing"
        raise SceneError(
            f"{folder} holds neither {POSES} (Neural 3D Video) nor {TRANSFORMS} (a frame for each "
            f"camera) nor {MODELS[0]} (COLMAP's model of an image of each), but {found}. Add the "
            "calibration of the cameras."
        )
    names = [camera.name for camera in cameras]
    if twice := [name for name in names if names.count(name) > 1]:
        raise SceneError(
            f"{folder}: several cameras are called {twice[0]}. Name their videos or folders apart."
        )
    return cameras


def recordings_of_cameras(folder: Path) -> list[Path]:
    """Videos and folders of the names cam*, or else of numbers such as 00 or view_01, by name."""
    found = sorted(path for path in folder.glob("cam*") if _is_recording(path))
    numbered = [path for path in folder.iterdir() if NUMBERED.fullmatch(path.stem)]
    numbered.sort(key=lambda path: natural(path.name))
    return found or [path for path in numbered if _is_recording(path)]


def _is_recording(path: Path) -> bool:
    return path.is_dir() or path.suffix.lower() in videos.SUFFIXES


def _from_poses_bounds(folder: Path) -> list[Camera]:
    """Cameras of poses_bounds.npy, whose rows belong to the videos or folders cam* by name."""
    path = folder / POSES
    require_fetched(path)
    try:
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as problem:
        raise SceneError(
            f"{path} cannot be read as an array ({problem}). Export or download it again."
        ) from problem
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f":
        raise SceneError(
            f"{path} holds {rows.dtype} {list(rows.shape)}, not one row of 17 numbers for each "
            "camera: a pose of 3 rows and 5 columns, then the nearest and the farthest depth."
        )
    # A video may lie beside a folder of images made of it.
    sources = list({source.stem: source for source in recordings_of_cameras(folder)}.values())
    if len(sources) != len(rows):
        names = ", ".join(source.name for source in sources) or "none"
        raise SceneError(
            f"{path} has {len(rows)} cameras, but {folder} holds {len(sources)} (cam*, or numbers)"
            f": {names}. Add the videos that are missing, or take the others' rows out."
        )
    cameras = []
    for index, (source, row) in enumerate(zip(sources, rows, strict=True)):
        label = f"{path}: row {index} ({source.name})"
        matrix = row[:15].astype(np.float64).reshape(3, 5)
        down, right, back, centre, (height, width, focal) = matrix.T
        for key, value in (("height", height), ("width", width), ("focal length", focal)):
            if not is_positive(float(value)):
                raise SceneError(f"{label}: {key} is {value:g}; it must be above 0. Export again.")
        pose = np.eye(4)
        pose[:3] = np.stack([right, -down, back, centre], axis=1)
        pose = checked_pose(label, pose, "the pose")
        calibration = Calibration(fl_x=float(focal), w=float(width), h=float(height))
        cameras.append(Camera(source.stem, source, pose, calibration, label))
    return cameras


def _from_transforms(folder: Path) -> list[Camera]:
    """Cameras of transforms.json: a frame for each, or several with one pose."""
    path = folder / TRANSFORMS
    content = read_frames(path)
    cameras: dict[Path, Camera] = {}
    for index, frame in enumerate(content["frames"]):
        label = f"{path}: frame {index} ({frame['file_path']})"
        source = _source(label, folder.resolve(), frame["file_path"])
        pose = checked_pose(label, frame["transform_matrix"])
        if (other := cameras.get(source)) is not None:
            if np.abs(other.pose - pose).max() > SAME_POSE:
                raise SceneError(
                    f"{label} has another pose than {other.label}, but both lead to {source}, "
                    "and cameras must not move. Read a moving camera with data=nerfstudio."
                )
            continue
        calibration = read_calibration(str(path), content, label, frame)
        cameras[source] = Camera(source.stem, source, pose, calibration, label)
    return list(cameras.values())


def _from_colmap(folder: Path, place: Path) -> list[Camera]:
    """Cameras of a sparse model in which one image of each is registered."""
    model = read_model(place)
    require_precision(model.source, model.camera_to_world[:, :3, 3])
    sources: dict[str, list[Path]] = defaultdict(list)
    for path in sorted(folder.iterdir()):
        if _is_recording(path):
            sources[path.stem].append(path)
    # Other folders, such as images and sparse, need be no cameras.
    expected = {path for paths in sources.values() for path in paths if path.is_file()}
    expected = sorted(expected | set(recordings_of_cameras(folder)))

    def refused(problem: str, way_out: str) -> SceneError:
        return SceneError(
            f"{model.source}: {problem}. Registered images: {some(model.names)}. Videos, and "
            f"folders of the name cam*, in {folder}: "
            f"{some([path.name for path in expected]) or 'none'}. {way_out}"
        )

    cameras: dict[Path, Camera] = {}
    for name, pose, calibration in zip(
        model.names, model.camera_to_world, model.calibrations, strict=True
    ):
        image = PurePosixPath(name)
        found = [
            path
            for text in dict.fromkeys((image.stem, image.parent.name))
            # A video may lie beside a folder of images made of it.
            for path in [path for path in sources[text] if path.is_file()] or sources[text]
        ]
        if not found:
            raise refused(
                f"no video or folder belongs to {name}",
                "One image of each camera must have its name: cam00.png or cam00/0001.png is of "
                "cam00.mp4, or of the folder cam00.",
            )
        if len(found) > 1:
            raise refused(
                f"{name} may be of {' or of '.join(path.name for path in found)}",
                "Rename what it is not of, or move it elsewhere.",
            )
        (source,) = found
        label = f"{model.source}: {name}"
        if source in cameras:
            raise refused(
                f"{name} is of {source.name}, as an earlier image is",
                "Register one image of each camera, or read all images that are registered with "
                "data=colmap.",
            )
        cameras[source] = Camera(source.stem, source, pose, calibration, label)
    known = {camera.name for camera in cameras.values()}
    if bare := [path.name for path in expected if path.stem not in known]:
        raise refused(
            f"no registered image belongs to {some(bare)}",
            "Register an image of each camera, or move what is not calibrated elsewhere.",
        )
    return list(cameras.values())


def _source(label: str, folder: Path, name: Any) -> Path:
    """The video or the folder of images that a frame names."""
    for source in paths_inside(label, folder, name, "file_path", "cam00.mp4"):
        if source.is_dir() or (source.is_file() and source.suffix.lower() in videos.SUFFIXES):
            break
        if source.is_file() and source.parent != folder:
            return source.parent
    else:
        raise SceneError(
            f"{label}: {folder / name} is no video ({', '.join(videos.SUFFIXES)}), no folder "
            "of images and no image in a folder of the camera's own. Add it, or take the frame "
            "out of the list."
        )
    if source == folder:
        raise SceneError(f"{label}: file_path is the scene's folder, not that of one camera.")
    return source


def _split_cameras(
    folder: Path, cameras: Sequence[Camera], test_cameras: Sequence[str] | None
) -> dict[str, list[int]]:
    """Numbers of the cameras of each split."""
    names = [camera.name for camera in cameras]
    if test_cameras is None:
        chosen = "cam00" if "cam00" in names else names[int(_distances(cameras).argmin())]
        test_cameras = [chosen] if len(names) > 2 else []
        logger.info(
            "%s: held out %s of the cameras %s (data.test_cameras)",
            *(folder, ", ".join(test_cameras) or "none", ", ".join(names)),
        )
    for name in test_cameras:
        if name not in names:
            raise SceneError(
                f"data.test_cameras: {folder} has no camera {name}. Its cameras are "
                f"{', '.join(names)}."
            )
    test = [index for index, name in enumerate(names) if name in test_cameras]
    train = [index for index, name in enumerate(names) if name not in test_cameras]
    if not train:
        raise SceneError(
            f"data.test_cameras={list(test_cameras)} leaves no camera of {folder} to train on. "
            f"Its cameras are {', '.join(names)}: take one out of the list."
        )
    return {"train": train} | ({"test": test} if test else {})


def _distances(cameras: Sequence[Camera]) -> np.ndarray:
    """How far each camera is from the middle of all. [V]"""
    places = np.stack([camera.pose[:3, 3] for camera in cameras])
    return np.linalg.norm(places - places.mean(axis=0), axis=1)


def _video_camera(cameras: Sequence[Camera], parts: dict[str, list[int]], name: str | None) -> int:
    """Number of the camera whose video the LRM sees."""
    train = parts["train"]
    if name is None:
        away = _distances(cameras)
        return min(train, key=lambda index: away[index])
    found = [index for index, camera in enumerate(cameras) if camera.name == name]
    if not found:
        raise SceneError(
            f"data.video_camera={name}: there is no such camera. Name one of "
            f"{', '.join(cameras[index].name for index in train)}, or null for the most central."
        )
    if found[0] not in train:
        raise SceneError(
            f"data.video_camera={name} is one of data.test_cameras, whose frames are scored: the "
            "LRM must not see them. Name a training camera, or take it out of the test cameras."
        )
    return found[0]


def _recording(camera: Camera) -> Recording:
    """What a camera recorded, from headers alone."""
    if camera.source.is_file():
        video = videos.read_header(camera.source)
        rate = None if video.rate is None else float(video.rate)
        return Recording(camera, video.size, video.count, rate, times=video.times)
    images = _images_in(camera.source)
    if not images:
        raise SceneError(
            f"{camera.source} holds no images ({', '.join(ENDINGS)}), nor does a folder in it. Add "
            f"the frames of the camera, or take it out of the calibration ({camera.label})."
        )
    sizes = native_sizes(images)
    for path, size in zip(images, sizes, strict=True):
        if size != sizes[0]:
            raise SceneError(
                f"{path} has {size[1]}x{size[0]} pixels, but {images[0]} of the same camera has "
                f"{sizes[0][1]}x{sizes[0][0]}. Export its frames alike."
            )
    return Recording(camera, sizes[0], len(images), None, tuple(images))


def _images_in(folder: Path) -> list[Path]:
    """Images of a folder, or of the one in it, in the order of the numbers in their names."""
    inside = sorted(folder.iterdir(), key=lambda path: natural(path.name))
    if found := [path for path in inside if is_image(path)]:
        return found
    folders = [path for path in inside if path.is_dir() and path.name[0] != "."]
    named = [path for path in folders if path.name.lower() in IMAGES]
    folders = named if len(folders) > 1 else folders
    return _images_in(folders[0]) if len(folders) == 1 else []


def _are_stamped(recordings: Sequence[Recording]) -> bool:
    """Whether times are those of the files, as where the frames of a video are unevenly spaced.

    Elsewhere frames of one number are of one time. A warning tells of videos that begin at
    different times then.

    Raises:
        SceneError: If videos have different rates.
    """
    uneven = any(
        recording.step and np.diff(recording.times).max() > LATE * recording.step
        for recording in recordings
    )
    if uneven and all(recording.times for recording in recordings):
        return True
    timed = [
        (recording.camera.source, recording.rate) for recording in recordings if recording.rate
    ]
    for source, rate in timed:
        first, usual = timed[0]
        if abs(rate / usual - 1) > SAME_RATE:
            raise SceneError(
                f"{source} has {rate:g} frames per second, but {first} {usual:g}: frames of one "
                f"number are not of one time. Encode all videos at one rate: ffmpeg -i "
                f"{source.name} -r {usual:g} NEW.mp4"
            )
    begun = [(r.times[0], r.camera.source, r.step) for r in recordings if r.times]
    if begun:
        (early, first, step), (late, last, _) = min(begun), max(begun)
        if late - early > 0.5 * step > 0:
            warn(
                f"{last} begins {late - early:.3g} s after {first}: frames of one number are taken "
                "to be of one time. If they are not, cut the videos to one beginning."
            )
    return False


def _require_same_frames(recordings: Sequence[Recording]) -> None:
    """Refuse folders of numbered images where a camera lacks some in the middle.

    Its later frames would be paired with earlier ones of other cameras. Numbering may start
    anywhere, and some cameras may have stopped early.
    """
    first: tuple[Recording, list[int]] | None = None
    for recording in recordings:
        found = [re.findall(r"\d+", path.stem) for path in recording.images or ()]
        if not found or not all(found):
            continue
        numbers = [int(digits[-1]) - int(found[0][-1]) for digits in found]
        first = first or (recording, numbers)
        for place, (number, other) in enumerate(zip(numbers, first[1], strict=False)):
            if number != other:
                paths = [r.images[place] for r in (recording, first[0]) if r.images]
                raise SceneError(
                    f"{recording.camera.source}: image number {place + 1} is {paths[0].name}, but "
                    f"{paths[1].parent.name}/{paths[1].name} in {first[0].camera.name}. One of the "
                    "cameras lacks a frame before it, and frames must be of one time: add it, or "
                    "take the frame out of all cameras."
                )


def _frame_numbers(
    folder: Path, recordings: Sequence[Recording], frames: Sequence[int] | None
) -> range:
    """Numbers of the frames to read, which every camera has."""
    _require_same_frames(recordings)
    shortest = min(recordings, key=lambda recording: recording.count)
    longest = max(recordings, key=lambda recording: recording.count)
    if frames is not None:
        first, last, stride = frames
        if last >= shortest.count:
            raise SceneError(
                f"data.frames={list(frames)}, but {shortest.camera.source} has "
                f"{shortest.count} frames, the last of number {shortest.count - 1}. Set "
                f"data.frames=[{min(first, shortest.count - 1)},{shortest.count - 1},{stride}], or "
                "null."
            )
        return range(first, last + 1, stride)
    if shortest.count < longest.count:
        logger.warning(
            "%s: camera %s has %d frames, but %s %d: the first %d frames of every camera are used",
            *(folder, shortest.camera.name, shortest.count, longest.camera.name, longest.count),
            shortest.count,
        )
    return range(shortest.count)


def _read_views(
    recordings: Sequence[Recording],
    numbers: range,
    stamped: bool,
    resolution: int | None,
    cache: Path | None,
) -> Views:
    """All frames of all cameras, camera by camera."""
    count = len(numbers)
    native = [recording.size for recording in recordings]
    sources = [recording.camera.source for recording in recordings]
    sizes = final_sizes(sources, native, resolution)
    calibrations = [recording.camera.calibration for recording in recordings]
    refuse_all(list(filter(None, map(misshapen, sources, native, calibrations))))
    labels = [recording.camera.label for recording in recordings]
    intrinsics = final_intrinsics(labels, calibrations, native, sizes)
    has_ray = [intrinsics.has_ray(index) for index in range(len(recordings))]
    require_rays(labels, calibrations, has_ray)
    jobs = [
        _job(recording, numbers, sizes[index], has_ray[index], index * count)
        for index, recording in enumerate(recordings)
    ]
    images = [r.images[number] for r in recordings if r.images for number in numbers]
    names = [[recording.camera.name, bool(recording.images)] for recording in recordings]
    span = [numbers.start, numbers.stop, numbers.step]
    pixels = store.images(
        [size for size in sizes for _ in numbers],
        jobs,
        [source for source in sources if source.is_file()] + images,
        ["multicamera", names, span, digests(has_ray)],
        lambda: (
            any(shown is not None for shown in has_ray)
            or any(read_header(path)[1] for path in images)
        ),
        cache,
    )
    poses = torch.from_numpy(np.stack([recording.camera.pose for recording in recordings])).float()
    camera = torch.arange(len(recordings)).repeat_interleave(count)
    times = torch.linspace(0, 1, count) if count > 1 else torch.zeros(1)
    times = times.repeat(len(recordings))
    if stamped:
        seconds = [recording.times[number] for recording in recordings for number in numbers]
        times = torch.tensor(unit_times(seconds))
        logger.info("Frames of some videos are unevenly spaced: times are those of the files")
    return Views(
        pixels,
        poses[camera],
        times,
        intrinsics.subset(camera),
        tuple(
            f"{recording.camera.name}/{number:06d}"
            for recording in recordings
            for number in numbers
        ),
    )


def _job(
    recording: Recording, numbers: range, size: Size, shown: Tensor | None, place: int
) -> store.Job:
    """Decodes the frames of a camera, which are the images from number ``place`` on."""

    def decode() -> Iterator[tuple[int, np.ndarray]]:
        if recording.images:
            pictures = (read_image(recording.images[number], size) for number in numbers)
        else:
            video = videos.frames(recording.camera.source, numbers)
            pictures = (_reduced(frame, size) for frame in video)
        for offset, pixels in enumerate(pictures):
            yield place + offset, cleared(pixels, shown)

    return decode


def _reduced(frame: np.ndarray, size: Size) -> np.ndarray:
    """A video's frame in its final size. uint8 [h, w, 3] -> [H, W, 3 or 4]"""
    if frame.shape[:2] == size:
        return frame
    channels = np.full((4, *frame.shape[:2]), 255, np.float32)
    channels[:3] = frame.transpose(2, 0, 1)
    return shrink(channels, size[1], size[0])
