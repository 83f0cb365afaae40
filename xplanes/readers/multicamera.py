"""Synchronised videos, or folders of images, of several fixed cameras (`rigs`)."""

import logging
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from xplanes.errors import (
    BrokenFrameError,
    ConfigError,
    MissingSplitError,
    SceneError,
    refuse_all,
    some,
    warn,
)
from xplanes.files import natural
from xplanes.readers import videos
from xplanes.readers.capture import warn_of_masks
from xplanes.readers.entries import origin_near, unit_times, usable, world_turn
from xplanes.readers.formats import ENDINGS, read_header
from xplanes.readers.images import (
    Picture,
    Size,
    cleared,
    digests,
    final_sizes,
    shared_size,
    shrink,
)
from xplanes.readers.listing import final_intrinsics, misshapen
from xplanes.readers.name_times import (
    CAMERA,
    DATE,
    Number,
    most_different,
    times_of_clocks,
    timesteps_of,
)
from xplanes.readers.rigs import (
    POSES,
    Camera,
    are_registered,
    frames_in,
    is_calibrated,
    is_rig,
    read_cameras,
    recordings_of_rows,
)
from xplanes.readers.transforms import stated_up
from xplanes.scenes import store
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Scene, Views

logger = logging.getLogger(__name__)

MOST_DRIFT = 0.5
"""Largest drift between synchronised cameras until the shortest of them ends, in frames."""

SHORT = 0.5
"""Share of the usual number of frames below which a camera stopped early."""

NEAR = 0.3
"""A larger difference between times of images, in intervals, is one between timesteps."""

FIRST_CLOCK, LONG = 10**5, 10**8
"""Least whole numbers that may be of clocks rather than frames, and least seconds that are."""

LATE = 1.5
"""A longer gap between frames, relative to the median gap, indicates a variable frame rate."""


@dataclass(frozen=True, kw_only=True)
class MultiCameraSettings(SceneSettings):
    """Synchronised videos of several fixed cameras."""

    files: ClassVar = (
        "videos or folders cam00, cam01, ... with poses_bounds.npy, a model of COLMAP, a "
        "transforms.json with a frame of each, or EasyMocap's extri.yml"
    )

    frames: list[int] | None  # First frame, last frame and stride; null for all frames.
    # Names of held-out cameras, which are scored only. null: cam00, or else the most central one.
    test_cameras: list[str] | None
    video_camera: str | None  # Camera whose video the LRM is given; null: the most central one.
    # Rotate the world so that the cameras' mean up vector becomes its z axis. null: if that is more
    # than 60 degrees from it.
    orient: bool | None

    def check(self) -> None:
        super().check()
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
            return bool(recordings_of_rows(folder))
        return is_rig(folder) or are_registered(folder) or is_calibrated(folder)

    def load(self, splits: Sequence[str]) -> Scene:
        if self.train_on_video:
            raise SceneError(
                "data.train_on_video=true: the video's camera is one of the training cameras "
                "already; set it to false"
            )
        folder = self.folder
        if not folder.is_dir():
            raise self.no_scene()
        cameras, content = read_cameras(folder)
        found = usable("cameras", _recording, cameras)
        if self.frames is None:
            found = _without_short(folder, found, [*(self.test_cameras or ()), self.video_camera])
        cameras = [each.camera for each in found]
        parts = _split_cameras(folder, cameras, self.test_cameras)
        for split in splits:
            if split not in parts:
                raise MissingSplitError(
                    f"{folder} has no split {split}: its splits are {', '.join(parts)}. Name "
                    "cameras to score with data.test_cameras=[NAME], or leave data.eval_split out."
                )
        watched = _video_camera(cameras, parts, self.video_camera)
        seen = [path for each in found for path in each.images or [each.camera.source]]
        warn_of_masks(folder, seen, "put them into the alpha channel of the cameras' images")
        _warn_of_timesteps(folder, found)
        recordings = _simultaneous(found)
        poses = torch.from_numpy(np.stack([camera.pose for camera in cameras]))
        poses[:, :3, 3] -= torch.from_numpy(origin_near(folder, poses[:, :3, 3].numpy()))
        images = [image for recording in recordings for image in recording.images[:1]]
        shown = images if len(images) == len(poses) else ()
        turn, up = world_turn(poses, shown, *stated_up(content, self.orient))
        if turn is not None:
            poses[:, :3] = turn @ poses[:, :3]
        stamped = _are_stamped(recordings)
        numbers = _frame_numbers(folder, recordings, self.frames, stamped)
        times = [
            [recording.times[number] if stamped else number for number in own]
            for recording, own in zip(recordings, numbers, strict=True)
        ]
        whole, owner = _read_views(
            recordings, poses, numbers, times, self.resolution, self.image_cache
        )

        def views_of(chosen: Sequence[int]) -> Views:
            return whole.subset(torch.cat([(owner == camera).nonzero()[:, 0] for camera in chosen]))

        chosen = self.thinned({split: views_of(parts[split]) for split in dict.fromkeys(splits)})
        origin, unit = "the numbers of the frames", ""
        if stamped:
            kinds = ("when the videos show their frames", " s"), ("the numbers in their names", "")
            origin, unit = kinds[bool(images)]
        first, last = min(each[0] for each in times), max(each[-1] for each in times)
        notes = {"times": f"{origin}, from {first:.10g} to {last:.10g}{unit}", "up": up}
        return Scene(folder.resolve().name, chosen, video=views_of([watched]), notes=notes)


@dataclass(frozen=True)
class Recording:
    """The frames of a camera.

    Attributes:
        camera: The camera.
        size: Height and width of the frames.
        count: Number of frames.
        rate: Frames per second; None for images and if the video has none.
        times: Presentation times of a video's frames in seconds, or numbers of images; empty if
            unknown. [count]
        images: The image files in the order of time; empty for a video. [count]
    """

    camera: Camera
    size: Size
    count: int
    rate: float | None
    times: tuple[float, ...] = ()
    images: tuple[Path, ...] = ()

    @property
    def step(self) -> float:
        """Median seconds between frames; 0 if unknown."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 0.0


def _without_short(
    folder: Path, recordings: list[Recording], named: Sequence[str | None]
) -> list[Recording]:
    """Without cameras that stopped early, as only frames of all cameras are read.

    Args:
        folder: The scene's folder, for the warning.
        recordings: All cameras.
        named: Names of cameras that stay.
    """
    usual = float(np.median([recording.count for recording in recordings]))
    short = [r for r in recordings if r.count < SHORT * usual and r.camera.name not in named]
    if not short or len(recordings) - len(short) < 2:
        return recordings
    names = some([f"{recording.camera.name} ({recording.count})" for recording in short])
    warn(
        f"{folder}: {names} have fewer than {SHORT:.0%} of the {usual:g} frames of other cameras, "
        "and are left out. data.frames reads a range of the frames of all cameras."
    )
    lost = {recording.camera.name for recording in short}
    return [recording for recording in recordings if recording.camera.name not in lost]


def _split_cameras(
    folder: Path, cameras: Sequence[Camera], test_cameras: Sequence[str] | None
) -> dict[str, list[int]]:
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
    """Distance of each camera from the centre of all. [V]"""
    places = np.stack([camera.pose[:3, 3] for camera in cameras])
    return np.linalg.norm(places - places.mean(axis=0), axis=1)


def _video_camera(cameras: Sequence[Camera], parts: dict[str, list[int]], name: str | None) -> int:
    """Index of the camera whose video is the input of the LRM."""
    train = {cameras[index].name: index for index in parts["train"]}
    if name is None:
        away = _distances(cameras)
        return min(train.values(), key=lambda index: away[index])
    if name not in train:
        raise SceneError(
            f"data.video_camera={name} is not a training camera, and the LRM must not see frames "
            f"that are scored. Name one of {', '.join(train)}, or null for the most central."
        )
    return train[name]


def _recording(camera: Camera) -> Recording:
    """The frames of a camera, read from headers only."""
    if camera.source.is_file():
        return Recording(camera, *videos.read_header(camera.source))
    images = frames_in(camera.source)
    if not images:
        raise BrokenFrameError(
            f"{camera.source} holds no images ({', '.join(ENDINGS)}), nor does a folder in it, "
            "nor is there a single video. Add the frames of the camera, or take it out of the "
            f"calibration ({camera.label})."
        )
    first = f"{images[0]} of the same camera"
    size = shared_size(images, first, "Export its frames alike.")
    return Recording(camera, size, len(images), None, images=tuple(images))


def _warn_of_timesteps(folder: Path, recordings: Sequence[Recording]) -> None:
    """Warn if folders may be timesteps rather than cameras."""
    places = [(each.camera.source.name, path.name) for each in recordings for path in each.images]
    cameras = {match[0] for _, name in places if (match := CAMERA.search(name))}
    digits = [[len(re.sub(r"\D", "", part)) for part in place] for place in places]
    found = timesteps_of([*map("/".join, places)])
    several = len(places) > len(recordings)
    if found and several and (len(cameras) > 1 or all(outer > inner for outer, inner in digits)):
        warn(
            f"{folder}: the folders {some(found)} are taken for cameras, but may be timesteps with "
            f"an image of each camera, such as {'/'.join(places[0])}. If so, give each camera a "
            "folder of its images."
        )


def _are_stamped(recordings: Sequence[Recording]) -> bool:
    """Whether to use the recordings' times: if frame rates differ, or frames are unevenly spaced.

    Otherwise frames with the same number are simultaneous. Warns if videos begin at different
    times.

    Raises:
        SceneError: If rates differ and a recording has no times.
    """
    timed = sorted((r.rate, r.camera.source) for r in recordings if r.rate) or [(1.0, Path())]
    (slow, first), (fast, other) = timed[0], timed[-1]
    drifts = (fast / slow - 1) * min(recording.count for recording in recordings) > MOST_DRIFT
    uneven = any(
        recording.step and np.diff(recording.times).max() > LATE * recording.step
        for recording in recordings
    )
    stamped = (uneven or drifts) and all(recording.times for recording in recordings)
    if drifts and not stamped:
        raise SceneError(
            f"{other} has {fast:g} frames per second, but {first} {slow:g}, and not all cameras' "
            "files have times of their frames. Encode all videos at one rate: ffmpeg -i "
            f"{other.name} -r {slow:g} NEW.mp4"
        )
    begun = [(r.times[0], r.camera.source, r.step) for r in recordings if r.times]
    if begun:
        (early, first, step), (late, last, _) = min(begun), max(begun)
        if late - early > 0.5 * step > 0:
            what = "frames of equal number are taken to be simultaneous"
            warn(
                f"{last} begins {late - early:.3g} s after {first}: "
                f"{'these times are used' if stamped else what}. If that is wrong, trim the videos "
                "to a common start."
            )
    return stamped


def _simultaneous(recordings: Sequence[Recording]) -> list[Recording]:
    """The recordings, without images of timesteps that some cameras lack; warns about these images.

    Images of equal numbers are simultaneous; of clocks, which differ, those of the nearest ones.
    If the cameras' numbers do not overlap, they are counted from the first of each camera. Those of
    the first camera become the images' times, as all cameras may lack the same ones.

    Raises:
        SceneError: If images are missing, and other cameras have videos.
    """
    numbers = _numbers(recordings)
    each = list(numbers.values())
    if not each or any(len({*own}) < len(own) for own in each):
        return list(recordings)
    clocks = all(isinstance(own[0], float) or min(own) >= FIRST_CLOCK for own in each)
    if max(own[0] for own in each) > min(own[-1] for own in each):
        numbers = {camera: [n - own[0] for n in own] for camera, own in numbers.items()}
    folder = recordings[0].camera.source.parent
    partners, apart, step = _partners(list(numbers.values()), clocks)
    if not partners.size:
        pairs = [(camera, recordings[camera].images[0]) for camera in numbers]
        shown = some([f"{recordings[camera].camera.name}/{path.name}" for camera, path in pairs])
        raise SceneError(
            f"{folder}: no number is in the names of images of all cameras ({shown}), nor do those "
            f"of clocks differ by less than {NEAR:g} of the interval between images, so that none "
            "are simultaneous. Number simultaneous images alike."
        )
    chosen = [
        tuple(recordings[camera].images[place] for place in found)
        for camera, found in zip(numbers, partners, strict=True)
    ]
    lost = {
        f"{recordings[camera].camera.name}/{path.name}"
        for camera, kept in zip(numbers, chosen, strict=True)
        for path in {*recordings[camera].images} - {*kept}
    }
    if lost:
        text = (
            f"{folder}: frames must be simultaneous, but not all cameras have an image of the "
            f"numbers of {some(sorted(lost, key=natural))}{_counts(recordings)}"
        )
        if len(numbers) < len(recordings):
            raise SceneError(f"{text}. Add what is missing, or extract the images of all videos.")
        warn(f"{text}. {len(lost)} images are left out.")
    if apart > 1e-3 * step:  # Or else times are rounded.
        warn(
            f"{folder}: images of the nearest numbers are taken to be simultaneous, as those of "
            f"different cameras differ by up to {apart:.3g}, and those of one camera by "
            f"{step:.3g}. If they are not simultaneous, number those alike that are."
        )
    if len(numbers) < len(recordings):
        for camera, own in numbers.items():
            _warn_of_gaps(recordings[camera], own)
        return list(recordings)
    shared = tuple(next(iter(numbers.values()))[place] for place in partners[0])
    timed = isinstance(shared[0], float)  # Of clocks.
    times = [shared if timed or _are_series(images) else () for images in chosen]
    return [
        replace(recording, count=len(shared), images=images, times=own)
        for recording, images, own in zip(recordings, chosen, times, strict=True)
    ]


def _numbers(recordings: Sequence[Recording]) -> dict[int, list[Number]]:
    """Of each camera with images, their times, floats, if all have clocks; else whole numbers."""
    named = [(camera, each.images) for camera, each in enumerate(recordings) if each.images]
    times = {camera: times_of_clocks([path.name for path in own]) for camera, own in named}
    # Clocks run on; the numbers of a take and a frame, as in 1.998 and 1.999, are none.
    rising = all(own and all(one < other for one, other in pairwise(own)) for own in times.values())
    if rising and all(own[0] >= LONG or int(own[0]) < int(own[-1]) for own in times.values()):
        return times
    found = {camera: most_different([path.stem for path in own]) for camera, own in named}
    return {camera: numbers for camera, numbers in found.items() if numbers}


def _counts(recordings: Sequence[Recording]) -> str:
    """The cameras by their numbers of frames, in brackets; empty if all have the same."""
    cameras: dict[int, list[str]] = defaultdict(list)
    for recording in recordings:
        cameras[recording.count].append(recording.camera.name)
    each = "; ".join(f"{some(names)}: {count}" for count, names in sorted(cameras.items()))
    return f" ({each})" if len(cameras) > 1 else ""


def _partners(each: Sequence[Sequence[Number]], nearest: bool) -> tuple[np.ndarray, float, float]:
    """The images of all cameras that are simultaneous.

    Args:
        each: Numbers of each camera's images. [C]
        nearest: Whether numbers may differ, as those of clocks do.

    Returns:
        Indices of the images of each timestep, int64 [C, T]; the largest difference between their
        numbers; and the shortest of the cameras' median intervals.
    """
    # Subtracted before conversion to float, which cannot represent clocks in nanoseconds exactly.
    series = [np.array([number - each[0][0] for number in own], dtype=np.float64) for own in each]
    step = min(float(np.median(np.diff(np.sort(own)))) if len(own) > 1 else 1.0 for own in series)
    first, order = series[0], np.arange(len(series[0]))
    places = np.stack([_nearest(own, first) for own in series])
    found = np.stack([own[place] for own, place in zip(series, places, strict=True)])
    apart = np.ptp(found, axis=0)
    kept = (apart < NEAR * step) if nearest else (apart == 0)
    for own in found:
        kept &= _nearest(first, own) == order
    return places[:, kept], float(apart[kept].max(initial=0)), step


def _nearest(values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Index of the value that is nearest to each wanted one. [N]"""
    order = values.argsort()
    above = np.searchsorted(values, wanted, sorter=order)
    pair = np.stack([order[(above - 1).clip(0)], order[above.clip(max=len(values) - 1)]])
    return pair[np.abs(values[pair] - wanted).argmin(axis=0), np.arange(len(wanted))]


def _warn_of_gaps(recording: Recording, numbers: Sequence[Number]) -> None:
    """Warn about missing images of a camera beside others with videos."""
    steps = np.diff(np.array([number - numbers[0] for number in numbers], dtype=np.float64))
    if len(steps) and steps.max() > LATE * np.median(steps):
        before, after = recording.images[steps.argmax() :][:2]
        warn(
            f"{recording.camera.source}: numbers are missing between {before.name} and "
            f"{after.name}, but as other cameras have videos, images are taken for their frames in "
            "order. Add what is missing, or extract the images of all videos."
        )


def _are_series(images: Sequence[Path]) -> bool:
    """Whether names differ only in their last number, and it is no time of day."""
    names = {re.sub(r"\d+(?=\D*$)", "", path.stem) for path in images}
    return len(names) == 1 and not any(DATE.search(path.stem) for path in images)


def _frame_numbers(
    folder: Path, recordings: Sequence[Recording], frames: Sequence[int] | None, stamped: bool
) -> list[range]:
    """Numbers of each camera's frames to read: equal ones, unless time stamps are used."""
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
        return [range(first, last + 1, stride)] * len(recordings)
    if stamped:
        return [range(recording.count) for recording in recordings]
    if shortest.count < longest.count:
        warn(
            f"{folder}: cameras have different numbers of frames{_counts(recordings)}. The first "
            f"{shortest.count} of every camera are used, as if they were simultaneous. If they are "
            "not, trim the recordings to a common start."
        )
    return [range(shortest.count)] * len(recordings)


def _read_views(
    recordings: Sequence[Recording],
    poses: Tensor,
    numbers: Sequence[range],
    times: Sequence[Sequence[float]],
    resolution: int | None,
    cache: Path | None,
) -> tuple[Views, Tensor]:
    """All frames of all cameras, and the camera of each."""
    counts = torch.tensor([len(each) for each in numbers])
    camera = torch.arange(len(recordings)).repeat_interleave(counts)
    pairs = zip(recordings, numbers, strict=True)
    frames = [(recording, number) for recording, own in pairs for number in own]
    native = [recording.size for recording in recordings]
    sources = [recording.camera.source for recording in recordings]
    sizes = final_sizes(sources, native, resolution)
    calibrations = [recording.camera.calibration for recording in recordings]
    refuse_all(list(filter(None, map(misshapen, sources, native, calibrations))))
    labels = [recording.camera.label for recording in recordings]
    intrinsics = final_intrinsics(labels, calibrations, native, sizes)
    has_ray = [intrinsics.has_ray(index) for index in range(len(recordings))]
    firsts = (counts.cumsum(0) - counts).tolist()
    decoded = zip(recordings, numbers, sizes, has_ray, firsts, strict=True)
    jobs = [partial(_decoded, *arguments) for arguments in decoded]
    images = [recording.images[number] for recording, number in frames if recording.images]
    names = [[recording.camera.name, bool(recording.images)] for recording in recordings]
    span = [[own.start, own.stop, own.step] for own in numbers]
    is_partial = any(shown is not None for shown in has_ray)
    pixels = store.images(
        [sizes[index] for index in camera.tolist()],
        jobs,
        [source for source in sources if source.is_file()] + images,
        ["multicamera", names, span, digests(has_ray)],
        lambda: is_partial or any(read_header(path)[1] for path in images),
        cache,
    )
    views = Views(
        pixels,
        poses[camera].float(),
        torch.tensor(unit_times([time for own in times for time in own])),
        intrinsics.subset(camera),
        tuple(f"{recording.camera.name}/{number:06d}" for recording, number in frames),
    )
    return views, camera


def _decoded(
    recording: Recording, numbers: range, size: Size, shown: Tensor | None, first: int
) -> Iterator[tuple[int, np.ndarray]]:
    """The frames of a camera, decoded, and their indices, the first of which is given."""
    if recording.images:
        for place, number in enumerate(numbers, start=first):
            yield place, Picture(recording.images[number], size, has_ray=shown).decoded()
        return
    for place, frame in enumerate(videos.frames(recording.camera.source, numbers), start=first):
        pixels = frame
        if frame.shape[:2] != size:
            channels = np.full((4, *frame.shape[:2]), 255, np.float32)
            channels[:3] = frame.transpose(2, 0, 1)
            pixels = shrink(channels, size[1], size[0])
        yield place, cleared(pixels, shown)
