"""Possible problems of a capture, each with numbers and a remedy."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.errors import some
from xplanes.scenes.cameras import project
from xplanes.scenes.frame import Frame, axes_meet, backwards, optical_centre
from xplanes.scenes.matte import silhouette_of
from xplanes.scenes.silhouettes import count_in_squares
from xplanes.scenes.views import Scene, Views, spread

GAP_SPACINGS, GAP_SPAN = 12.0, 0.05
"""Shortest gap in time that is reported: in median spacings, and as a share of the time span."""

SHORT_SPAN = 0.2  # Least share of [0, 1] that times should cover; less suggests wrong scaling.
ASTRAY = 0.1  # Largest acceptable share of cameras that do not see the centre of the cube.

SMALL, LARGE = 0.03, 3.0
"""Range of plausible half sides of the cube, in units of the cameras' median distance."""

ASUNDER, TOGETHER = 0.2, 0.1
"""Distance of optical axes from their common point, relative to that of the cameras: above the
first, poses are probably wrong; below the second, they are probably right."""

EVEN = 0.35
"""Least distance of nine in ten orbiting cameras from the point where axes meet, in medians."""

PALE_STEPS = 16  # Colour difference, out of 255, below which two pixels count as equal.
HALO = 0.03  # Width of the soft edge around a silhouette, as a share of the image's longer side.
AT_START = 32  # Maximum number of images, evenly spread, that are checked at the start of a run.


@dataclass(frozen=True)
class Finding:
    """A possible problem.

    Attributes:
        kind: Kind of the problem, for programs.
        text: The problem, with numbers, and the remedy.
    """

    kind: str
    text: str


def stray_pixels(alpha: Tensor) -> int:
    """Number of pixels with alpha above 0 away from the silhouette: noise, not soft edges."""
    side = max(1, round(HALO * max(alpha.shape)))
    held = count_in_squares(silhouette_of(alpha), side) > 0
    near = F.max_pool2d(held.float()[None], 3, stride=1, padding=1)[0] > 0
    return int(count_in_squares(alpha > 0, side)[~near].sum())


def camera_findings(scene: Scene, frame: Frame | None) -> Iterator[Finding]:
    """Problems of cameras and times, and views that two splits share.

    Args:
        scene: The scene, with its training views and those that are scored.
        frame: The field's frame; None if none could be estimated.
    """
    train = scene.splits["train"]
    yield from _times(scene, train)
    yield from shared(scene)
    yield from _sizes(scene)
    if (away := _outward(train)) is not None:
        yield away
    elif frame is not None:
        yield from _astray(train, frame)
        yield from _scale(train, frame)


def scene_findings(scene: Scene, frame: Frame | None) -> Iterator[Finding]:
    """Problems that a run warns about before training."""
    yield from camera_findings(scene, frame)
    yield from opaque_findings(scene)
    views = scene.splits["train"]
    if not views.is_opaque:
        chosen = spread(AT_START, len(views))
        stray = [(views.files[i], stray_pixels(views.image(i)[..., 3])) for i in chosen]
        yield from stray_finding(stray)


def opaque_findings(scene: Scene) -> Iterator[Finding]:
    """Finds opaque training images of objects in front of a constant background."""
    if scene.splits["train"].is_opaque and not scene.is_surrounded:
        yield Finding(
            "white",
            "the images are opaque, with a background of constant colour: empty space and content "
            "of that colour look the same. Write RGBA images or masks",
        )


def time_steps(views: Views) -> Tensor:
    """The views' distinct times, in ascending order. [T]"""
    return views.times.double().unique()


def time_gaps(views: Views) -> list[tuple[float, float]]:
    """Gaps far longer than the median spacing of times, each as its first and last time."""
    times = time_steps(views)
    if len(times) < 5:
        return []
    spacing = times.diff()
    least = max(GAP_SPACINGS * float(spacing.median()), GAP_SPAN * float(times[-1] - times[0]))
    return [
        (float(times[i]), float(times[i + 1])) for i in (spacing > least).nonzero()[:, 0].tolist()
    ]


def _times(scene: Scene, train: Views) -> Iterator[Finding]:
    times = time_steps(train)
    gaps = time_gaps(train)
    if gaps:
        longest = max(gaps, key=lambda gap: gap[1] - gap[0])
        more = f" ({len(gaps)} such gaps in all)" if len(gaps) > 1 else ""
        yield Finding(
            "times",
            f"no training view shows the times between {longest[0]:.3g} and {longest[1]:.3g}, "
            f"{(longest[1] - longest[0]) / float(times.diff().median()):.0f} times the median "
            f"spacing{more}: the field is not supervised there. Add views, or correct the times",
        )
    span = float(times[-1] - times[0])
    if 0 < span < SHORT_SPAN:
        yield Finding(
            "times",
            f"training times run from {float(times[0]):.3g} to {float(times[-1]):.3g}, "
            f"{span:.0%} of [0, 1]: most of the field's timesteps are never seen. Divide frame "
            "numbers by the last frame number",
        )
    if span == 0 and not scene.static_reason and (pair := _same_camera_other_image(train)):
        first, second = (train.files[i] for i in pair)
        yield Finding(
            "one_time",
            f"all training views have the time {float(times[0]):.3g}, but {first} and {second} "
            "differ, although they have the same camera: the scene moves. Give every image its "
            "time, or use only images of one timestep",
        )


def _same_camera_other_image(views: Views) -> tuple[int, int] | None:
    """Indices of two views with the same pose whose images differ; None if there are none."""
    first: dict[bytes, int] = {}
    for index, pose in enumerate(views.camera_to_world):
        other = first.setdefault(pose.contiguous().numpy().tobytes(), index)
        if other == index or views.size(other) != views.size(index):
            continue
        apart = (views.image(index).short() - views.image(other).short()).abs().amax(dim=-1)
        if float((apart > PALE_STEPS).float().mean()) > 1e-3:
            return other, index
    return None


def shared(scene: Scene) -> Iterator[Finding]:
    """Scored views that are also training views, by their file or by camera and time."""
    train = scene.splits["train"]
    names = dict(zip(train.files, range(len(train)), strict=True))
    poses = train.camera_to_world.double()
    room = 1e-5 * float((poses[:, :3, 3] - poses[:, :3, 3].mean(dim=0)).norm(dim=-1).median())
    for split in [name for name in scene.splits if name != "train"]:
        views, found = scene.splits[split], []
        if views is train:
            continue  # Too few views to hold some out; the reader has warned.
        for index, file in enumerate(views.files):
            pose, time = views.camera_to_world[index], views.times[index]
            near = (poses - pose.double()).abs().flatten(1).amax(dim=1) <= max(room, 1e-9)
            near &= (train.times - time).abs() <= 1e-6
            other = names.get(file)
            # User-defined formats may use the same file names in several splits.
            if other is not None and torch.equal(views.image(index), train.image(other)):
                found.append((file, file))
            elif near.any():
                found.append((file, train.files[int(near.nonzero()[0, 0])]))
        yield from shared_finding(split, views, found, "file, or the same camera and time")


def shared_finding(
    split: str, views: Views, found: list[tuple[str, str]], what: str
) -> Iterator[Finding]:
    """The finding for pairs of a scored and a training view that are equal in ``what``."""
    for file, other in found[:1]:
        yield Finding(
            "shared",
            f"{len(found)} of {len(views)} {split} views are training views too, by the same "
            f"{what} ({file} is {other}): scores would be too high. Remove them from one of the "
            "splits",
        )


def _sizes(scene: Scene) -> Iterator[Finding]:
    """Images of one camera that differ in size."""
    sizes: dict[tuple[float, ...], Counter[tuple[int, int]]] = defaultdict(Counter)
    for views in scene.splits.values():
        for key, (height, width) in zip(
            calibrations(views), views.intrinsics.size.tolist(), strict=True
        ):
            sizes[key][width, height] += 1
    mixed = [found for found in sizes.values() if len(found) > 1]
    if mixed:
        words = ", ".join(f"{count} of {w}x{h} px" for (w, h), count in mixed[0].items())
        yield Finding(
            "sizes",
            f"images of one camera differ in size ({words}): small ones give fewer rays. "
            "Export all at one size, or set data.resolution",
        )


def calibrations(views: Views) -> list[tuple[float, ...]]:
    """Intrinsics of each view in a form that does not depend on the image size. [V]"""
    intrinsics = views.intrinsics
    scale = intrinsics.size.flip(1).double()
    parts = [intrinsics.focal / scale, intrinsics.centre / scale]
    if (lenses := intrinsics.lenses) is not None:
        parts += [lenses.model[:, None].double(), lenses.coefficients]
    return [tuple(round(value, 4) for value in row) for row in torch.cat(parts, dim=1).tolist()]


def _outward(views: Views) -> Finding | None:
    """Finds cameras that face away from the point where axes meet, and axes that do not meet."""
    along, missed = _meeting(views)
    inverse = replace(views, camera_to_world=torch.linalg.inv(views.camera_to_world))
    if missed > ASUNDER and axes_meet(inverse):
        ahead, missed = _meeting(inverse)
        # A camera that moves straight ahead also seems to orbit a point, but at varying distance.
        distance = ahead.abs()
        orbits = distance.quantile(0.1) > EVEN * distance.median()
        if missed < TOGETHER and orbits:
            then = " and then negate its second and third column (OpenCV's axes)"
            return Finding(
                "axes",
                "the cameras' axes do not meet, but those of the inverse poses do: the poses seem "
                "to be world-to-camera. They must be camera-to-world: invert the matrix of every "
                f"frame{then if (ahead < 0).double().mean() > 0.5 else ''}. A camera that rotates "
                "in place gives the same result, but its views have no common volume",
            )
    # Axes that are nearly parallel may meet anywhere.
    away = int((along < 0).sum())
    if not axes_meet(views) or 2 * away <= len(views):
        return None
    return Finding(
        "axes",
        f"{away} of {len(views)} cameras look away from the point where their axes meet. Axes must "
        "be OpenGL's (x right, y up, z backward): if those of the file are OpenCV's (y down, z "
        "forward), negate the second and third column of every pose. Poses must be "
        "camera-to-world: if those of the file are world-to-camera, invert them. Cameras that do "
        "look outward, as in a panorama, see no common volume",
    )


def _meeting(views: Views) -> tuple[Tensor, float]:
    """Depth in each camera of the point nearest to all axes, and the axes' distance from it.

    The distance is the RMS over all axes, relative to that of the cameras from the point.
    """
    offset = optical_centre(views).double() - views.camera_to_world[:, :3, 3].double()
    axis = -backwards(views).double()
    along = (offset * axis).sum(dim=-1)
    beside = (offset - along[:, None] * axis).square().sum(dim=-1).mean()
    distance = offset.square().sum(dim=-1).mean()
    return along, float((beside / distance).sqrt()) if distance > 0 else 1.0


def pixels_of(views: Views, index: int, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Projection of world points [N, 3] into an image, as in `project`. [N] each"""
    intrinsics = views.intrinsics
    return project(
        views.camera_to_world[index],
        points,
        focal=intrinsics.focal[index],
        centre=intrinsics.centre[index],
        lenses=intrinsics.lens(index),
    )


def sees_centre(views: Views, frame: Frame) -> Tensor:
    """Whether each camera sees the centre of the cube. bool [V]"""
    found = torch.zeros(len(views), dtype=torch.bool)
    for index in range(len(views)):
        column, row, seen = pixels_of(views, index, frame.centre[None])
        height, width = views.size(index)
        found[index] = seen & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return found


def _astray(views: Views, frame: Frame) -> Iterator[Finding]:
    sees = sees_centre(views, frame)
    blind = (~sees).nonzero()[:, 0].tolist()
    if len(blind) > ASTRAY * len(views):
        centre = ", ".join(f"{value:.3g}" for value in frame.centre.tolist())
        yield Finding(
            "astray",
            f"{len(blind)} of {len(views)} cameras do not see the centre of the cube ({centre}), "
            f"such as that of {views.files[blind[0]]}. All must look at the same object or scene: "
            "check their poses, or leave these views out",
        )


def _scale(views: Views, frame: Frame) -> Iterator[Finding]:
    away = (views.camera_to_world[:, :3, 3] - frame.centre).norm(dim=-1)
    distance, half = float(away.median()), 1 / frame.scale
    if not SMALL * distance <= half <= LARGE * distance:
        word = "small" if half < distance else "large"
        yield Finding(
            "scale",
            f"the cube is {2 * half:.3g} world units wide, but the cameras are {distance:.3g} away "
            f"from its centre: it is too {word}, or in other units than the poses. Set "
            f"data.half_side to half the width of the scene (null estimates it)",
        )


def stray_finding(counts: Sequence[tuple[str, int]]) -> Iterator[Finding]:
    """Images with alpha away from their silhouettes, by file and number of such pixels."""
    found = sorted([each for each in counts if each[1]], key=lambda each: -each[1])
    if found:
        names = some([f"{file} ({count})" for file, count in found])
        yield Finding(
            "stray",
            f"{len(found)} of {len(counts)} images have stray pixels, which are faint or "
            f"isolated: {sum(count for _, count in found)} in all, in {names}. They are trained "
            "on, but count as empty space when the cube and the silhouettes are estimated. "
            "Clear their alpha; if they show a part of the scene, set data.half_side and "
            "model.sampler.silhouettes=false",
        )
