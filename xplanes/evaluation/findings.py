"""What may be wrong with a capture: findings, each with its numbers and a remedy."""

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.rendering.box import ray_box
from xplanes.scenes.cameras import project
from xplanes.scenes.entries import some
from xplanes.scenes.frame import Frame, axes_meet, backwards, optical_centre
from xplanes.scenes.matte import silhouette_of
from xplanes.scenes.silhouettes import count_in_squares
from xplanes.scenes.views import Scene, Views, spread

GAP_SPACINGS, GAP_SPAN = 12.0, 0.05
"""Shortest gap in time that is reported: in median spacings, and as a share of the span."""

SHORT_SPAN = 0.2
"""Share of [0, 1] that times should cover; less suggests wrong scaling."""

ASTRAY = 0.1
"""Share of the cameras that may miss the centre of the cube."""

SMALL, LARGE = 0.03, 3.0
"""Bounds of half the cube's side, in median distances of the cameras."""

COARSE = 8.0
"""Image pixels per texel above which planes resolve far less than the images show."""

CUT = 0.02
"""Share of the foreground that may lie outside of the cube."""

PALE_STEPS, PALE = 16, 0.15
"""Difference from the background's colour, of 255, below which an opaque pixel looks like it; the
share of a silhouette that may."""

HALO = 0.03
"""Width of the soft edge around a silhouette, as a share of the image's longer side."""

EMPTY = 1e-3
"""Share of opaque pixels below which an image is almost empty."""

FULL = 0.98
"""Share of opaque pixels above which a mask hides nothing."""

MOST_VIEWS = 300
"""Most images of a split that are read, spread evenly."""

AT_START = 32
"""The same at the start of a run, whose images may lie on the disk."""

MOST_RAYS = 4096
"""Most foreground pixels of an image whose rays are tested against the cube."""


@dataclass(frozen=True)
class Finding:
    """Something that may be wrong.

    Attributes:
        kind: Name of what it is about, for programs.
        text: What it is, with numbers, and what to do.
    """

    kind: str
    text: str


@dataclass(frozen=True)
class ImageFacts:
    """Statistics of the pixels of one image.

    Attributes:
        index: Number of the image in its split.
        file: Its name.
        coverage: Share of the pixels that are opaque.
        border: The same along the image's edges.
        middle: The same in the middle, a tenth as wide and high as the image.
        pale_edge: Share of the opaque pixels next to transparent ones that look like the
            background; None where there are too few to say.
        outside: Share of the foreground whose rays miss the cube.
        stray: Pixels with alpha away from the silhouette.
        digest: Hash of the pixels; None where all are alike.
    """

    index: int
    file: str
    coverage: float
    border: float
    middle: float
    pale_edge: float | None
    outside: float
    stray: int
    digest: bytes | None


def image_facts(views: Views, background: Tensor, frame: Frame | None) -> list[ImageFacts]:
    """Statistics of the pixels of a split's images, of at most `MOST_VIEWS` of them.

    Args:
        views: The images.
        background: Colour behind the scene, from 0 to 1. [3]
        frame: The field's frame; None where the cameras see no common volume.
    """
    chosen = spread(MOST_VIEWS, len(views))
    return [_facts_of(views, index, background, frame) for index in chosen]


def _facts_of(views: Views, index: int, background: Tensor, frame: Frame | None) -> ImageFacts:
    image = views.image(index)
    alpha = image[..., 3]
    height, width = alpha.shape
    shown = views.shown(index)
    valid = torch.ones_like(alpha, dtype=torch.bool) if shown is None else shown
    opaque, clear = alpha > 127, (alpha <= 5) & valid
    pale = (image[..., :3].short() - (255 * background).short()).abs().amax(dim=-1) < PALE_STEPS
    pale &= alpha >= 250
    ring = valid.clone()
    rim = max(1, round(0.02 * min(height, width)))
    ring[rim : height - rim, rim : width - rim] = False
    rows, columns = (slice(round(0.45 * n), round(0.55 * n) + 1) for n in (height, width))
    # Half-transparent pixels lie between, so that the opaque ones are two pixels away.
    near_clear = F.max_pool2d(clear.float()[None], 5, stride=1, padding=2)[0] > 0
    edge = near_clear & (alpha >= 250)
    uniform = bool((image == image[0, 0]).all())
    return ImageFacts(
        index=index,
        file=views.files[index],
        coverage=_share(opaque, valid),
        border=_share(opaque, ring),
        middle=_share(opaque[rows, columns], valid[rows, columns]),
        pale_edge=_share(pale, edge) if int(edge.sum()) >= 0.1 * (height + width) else None,
        outside=0.0 if frame is None else _outside(views, index, opaque, frame),
        stray=_stray_pixels(alpha),
        digest=None if uniform else hashlib.sha256(image.contiguous().numpy().data).digest(),
    )


def _share(what: Tensor, among: Tensor) -> float:
    return float(what[among].float().mean()) if among.any() else 0.0


def _outside(views: Views, index: int, opaque: Tensor, frame: Frame) -> float:
    """Share of an image's foreground whose rays miss the cube."""
    pixels = opaque.nonzero()
    if not len(pixels):
        return 0.0
    rows, columns = pixels[:: -(-len(pixels) // MOST_RAYS)].float().T
    rays = views.pixel_rays(torch.full_like(rows, index, dtype=torch.long), rows, columns)
    far = ray_box(*frame.rays(*rays))[1]
    return float((far <= 0).float().mean())


def _stray_pixels(alpha: Tensor) -> int:
    """Pixels with alpha, but away from the silhouette: noise, not soft edges."""
    side = max(1, round(HALO * max(alpha.shape)))
    held = count_in_squares(silhouette_of(alpha), side) > 0
    near = F.max_pool2d(held.float()[None], 3, stride=1, padding=1)[0] > 0
    return int(count_in_squares(alpha > 0, side)[~near].sum())


def camera_findings(scene: Scene, frame: Frame | None) -> Iterator[Finding]:
    """Problems that cameras and times show, and views that two splits share.

    Args:
        scene: The scene; its training views and those that are scored.
        frame: The field's frame; None where none was found.
    """
    train = scene.splits["train"]
    yield from _times(scene, train)
    yield from _shared(scene)
    yield from _sizes(scene)
    if (away := _outward(train)) is not None:
        yield away
    elif frame is not None:
        yield from _astray(train, frame)
        yield from _scale(train, frame)


def image_findings(scene: Scene, images: Mapping[str, list[ImageFacts]]) -> Iterator[Finding]:
    """Problems that the images' pixels show."""
    seen = [each for split in images.values() for each in split]
    masks = list(_masks(seen))
    yield from masks
    yield from _shared_images(scene, images)
    yield from _stray([(each.file, each.stray) for each in seen])
    if masks:
        return  # Silhouettes mean little then.
    transparent = [each for each in seen if each.coverage < FULL]
    if 2 * len(transparent) > len(seen):
        yield from _white_edges(transparent)
        share = fmean(each.outside for each in transparent)
        if share > CUT:
            yield Finding(
                "cut",
                f"the cube cuts off {share:.0%} of the foreground: nothing is shown outside of it. "
                "Raise data.half_side, or mask what does not belong to the scene",
            )
        return
    yield from opaque_findings(scene)


def opaque_findings(scene: Scene) -> Iterator[Finding]:
    """Whether opaque training images show objects in front of a plain background."""
    if scene.splits["train"].is_opaque and not scene.is_surrounded:
        yield Finding(
            "white",
            "the images are opaque and end in the background's colour: a field that is empty there "
            "and one that is filled look the same. Write RGBA images or masks",
        )


def stray_findings(scene: Scene) -> Iterator[Finding]:
    """Whether training images, of which some are read, have alpha away from their silhouettes."""
    views = scene.splits["train"]
    if not views.is_opaque:
        chosen = spread(AT_START, len(views))
        yield from _stray([(views.files[i], _stray_pixels(views.image(i)[..., 3])) for i in chosen])


def texel_findings(per_texel: float, native: int, wide: int, resolution: int) -> Iterator[Finding]:
    """Whether the images show far more than planes resolve.

    Args:
        per_texel: Image pixels that a texel of the planes covers, see `pixels_across`.
        native: Width of these images.
        wide: Width of those that are trained on.
        resolution: Texels along an axis of the planes.
    """
    per_texel *= wide / native
    if per_texel > COARSE:
        width = max(1, round(wide * 0.5 * COARSE / per_texel))
        finer = 2 ** round(math.log2(resolution * per_texel / (0.5 * COARSE)))
        yield Finding(
            "texels",
            f"a texel of planes with {resolution} texels a side covers {per_texel:.0f} pixels of "
            f"images {wide} pixels wide. Set data.resolution={width}, which costs nothing "
            f"that the planes could show, or give the planes {finer}",
        )


def time_steps(views: Views) -> Tensor:
    """The views' different times, in order. [T]"""
    return views.times.double().unique()


def time_gaps(views: Views) -> list[tuple[float, float]]:
    """Gaps between times that are far longer than the usual spacing: first and last time."""
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
            f"spacing{more}: the field can only guess there. Add views, or correct the times",
        )
    span = float(times[-1] - times[0])
    if 0 < span < SHORT_SPAN:
        yield Finding(
            "times",
            f"training times run from {float(times[0]):.3g} to {float(times[-1]):.3g}, "
            f"{span:.0%} of [0, 1]: most of the field's timesteps are never seen. Divide frame "
            "numbers by the last one",
        )
    if span == 0 and not scene.static_reason and (pair := _same_camera_other_image(train)):
        first, second = (train.files[i] for i in pair)
        yield Finding(
            "one_time",
            f"all training views have the time {float(times[0]):.3g}, but {first} and {second} "
            "have one camera and differ: the scene moves. Give every image its time, or take those "
            "of one timestep alone",
        )


def _same_camera_other_image(views: Views) -> tuple[int, int] | None:
    """Two images of one pose that differ."""
    groups: dict[bytes, int] = {}
    for index, pose in enumerate(views.camera_to_world):
        other = groups.setdefault(pose.contiguous().numpy().tobytes(), index)
        if other == index or views.size(other) != views.size(index):
            continue
        apart = (views.image(index).short() - views.image(other).short()).abs().amax(dim=-1)
        if float((apart > PALE_STEPS).float().mean()) > 1e-3:
            return other, index
    return None


def _shared(scene: Scene) -> Iterator[Finding]:
    """Scored views that are training views by their file, or by camera and time."""
    train = scene.splits["train"]
    names = dict(zip(train.files, range(len(train)), strict=True))
    poses = train.camera_to_world.double()
    room = 1e-5 * float((poses[:, :3, 3] - poses[:, :3, 3].mean(dim=0)).norm(dim=-1).median())
    for split in [name for name in scene.splits if name != "train"]:
        views, found = scene.splits[split], []
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
        yield from _shared_finding(split, views, found, "file, or the same camera and time")


def _shared_images(scene: Scene, images: Mapping[str, list[ImageFacts]]) -> Iterator[Finding]:
    """Scored views whose pixels are those of a training view with another camera or file."""
    if any(_shared(scene)):
        return
    train = scene.splits["train"]
    known = {each.digest: each.index for each in images["train"] if each.digest is not None}
    for split in [name for name in scene.splits if name != "train"]:
        poses, found = scene.splits[split].camera_to_world, []
        for each in images[split]:
            other = known.get(each.digest or b"")
            # One camera shows the same again as long as nothing moves.
            if other is not None and not torch.equal(
                poses[each.index], train.camera_to_world[other]
            ):
                found.append((each.file, train.files[other]))
        yield from _shared_finding(split, scene.splits[split], found, "pixels")


def _shared_finding(
    split: str, views: Views, found: list[tuple[str, str]], what: str
) -> Iterator[Finding]:
    for file, other in found[:1]:
        yield Finding(
            "shared",
            f"{len(found)} of {len(views)} {split} views are training views too, by the same "
            f"{what} ({file} is {other}): scores would flatter the field. Take them out of one of "
            "the splits",
        )


def _sizes(scene: Scene) -> Iterator[Finding]:
    """Images of one camera that differ in size."""
    sizes: dict[tuple[float, ...], dict[tuple[int, int], int]] = {}
    for views in scene.splits.values():
        for key, size in zip(calibrations(views), views.intrinsics.size.tolist(), strict=True):
            found = sizes.setdefault(key, {})
            found[(size[1], size[0])] = found.get((size[1], size[0]), 0) + 1
    mixed = [found for found in sizes.values() if len(found) > 1]
    if mixed:
        words = ", ".join(f"{count} of {w}x{h} px" for (w, h), count in mixed[0].items())
        yield Finding(
            "sizes",
            f"images of one camera differ in size ({words}): small ones count less and show less. "
            "Export all at one size, or set data.resolution",
        )


def calibrations(views: Views) -> list[tuple[float, ...]]:
    """What tells the cameras of images apart, whatever the images' sizes are. [V]"""
    intrinsics = views.intrinsics
    scale = intrinsics.size.flip(1).double()
    parts = [intrinsics.focal / scale, intrinsics.centre / scale]
    if (lenses := intrinsics.lenses) is not None:
        parts += [lenses.model[:, None].double(), lenses.coefficients]
    return [tuple(round(value, 4) for value in row) for row in torch.cat(parts, dim=1).tolist()]


def _outward(views: Views) -> Finding | None:
    """Whether the cameras look away from the point in which their axes meet."""
    axis = -backwards(views).double()
    if not axes_meet(views):
        return None  # Axes that are nearly parallel may meet anywhere.
    to_centre = optical_centre(views).double() - views.camera_to_world[:, :3, 3].double()
    away = int(((to_centre * axis).sum(dim=-1) < 0).sum())
    if 2 * away <= len(views):
        return None
    return Finding(
        "axes",
        f"{away} of {len(views)} cameras look away from the point where their axes meet. Axes must "
        "be OpenGL's (x right, y up, z backward): where those of the file are OpenCV's (y down, z "
        "forward), negate the second and third column of every pose. Cameras that do look outward, "
        "as in a panorama, see no common volume",
    )


def pixels_of(views: Views, index: int, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where an image shows world points [N, 3]: what `project` gives for its camera. [N] each"""
    intrinsics = views.intrinsics
    return project(
        views.camera_to_world[index],
        points,
        focal=intrinsics.focal[index],
        centre=intrinsics.centre[index],
        lenses=intrinsics.lens(index),
    )


def sees_centre(views: Views, frame: Frame) -> Tensor:
    """Which cameras have the centre of the cube in their image. bool [V]"""
    found = torch.zeros(len(views), dtype=torch.bool)
    for index in range(len(views)):
        column, row, seen = pixels_of(views, index, frame.centre[None])
        height, width = views.size(index)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found[index] = seen & inside
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


def _masks(images: Sequence[ImageFacts]) -> Iterator[Finding]:
    """Masks that hide everything, nothing, or the wrong side."""
    count = len(images)
    empty = [each.file for each in images if each.coverage < EMPTY]
    if len(empty) > 0.05 * count:
        yield Finding(
            "empty",
            f"{len(empty)} of {count} images show next to nothing (under {EMPTY:.1%} of their "
            f"pixels are opaque), such as {empty[0]}. Check alpha and masks, or leave them out",
        )
    inverted = [e for e in images if e.border > 0.9 and e.middle < 0.1 and 0.3 < e.coverage < 1]
    if 2 * len(inverted) > count:
        yield Finding(
            "inverted",
            f"{len(inverted)} of {count} images are opaque at their edges and transparent in the "
            f"middle; {fmean(each.coverage for each in images):.0%} of all pixels are opaque. The "
            "masks seem inverted: they must be white, or alpha opaque, where the scene is",
        )
        return
    full = [each.file for each in images if each.coverage >= 0.9995]
    masked = [each.coverage for each in images if each.coverage < 0.9995]
    hardly = [coverage for coverage in masked if coverage > FULL]
    if 2 * len(hardly) > count:
        yield Finding(
            "opaque",
            f"{len(hardly)} of {count} images have a mask that hides less than "
            f"{1 - FULL:.0%} of the pixels. Check the masks: they must hide the background, or be "
            "left out",
        )
    elif full and masked and fmean(masked) < 0.5:
        yield Finding(
            "opaque",
            f"{len(full)} of {count} images are opaque all over, such as {full[0]}, while the "
            f"others hide {1 - fmean(masked):.0%} of their pixels. Their masks are missing: add "
            "them, or leave the images out",
        )


def _stray(counts: Sequence[tuple[str, int]]) -> Iterator[Finding]:
    """Images with alpha away from their silhouettes, by file and number of such pixels."""
    found = sorted([each for each in counts if each[1]], key=lambda each: -each[1])
    if found:
        names = some([f"{file} ({count})" for file, count in found])
        yield Finding(
            "stray",
            f"{len(found)} of {len(counts)} images have stray pixels, whose alpha is faint or "
            f"which stand alone: {sum(count for _, count in found)} in all, in {names}. They are "
            "trained on, but count as empty space when the cube and the silhouettes are found. "
            "Clear their alpha; if they show a part of the scene, set data.half_side and "
            "model.sampler.silhouettes=false",
        )


def _white_edges(images: Sequence[ImageFacts]) -> Iterator[Finding]:
    """Silhouettes that look like the background."""
    edges = [each.pale_edge for each in images if each.pale_edge is not None]
    if edges and (pale := fmean(edges)) > PALE:
        yield Finding(
            "white",
            f"{pale:.0%} of the silhouettes have the background's colour: colour alone cannot tell "
            "the scene from empty space there. Keep model.loss.opacity above 0, which learns them "
            "from alpha, or set model.rays.background=random",
        )
