"""Reading and checking of transforms files: cameras and times as in transforms_train.json."""

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from xplanes.errors import BrokenFrameError, MissingSplitError, SceneError, warn
from xplanes.readers.entries import (
    checked_number,
    checked_pose,
    image_path,
    is_number,
    is_positive,
    number_in,
    read_object,
    short,
    spelt,
    unit_times,
    usable,
)
from xplanes.readers.formats import read_header
from xplanes.readers.listing import Calibration, Listing, time_source
from xplanes.readers.masks import Meaning
from xplanes.readers.name_times import times_in_names
from xplanes.readers.transforms_lenses import OTHER_LENSES, PIXELS, read_calibration
from xplanes.scenes.cameras import focal_length
from xplanes.scenes.lenses import COEFFICIENTS

logger = logging.getLogger(__name__)

OTHER_AXES = ("from_mitsuba", "normal_mts_args", "from_na")
"""Keys of instant-ngp and NeuS2 for poses with axes other than OpenGL's."""

TIMES = ("time", "timestamp", "timestep_index")
"""Keys of times; the first one that a frame has is used."""

NUMBERS = (
    *PIXELS,
    *COEFFICIENTS,
    *("sx1", "sy1", "omega", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "fovx", "fovy"),
    *TIMES,
)
"""Keys with numbers, which some programs write as strings."""

ALIASES = {"fx": "fl_x", "fy": "fl_y", "width": "w", "height": "h"}
"""Other names of keys in pixels."""

SQUARE = 0.01
"""Relative difference of focal lengths along x and y above which pixels are not square."""

MATRICES = ("intrinsic_matrix", "intrinsics", "K")
"""Keys of intrinsic matrices, of 3 rows and columns or more."""

TRANSPARENT = {"white_transparent": 255, "black_transparent": 0}
"""Keys of instant-ngp that declare a grey level transparent, with this level."""

FLAGS = ("is_fisheye", *TRANSPARENT)
"""Keys that are true or false."""

KNOWN = (
    *("frames", "file_path", "transform_matrix", "transform_matrix_start", "mask_path"),
    *("camera_model", "is_fisheye", "distortion_params", "orientation_override", "up"),
    *("n_frames", "sharpness_discard_threshold"),
    *("train_filenames", "val_filenames", "test_filenames"),
    *(*NUMBERS, *OTHER_LENSES, *OTHER_AXES, *TRANSPARENT),
)
"""Keys that are read, or refused."""

IGNORED = (
    *("aabb", "aabb_scale", "offset", "scale", "applied_transform", "applied_scale"),
    *("auto_scale_poses_override", "ply_file_path", "sharpness"),
    *("n_extra_learnable_dims", "importance_sampling", "enable_ray_loading", "fix_premult"),
    *("colmap_im_id", "colmap_image_id", "camera_id", "cam_id", "component_id", "id", "name"),
    *("depth_file_path", "depth_path", "integer_depth_scale", "enable_depth_loading"),
    *("depth_integer_scale", "depth_source", "depth_unit_scale_factor", "normal_file_path"),
    *("rotation", "render_aabb", "path"),
    *("crop_width", "crop_height", "blur_score", "n_images", "fps", "num_frames"),
    *("camera", "camera_label", "camera_name", "cam_name", "camera_index", "camera_indices"),
    *("timestep_id", "timestep_indices", "timestep_index_original", "flame_param_path"),
)
"""Keys of other programs without effect here."""

TIMELESS = (
    'Give every frame a "time", rename the images by their times, or, for a static scene, set '
    "data.static=true."
)
"""How to give other times than the numbers in names."""

BESIDE: dict[Meaning, list[str]] = {
    "ignore": ["dynamic_mask_{stem}.png"],
    "alpha": ["{stem}.alpha{suffix}", "{stem}{suffix}.alpha{suffix}"],
}
"""Names of mask files beside an image, by their meaning."""

Masks = tuple[list[Path | None], Meaning | None]
"""A mask file for each image, or none, and their meaning if the source defines it."""


def readable(paths: Sequence[Path]) -> dict[Path, dict[str, Any]]:
    """Contents of those of several transforms files that `read_frames` can read."""
    found = {}
    for path in paths:
        with suppress(SceneError):
            found[path] = read_frames(path)
    return found


def time_span(contents: Iterable[Mapping[str, Any]]) -> tuple[float, float] | None:
    """First and last time in several transforms files; None if no frame has a time."""
    entries = [entry for content in contents for entry in content["frames"]]
    times = [entry[key] for entry in entries if is_number(entry.get(key := _time_key([entry])))]
    return (min(times), max(times)) if times else None


def numbers(contents: Mapping[Path, Mapping[str, Any]]) -> dict[str, float]:
    """The numbers in the names of all images of several transforms files, by their ``file_path``.

    Images that are missing do not count: programs list cameras that were never rendered. Empty if
    a frame has a time, or if names have no number that varies.

    Args:
        contents: Result of `readable`.
    """
    images: dict[str, str] = {}
    for path, content in contents.items():
        folder = path.parent.resolve()
        for entry in content["frames"]:
            with suppress(SceneError):
                image = _files_of("", folder, content, entry)[0]
                images[entry["file_path"]] = image.relative_to(folder).as_posix()
    if not images or time_span(contents.values()) is not None:
        return {}
    found = times_in_names([*images.values()], dynamic=True, advice=TIMELESS)
    return dict(zip(images, found, strict=True)) if found else {}


def all_masks(contents: Mapping[Path, Mapping[str, Any]]) -> Masks:
    """``masks`` and ``mask_meaning``, as of `Listing`, of the usable images in several files."""
    masks, meaning = [], None
    for path, content in contents.items():
        pairs = []
        for entry in content["frames"]:
            with suppress(SceneError):
                pairs.append(_files_of("", path.parent.resolve(), content, entry)[:2])
        found, told = _masks(pairs)
        masks, meaning = masks + found, meaning or told
    return masks, meaning


def listing_of(
    path: Path,
    content: Mapping[str, Any],
    span: tuple[float, float] | None = None,
    *,
    movable: bool = True,
    numbered: Mapping[str, float] | None = None,
) -> Listing:
    """The frames of a transforms file, checked.

    Times in any unit are mapped to [0, 1], unless their key is "time" and they are in that range.

    Args:
        path: The file.
        content: Result of `read_frames`.
        span: First and last time of the scene, if it has several files; those of this one when
            None.
        movable: As for `Listing.checked`: false if the scene has several files.
        numbered: Result of `numbers`, if these are the times of a scene that has no others.

    Raises:
        SceneError: If anything is missing, out of range, repeated, or outside the scene's folder.
    """
    folder = path.parent.resolve()
    frames = _usable(path, content, folder)
    paths = [frame.image for frame in frames]
    masks, meaning = _masks([(frame.image, frame.mask) for frame in frames])
    times, source = _times(path, frames, span)
    names = [frame.entry["file_path"] for frame in frames]
    if numbered and not times:
        found = [numbered[name] for name in names]
        times = unit_times(found, (min(numbered.values()), max(numbered.values())))
        source = time_source("the numbers in their names", names, found)
    if content.get("enable_ray_loading", True):
        _warn_of_rays(path, paths)
    listing = Listing.checked(
        path,
        [frame.label for frame in frames],
        paths,
        np.stack([frame.pose for frame in frames]),
        times,
        movable,
        files=tuple(image.relative_to(folder).as_posix() for image in paths),
        calibrations=_calibrations(path, content, frames),
        masks=tuple(masks) if any(masks) else (),
        mask_meaning=meaning,
        clear=tuple(level for key, level in TRANSPARENT.items() if content.get(key)),
        time_source=source,
        names=tuple(names),
    )
    warn_of_unknown(path, content)
    return listing


class _Frame(NamedTuple):
    """A usable frame: its label for messages, its entry, and the content of the entry."""

    label: str
    entry: dict[str, Any]
    image: Path
    mask: Path | None
    pose: np.ndarray


def _usable(path: Path, content: Mapping[str, Any], folder: Path) -> list[_Frame]:
    """Frames, but for repeated ones and those without image, finite pose, or time if most have."""
    entries = content["frames"]
    key = _time_key(entries)
    timed = sum(entry.get(key) is not None for entry in entries)
    smaller: list[Path] = []
    listed: dict[str, int] = {}

    def read(item: tuple[int, dict[str, Any]]) -> _Frame:
        index, entry = item
        label = f"{path}: frame {index} ({entry['file_path']})"
        first = listed.setdefault(str(entry["file_path"]), index)
        if first < index and entry == entries[first]:
            raise BrokenFrameError(f"{label} is listed before, as frame {first}.")
        image, mask, is_smaller = _files_of(label, folder, content, entry)
        if is_smaller:
            smaller.append(image)
        pose = checked_pose(label, entry["transform_matrix"])
        if timed and entry.get(key) is None:
            problem = SceneError if 2 * timed <= len(entries) else BrokenFrameError
            raise problem(
                f'{label} has no "{key}", but {timed} of {len(entries)} frames of {path.name} do. '
                "Give every frame a time, or none for a static scene."
            )
        return _Frame(label, entry, image, mask, pose)

    frames = usable("frames", read, [*enumerate(entries)])
    if smaller:
        warn(
            f"{path}: {len(smaller)} of {len(entries)} images are missing and read from smaller "
            f"copies, such as {smaller[0]}."
        )
    _warn_of_selection(path, content)
    return frames


def _files_of(
    label: str, folder: Path, content: Mapping[str, Any], entry: Mapping[str, Any]
) -> tuple[Path, Path | None, bool]:
    """Image and mask of a frame, and whether the image is a smaller copy of a missing one."""
    sized, wanted = (entry.get(key) or content.get(key) for key in ("w", "mask_path"))
    name, factors = entry["file_path"], []
    try:
        image = image_path(label, folder, name)
    except BrokenFrameError:
        # Without a size, focal lengths would be wrong.
        found = _copy(label, folder, name, (2, 4, 8)) if sized else None
        if found is None:
            raise
        image, *factors = found
    mask = None
    if wanted:
        found = _copy(label, folder, wanted, factors, "mask_path")
        mask = found[0] if found else image_path(label, folder, wanted, "mask_path")
    if mask == image:
        raise BrokenFrameError(f"{label}: there is no mask of the name that mask_path gives.")
    return image, mask, bool(factors)


def _copy(
    label: str, folder: Path, name: Any, factors: Sequence[int], key: str = "file_path"
) -> tuple[Path, int] | None:
    """The first of nerfstudio's smaller copies of a file, as in images_2, and its factor."""
    wanted = PurePosixPath(spelt(name))
    for factor in factors if wanted.parent.name else ():
        with suppress(BrokenFrameError):
            place = f"{wanted.parent}_{factor}"
            copy = image_path(label, folder, f"{place}/{wanted.name}", key)
            if copy.parent.name.lower() == PurePosixPath(place).name.lower():
                return copy, factor
    return None


def _warn_of_selection(path: Path, content: Mapping[str, Any]) -> None:
    """Warn if instant-ngp would leave out frames of the file."""
    count, frames = content.get("n_frames"), len(content["frames"])
    if is_positive(count) and count < frames:
        warn(
            f"{path}: n_frames={count:g} makes instant-ngp read the first {count:g} of {frames} "
            "frames in the order of their names; all are read here. Take the others out of the "
            "list to leave them out."
        )
    if is_positive(least := content.get("sharpness_discard_threshold")):
        warn(
            f"{path}: sharpness_discard_threshold={least:g} makes instant-ngp leave out blurred "
            "frames; all are read here. Take them out of the list to leave them out."
        )


def _masks(pairs: Sequence[tuple[Path, Path | None]]) -> Masks:
    """Masks of images, or else those beside them with instant-ngp's names, and their meaning."""
    if any(mask for _, mask in pairs):
        return [mask for _, mask in pairs], None
    for meaning, patterns in BESIDE.items():
        found = [
            next((mask for name in names if (mask := path.with_name(name)).is_file()), None)
            for path, _ in pairs
            if (names := [p.format(stem=path.stem, suffix=path.suffix) for p in patterns])
        ]
        if any(found):
            return found, meaning
    return [], None


def _warn_of_rays(path: Path, images: Sequence[Path]) -> None:
    """Warn if instant-ngp's files of rays, which replace the camera there, lie beside images."""
    names = [image.with_name(f"rays_{image.stem}.dat") for image in images]
    if given := [name for name in names if name.is_file()]:
        warn(
            f"{path}: the rays in files beside {len(given)} of {len(images)} images, such as "
            f"{given[0]}, are not read: rays follow the poses and lenses of {path.name}. If these "
            "do not describe the cameras, undistort the images; if they do, set "
            "enable_ray_loading to false."
        )


def _calibrations(
    path: Path, content: Mapping[str, Any], frames: Sequence[_Frame]
) -> tuple[Calibration, ...]:
    """The cameras of all frames; warns about pixels that are not square. [V]"""
    stated = [read_calibration(str(path), content, frame.label, frame.entry) for frame in frames]
    found = tuple(
        _with_height(camera, {**content, **frame.entry}, frame.image)
        for camera, frame in zip(stated, frames, strict=True)
    )
    if stretched := sum(new != old for new, old in zip(found, stated, strict=True)):
        given = {*content, *(key for frame in frames for key in frame.entry)}
        key = next((key for key in ("y_fov", "fovy") if key in given), "camera_angle_y")
        warn(
            f"{path}: {key} of {stretched} of {len(found)} frames gives "
            "pixels that are not square, and is used. If they are square, remove it: Blender's own "
            "angle_y belongs to the sensor, not to the image."
        )
    _warn_of_two_focal_lengths(path, content, frames, found)
    return found


def _warn_of_two_focal_lengths(
    path: Path,
    content: Mapping[str, Any],
    frames: Sequence[_Frame],
    cameras: Sequence[Calibration],
) -> None:
    """Warn if fields of view contradict focal lengths in pixels, which take precedence."""
    for frame, camera in zip(frames, cameras, strict=True):
        # The angle along y is often that of the sensor, which is higher than a landscape image.
        for axis, side in (("x", camera.w), ("y", camera.h)):
            keys = frame.entry if {"fl_x", f"fl_{axis}"} & {*frame.entry} else content
            angle, focal = keys.get(f"camera_angle_{axis}"), getattr(camera, f"fl_{axis}")
            if not (side and focal and is_positive(angle) and angle < math.pi):
                continue
            other = focal_length(angle, side)
            counts = axis == "x" or side > (camera.w or math.inf)
            if counts and abs(other / focal - 1) > SQUARE and f"fl_{axis}" in keys:
                warn(
                    f"{frame.label}: fl_{axis}={focal:g} is used, but camera_angle_{axis} "
                    f"means {other:.4g} pixels. Compare both with the camera: BlenderNeRF computes "
                    "fl_x and fl_y of portrait images from the wrong side of the sensor. Remove "
                    "the wrong keys."
                )
                return


def _with_height(camera: Calibration, keys: Mapping[str, Any], image: Path) -> Calibration:
    """The camera, with non-square pixels if its two fields of view imply them."""
    angle = keys.get("camera_angle_y")
    if camera.fl_y is not None or not is_positive(angle) or angle >= math.pi:
        return camera
    (height, width), _ = read_header(image)
    (across, _), _, _ = camera.scaled((height, width), (height, width))
    down = focal_length(angle, height)
    if abs(down / across - 1) < SQUARE:
        return camera
    # In pixels of the image size to which principal points refer.
    wide = camera.w or width * (camera.h or height) / height
    high = camera.h or height * wide / width
    sides = {"fl_x": across * wide / width, "fl_y": down * high / height, "w": wide, "h": high}
    return replace(camera, per_width=None, **sides)


def warn_of_unknown(path: Path, content: Mapping[str, Any], unread: Sequence[str] = ()) -> None:
    """Warn about unknown and unread keys, which may affect images or cameras."""
    items = [item for each in (content, *content["frames"]) for item in each.items()]
    # Zeros in a colour mean black.
    given = {key for key, value in items if _has_content(value) or "color" in key}
    if unknown := sorted(given - ({*KNOWN, *IGNORED} - {*unread})):
        other = " data=nerfstudio reads times, masks and splits." if {*unread} & {*unknown} else ""
        warn(
            f"{path}: keys that are not read are {', '.join(map(short, unknown))}. If one of them "
            f"affects the images or cameras, convert these and remove the key.{other}"
        )


def _has_content(value: Any) -> bool:
    """Whether a value is not null, false, zero or empty, nor a list of such."""
    return any(map(_has_content, value)) if isinstance(value, list) else bool(value)


def _standard(path: Path, keys: dict[str, Any]) -> dict[str, Any]:
    """The keys in standard form: strings as values, and alternative intrinsics by standard keys."""
    found = dict(keys)
    for key in {*ALIASES} & {*keys}:
        if is_positive(number_in(str(keys[key]))):
            found.setdefault(ALIASES[key], found.pop(key))
    if "fg_mask_path" in found:
        found.setdefault("mask_path", found.pop("fg_mask_path"))
    for key in {*NUMBERS} & {*found}:
        if isinstance(found[key], str) and (number := number_in(found[key])) is not None:
            found[key] = number
    for key in {*FLAGS} & {*found}:
        if isinstance(found[key], str) and found[key].lower() in ("true", "false"):
            found[key] = found[key].lower() == "true"
    for key in {*MATRICES} & {*keys}:
        with suppress(TypeError, ValueError, LookupError):
            matrix = np.array(keys[key], dtype=np.float64)
            matrix = matrix.reshape(3, 3) if matrix.size == 9 else matrix.reshape(-1, 4)
            (fl_x, _, cx), (_, fl_y, cy) = matrix[:2, :3].tolist()
            found = {"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy} | found
            del found[key]  # Other values get the warning about unknown keys.
    # instant-ngp's x_fov precedes focal lengths; it and its converter's fovx are in degrees.
    for axis in "xy":
        angle, name = found.get(f"{axis}_fov"), f"camera_angle_{axis}"
        if is_positive(angle):
            found[name] = math.radians(angle)
            found.pop(f"fl_{axis}", None)
        elif is_positive(angle := found.get(f"fov{axis}")) and angle > math.pi:
            found.setdefault(name, math.radians(angle))
        if is_number(found.get(name)) and math.pi < found[name] < 180:
            warn(
                f"{path}: {name}={found[name]:g} is read in degrees, as it is above pi: radians "
                "are expected."
            )
            found[name] = math.radians(found[name])
    return found


def read_frames(path: Path) -> dict[str, Any]:
    """The content of a transforms file, whose frames have file names and poses.

    Raises:
        SceneError: If it is not such a file.
    """
    content = read_object(path, '"frames"')
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise MissingSplitError(
            f'{path} lists no frames: "frames" is {short(frames)}, not a list of at least one.'
        )
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise SceneError(f"{path}: frame {index} is {short(frame)}, not an object with keys.")
        if "transform_matrix_start" in frame:  # The camera moves during exposure.
            frame.setdefault("transform_matrix", frame["transform_matrix_start"])
        frame.setdefault("transform_matrix", None)
        if "file_path" not in frame:
            raise SceneError(
                f'{path}: frame {index} has no "file_path". Every frame needs file_path and '
                "transform_matrix, and time in a dynamic scene."
            )
    for key in OTHER_AXES:
        if content.get(key):
            raise SceneError(
                f"{path}: {key}={short(content[key])} stands for poses with other axes than "
                "OpenGL's (x right, y up, z backward). Convert transform_matrix, and remove the "
                "key."
            )
    frames = [_standard(path, each) for each in frames]
    for key in TIMES:
        timed = [frame for frame in frames if frame.get(key) is not None]
        with suppress(TypeError, ValueError):  # If one has a number, or other text.
            dates = [datetime.fromisoformat(frame[key]) for frame in timed]
            for frame, date in zip(timed, dates, strict=True):
                frame[key] = (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    return _standard(path, content) | {"frames": frames}


def stated_up(content: Mapping[str, Any], orient: bool | None) -> tuple[bool | None, Tensor | None]:
    """What a file says of its world's axes.

    Args:
        content: Result of `read_frames`.
        orient: The setting ``data.orient``.

    Returns:
        The setting, false if it is null and nerfstudio's orientation_override is none; and
        instant-ngp's up vector, of length 1, float64 [3], or None if there is none.
    """
    if orient is None and content.get("orientation_override") == "none":
        orient = False
    with suppress(TypeError, ValueError, RuntimeError):
        up = torch.tensor(content.get("up"), dtype=torch.float64)
        if up.shape == (3,) and 0 < float(up.norm()) < math.inf:
            return orient, up / up.norm()
    return orient, None


def _time_key(entries: Sequence[Mapping[str, Any]]) -> str:
    given = (key for key in TIMES if any(entry.get(key) is not None for entry in entries))
    return next(given, TIMES[0])


def _times(
    path: Path, frames: Sequence[_Frame], span: tuple[float, float] | None
) -> tuple[list[float], str]:
    """Times of all frames, and their source; empty if no frame has a time."""
    key = _time_key([frame.entry for frame in frames])
    if frames[0].entry.get(key) is None:
        return [], ""
    times = [checked_number(f.label, key, f.entry[key], more=", or all dates") for f in frames]
    names = [frame.entry["file_path"] for frame in frames]
    source = time_source(f'"{key}" of {path.name}', names, times)
    first, last = span or (min(times), max(times))
    if key == "time" and first >= 0 and last <= 1:
        return [float(time) for time in times], source
    words = f"{path}: {key} from {first} to {last} is mapped to times from 0 to 1"
    if span:
        warn(f"{words}: in this format it lies in that range.")
    else:
        logger.info(words)
    return unit_times(times, (first, last)), source
