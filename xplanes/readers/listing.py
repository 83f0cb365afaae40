"""Lists of images with poses and times, and their conversion to views."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from xplanes.errors import MissingSplitError, SceneError, refuse_all, some, warn
from xplanes.readers.entries import origin_near
from xplanes.readers.formats import UNTURN, mask_misfit, orientation
from xplanes.readers.images import GREY, Picture, Size, final_sizes, native_sizes, read_images
from xplanes.readers.masks import MaskKind, Meaning, ignored_pixels
from xplanes.scenes.lenses import COEFFICIENTS, Lenses, LensModel
from xplanes.scenes.source import held_out_places
from xplanes.scenes.views import Intrinsics, Views, spread

SHORTEST, LONGEST = 0.02, 1e5
"""Smallest and largest focal length, relative to the image size."""

ASIDE = 0.25
"""Larger offsets of a principal point from the middle, relative to the image size, are doubtful."""

FARTHEST_ASIDE, STRONGEST = 1e3, 1e6
"""Largest offset of a principal point, relative to the image size, and largest coefficient."""

MOST_FOLDED = 0.5
"""Largest share of an image's pixels without a ray, for perspective lenses."""

SHAPE_TOLERANCE = 0.02
"""Tolerance between the aspect ratios of an image and its camera."""


@dataclass(frozen=True)
class Calibration:
    """The calibration of one image's camera, as in its file.

    Attributes:
        per_width: Focal length in image widths; None if ``fl_x`` is given.
        fl_x: Focal length along x in pixels of an image of ``w`` x ``h``.
        fl_y: Focal length along y; None for square pixels.
        cx: Principal point, from the left; None for the middle.
        cy: Principal point, from the top; None for the middle.
        w: Width of the image to which these numbers refer; None for that of the image file.
        h: Its height.
        model: Kind of lens.
        distortion: Coefficients by their names in `COEFFICIENTS`; others are 0.
        skew: Shift to the right in pixels per focal length downwards.
    """

    per_width: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: float | None = None
    h: float | None = None
    model: LensModel = LensModel.PERSPECTIVE
    distortion: Mapping[str, float] = field(default_factory=dict)
    skew: float = 0.0

    def scaled(
        self, native: Size, size: Size
    ) -> tuple[tuple[float, float], tuple[float, float], float]:
        """Focal lengths, principal point and skew of the image in its final size.

        Args:
            native: Height and width of the image file.
            size: Its final height and width.
        """
        (rows, columns), (height, width) = native, size
        # If the calibration is for another image size, only one side may be given.
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
        return (focal_x, focal_y), (centre_x, centre_y), self.skew / wide * width

    @property
    def description(self) -> str:
        """Description of the lens, for messages."""
        named = [
            f"{'omega' if self.model == LensModel.FOV else name}={value:g}"
            for name in COEFFICIENTS
            if (value := self.distortion.get(name))
        ]
        return f"{self.model.name.lower()} lens with {', '.join(named) or 'no distortion'}"


@dataclass(frozen=True)
class Listing:
    """The images of one split, or of a whole capture, before they are read.

    Attributes:
        paths: Image files. [V]
        files: Their names in tables and messages, relative to the scene's folder. [V]
        camera_to_world: Rigid camera poses with OpenGL's axes. [V, 4, 4]
        times: Time of each image, from 0 to 1; all 0 for a static scene. [V]
        calibrations: Focal length, principal point and lens of each image. [V]
        masks: A mask file for each image, white where it shows the scene and black elsewhere, or
            None for an image without; empty if there are none. [V]
        mask_meaning: Meaning of masks as defined by the source; None if it does not define it.
        clear: Grey levels, out of 255, that are transparent in its images.
        time_source: Source of the times, with examples; empty if there are no times.
        names: Their names in the file of the cameras; empty if nothing else refers to them. [V]
        origin: Origin of the poses in the files' world.
    """

    paths: tuple[Path, ...]
    files: tuple[str, ...]
    camera_to_world: Tensor
    times: Tensor
    calibrations: tuple[Calibration, ...]
    masks: tuple[Path | None, ...] = ()
    mask_meaning: Meaning | None = None
    clear: tuple[int, ...] = ()
    time_source: str = ""
    names: tuple[str, ...] = ()
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __len__(self) -> int:
        return len(self.files)

    @classmethod
    def checked(
        cls,
        source: Path,
        labels: Sequence[str],
        paths: Sequence[Path],
        poses: np.ndarray,
        times: Sequence[float],
        movable: bool = True,
        **more: Any,
    ) -> "Listing":
        """A list of images that has passed the checks common to all formats.

        Warns about images without a mask among others that have one.

        Args:
            source: File of the cameras, for messages.
            labels: The file and frame of each image, for messages. [V]
            paths: Image files. [V]
            poses: Camera-to-world matrices with OpenGL's axes. float64 [V, 4, 4]
            times: From 0 to 1; empty for a static scene. [V]
            movable: Whether the poses may get another origin, if the files' is too far away.
            **more: Further attributes.

        Raises:
            SceneError: If cameras are too far away, an image is listed twice, or the sizes of files
                and calibrations do not match.
        """
        origin, poses = origin_near(source, poses[:, :3, 3], movable), poses.copy()
        poses[:, :3, 3] -= origin
        _refuse_repeats(labels, paths, poses, times)
        listing = cls(
            paths=tuple(paths),
            camera_to_world=torch.from_numpy(poses).float(),
            times=torch.tensor(times or [0.0] * len(paths), dtype=torch.float32),
            origin=tuple(origin.tolist()),
            **more,
        )
        _require_shapes(listing)
        bare = [
            file for file, mask in zip(listing.files, listing.masks, strict=False) if mask is None
        ]
        if bare:
            warn(
                f"{source}: there is no mask of {len(bare)} of {len(listing)} images, which are "
                f"shown whole: {some(bare)}."
            )
        return listing

    def turned(self, turn: Tensor) -> "Listing":
        """The listing in a rotated world. float64 [3, 3]"""
        poses = self.camera_to_world.double()
        poses[:, :3] = turn @ poses[:, :3]
        return replace(self, camera_to_world=poses.float())

    def subset(self, indices: Sequence[int]) -> "Listing":
        """The images at ``indices``, in that order. [K]"""
        chosen = list(indices)
        lists = ("paths", "files", "names", "calibrations", "masks")
        each = {name: getattr(self, name) for name in lists}
        kept = {name: tuple(part[i] for i in chosen) for name, part in each.items() if part}
        poses, times = self.camera_to_world[chosen], self.times[chosen]
        return replace(self, camera_to_world=poses, times=times, **kept)


def time_source(origin: str, files: Sequence[str], times: Sequence[Any]) -> str:
    """Description of the times' source, with examples.

    Args:
        origin: The source.
        files: Names of the images. [V]
        times: Their times as given. [V]
    """
    low, high = min(times), max(times)
    # Six digits of what differs, as clocks count from 1970.
    largest = max(abs(low), abs(high))
    digits = min(17, 6 + int(math.log10(largest / (high - low)))) if high > low else 6
    first, last, *known = (
        f"{time:.{digits}g}" if isinstance(time, float) else str(time)
        for time in (low, high, *times)
    )
    shown = dict.fromkeys(spread(min(len(files), 3), len(files)))
    examples = ", ".join(f"{files[rank]} -> {known[rank]}" for rank in shown)
    return f"{origin}, from {first} to {last}: {examples}"


def held_out(listing: Listing, every: int) -> dict[str, list[int]]:
    """Indices of the training images, and of those held out as val.

    One image in ``every`` is held out, in order of time and file name; never the first or last.
    """
    times = listing.times.tolist()
    order = sorted(range(len(listing)), key=lambda index: (times[index], listing.files[index]))
    places = held_out_places(sorted(times), every)
    chosen = {order[place] for place in places if 0 < place < len(order) - 1}
    return {
        "train": [index for index in range(len(listing)) if index not in chosen],
        "val": sorted(chosen),
    }


def read_views(
    listing: Listing,
    resolution: int | None,
    cache: Path | None = None,
    ignore: bool = False,
    kind: MaskKind = GREY,
) -> Views:
    """Read the images of a listing, with their masks, and reduce them to a width.

    Pixels to which a lens maps no direction, such as those outside a fisheye's image circle, get
    alpha 0 and no rays.

    Args:
        listing: At least one image.
        resolution: Width in pixels; None keeps the sizes of the files.
        cache: Folder of images that are too large for memory; the user's cache when None.
        ignore: Whether masked-out pixels are ignored; otherwise they get alpha 0. Images with only
            ignored pixels are left out, with a warning.
        kind: Meaning of the masks.

    Raises:
        MissingSplitError: If all pixels of all images are masked out.
        SceneError: If a file cannot be decoded, the resolution cannot be met, or
            `final_intrinsics` refuses a camera.
    """
    ignored = None
    native = native_sizes(listing.paths)
    sizes = final_sizes(listing.paths, native, resolution)
    if ignore and any(listing.masks):
        ignored = ignored_pixels(listing.masks, listing.paths, sizes, kind)
        rest = [i for i, size in enumerate(sizes) if not ignored[i, : size[0], : size[1]].all()]
        if len(rest) < len(listing):
            listing, ignored = _without_ignored(listing, rest), ignored[rest]
            native, sizes = ([each[i] for i in rest] for each in (native, sizes))
    names = [str(path) for path in listing.paths]
    intrinsics = final_intrinsics(names, listing.calibrations, native, sizes)
    has_ray = [intrinsics.has_ray(index) for index in range(len(listing))]
    masks = [None] * len(listing) if ignore or not listing.masks else listing.masks
    pictures = [
        Picture(path, size, mask, kind, listing.clear, shown)
        for path, size, mask, shown in zip(listing.paths, sizes, masks, has_ray, strict=True)
    ]
    images = read_images(pictures, cache)
    if ignored is not None:
        ignored = ignored[:, : images.shape[1], : images.shape[2]]
    views = Views(
        images, listing.camera_to_world, listing.times, intrinsics, listing.files, ignored=ignored
    )
    empty = [file for index, file in enumerate(views.files) if not views.silhouette(index).any()]
    if empty:
        warn(
            f"{len(empty)} of {len(views)} images show nothing (alpha is near 0 everywhere): "
            f"{some(empty)} in {listing.paths[0].parent}."
        )
    return views


def _without_ignored(listing: Listing, rest: Sequence[int]) -> Listing:
    """The images at ``rest``; warns about the others, whose pixels are all masked out."""
    gone = [file for index, file in enumerate(listing.files) if index not in {*rest}]
    text = (
        f"masks leave out all pixels of {len(gone)} of {len(listing)} images: {some(gone)} in "
        f"{listing.paths[0].parent}"
    )
    # Also warn if the whole split is left out, because other images are then scored.
    warn(f"{text}. These are left out; set data.mask_use=alpha if they show empty space.")
    if not rest:
        raise MissingSplitError(
            f"{text}. Check the masks, or set data.mask_use=alpha if such images show empty space."
        )
    return listing.subset(rest)


def _refuse_repeats(
    labels: Sequence[str], paths: Sequence[Path], poses: np.ndarray, times: Sequence[float]
) -> None:
    """Refuse files, and pairs of camera and time in a dynamic scene, that are listed twice."""
    seen: dict[Any, str] = {}
    moving = len(set(times)) > 1
    for index, label in enumerate(labels):
        other = seen.setdefault(paths[index], label)
        if other is not label:
            raise SceneError(f"{label} has the same file as {other}. Remove one of the two.")
        # In a static scene, a camera may pass the same place twice.
        if not moving:
            continue
        other = seen.setdefault((poses[index].tobytes(), times[index]), label)
        if other is not label:
            raise SceneError(
                f"{label} has the same camera and time as {other}. Remove one of the two, or "
                f"correct its time."
            )


def _require_shapes(listing: Listing) -> None:
    """Refuse images whose aspect ratio differs from their camera's, and masks of other sizes."""
    sizes = native_sizes(listing.paths)
    problems = [*filter(None, map(misshapen, listing.paths, sizes, listing.calibrations))]
    each = zip(listing.masks, listing.paths, sizes, strict=False)
    masked = [(mask, path, size) for mask, path, size in each if mask is not None]
    mask_sizes = native_sizes([mask for mask, _, _ in masked])
    for mask_size, (mask, path, size) in zip(mask_sizes, masked, strict=True):
        if mask_size != size:
            problems.append(mask_misfit(mask, mask_size, path, size))
    refuse_all(problems)


def misshapen(path: Path, size: Size, camera: Calibration) -> str | None:
    """An error message if the size of an image or video contradicts its calibration; else None.

    Args:
        path: The file.
        size: Its height and width.
        camera: Its calibration.
    """
    if camera.w is None or camera.h is None:
        return None
    height, width = size
    # A tolerance, because sizes of reduced images are rounded.
    off = abs(width * camera.h - height * camera.w)
    if off <= max(1.5 * max(camera.w, camera.h), SHAPE_TOLERANCE * width * camera.h):
        return None
    text = (
        f"{path} has {width}x{height} pixels, but its camera was calibrated for images of "
        f"{camera.w:g}x{camera.h:g}, of another aspect ratio."
    )
    if (height > width) != (camera.h > camera.w) and orientation(path) in UNTURN:
        return (
            f"{text} Its EXIF orientation rotates it for display, and the camera was calibrated "
            "with the rotated image. Pixels are read as they are stored: rotate those of "
            f"copies of the images (magick mogrify -auto-orient *{path.suffix})."
        )
    return (
        f"{text} Perhaps the image was cropped or turned: use the one that the camera was "
        "calibrated with."
    )


def final_intrinsics(
    labels: Sequence[str],
    calibrations: Sequence[Calibration],
    native: Sequence[Size],
    sizes: Sequence[Size],
) -> Intrinsics:
    """Intrinsics of images in their final sizes.

    Warns about perspective lenses that map no direction to some of the pixels, and about principal
    points far from the middle.

    Args:
        labels: The images, for messages. [V]
        calibrations: Their calibrations. [V]
        native: Heights and widths of the files. [V]
        sizes: Final heights and widths. [V]

    Raises:
        SceneError: If a camera's intrinsics are implausible, or if most pixels of a perspective
            lens, or all pixels of another, have no ray.
    """
    known = [
        calibration.scaled(file, size)
        for calibration, file, size in zip(calibrations, native, sizes, strict=True)
    ]
    for label, size, camera, numbers in zip(labels, sizes, calibrations, known, strict=True):
        _require_real(label, size, camera, *numbers)
    _warn_of_other_units(labels, sizes, [middle for _, middle, _ in known])
    focal, centre, skew = (
        torch.tensor(values, dtype=torch.float64) for values in zip(*known, strict=True)
    )
    rows = [[each.distortion.get(name, 0.0) for name in COEFFICIENTS] for each in calibrations]
    model = torch.tensor([int(calibration.model) for calibration in calibrations])
    lenses = Lenses(model, torch.tensor(rows, dtype=torch.float64), skew)
    intrinsics = Intrinsics(focal, centre, torch.tensor(sizes), lenses)
    _require_rays(labels, calibrations, intrinsics)
    return intrinsics


def _require_real(
    label: str,
    size: Size,
    camera: Calibration,
    focal: tuple[float, float],
    centre: tuple[float, float],
    skew: float,
) -> None:
    """Refuse implausible intrinsics, with which rays would coincide or overflow."""
    for axis, along, middle, pixels in zip("xy", focal, centre, reversed(size), strict=True):
        for name, value, low, high in (
            ("focal length", along / pixels, SHORTEST, LONGEST),
            ("principal point", middle / pixels, -FARTHEST_ASIDE, FARTHEST_ASIDE),
        ):
            if not low <= value <= high:
                raise SceneError(
                    f"{label}: the {name} along {axis} is {value:.3g} image sizes; it must lie "
                    f"between {low:g} and {high:g}. Correct the camera, or calibrate again."
                )
    if not abs(skew) <= focal[0]:
        raise SceneError(
            f"{label}: the skew is {skew:.3g} pixels, more than the focal length of "
            f"{focal[0]:.3g}. Correct the camera, or calibrate again."
        )
    if any(not abs(value) <= STRONGEST for value in camera.distortion.values()):
        raise SceneError(
            f"{label}: its {camera.description}; no coefficient may exceed {STRONGEST:g}. Correct "
            "the camera, or calibrate again."
        )


def _warn_of_other_units(
    labels: Sequence[str], sizes: Sequence[Size], middles: Sequence[tuple[float, float]]
) -> None:
    """Warn about principal points that are probably those of images of another size."""
    far = [
        f"{label}: the principal point ({x:.4g}, {y:.4g}) lies far from the middle of the image, "
        f"which has {width}x{height} pixels here"
        for label, (height, width), (x, y) in zip(labels, sizes, middles, strict=True)
        if max(abs(x / width - 0.5), abs(y / height - 0.5)) > ASIDE
    ]
    if far:
        warn(
            f"{far[0]}; so do those of {len(far)} of {len(labels)} cameras or images. Unless these "
            "were cropped, the calibration is for images of another size, which must be given "
            "(w and h in transforms files, W_ and H_ in intri.yml), or is not in pixels: correct "
            "it."
        )


def _require_rays(
    labels: Sequence[str], cameras: Sequence[Calibration], intrinsics: Intrinsics
) -> None:
    """Refuse images where most pixels of a perspective lens, or all of another, lack rays."""
    problems: list[str] = []
    folded: list[tuple[float, str]] = []
    for index, (label, lens) in enumerate(zip(labels, cameras, strict=True)):
        if (shown := intrinsics.has_ray(index)) is None:
            continue
        share = float((~shown).float().mean())
        fault = (
            f"{label}: its {lens.description} folds back inside the image: no direction belongs to "
        )
        if lens.model not in (LensModel.PERSPECTIVE, LensModel.POLYNOMIAL) and share < 1:
            continue
        if share <= MOST_FOLDED:
            folded.append((share, f"{fault}{share:.1%} of the pixels, which are left out"))
            continue
        row, column = (~shown).nonzero()[0].tolist()
        problems.append(
            f"{fault}{share:.1%} of the pixels, such as that in row {row}, column {column}. "
            "Calibrate again with fewer coefficients, correct them, or undistort the images."
        )
    refuse_all(problems)
    if folded:
        others = len(folded) - 1
        warn(max(folded)[1] + (f"; {others} other images lose fewer." if others else "."))
