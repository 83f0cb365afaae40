"""Warnings of `xplanes inspect` from the pixels of images: masks, silhouettes, the cube."""

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.evaluation.findings import (
    PALE_STEPS,
    Finding,
    opaque_findings,
    shared,
    shared_finding,
    stray_finding,
    stray_pixels,
)
from xplanes.rendering.box import ray_box
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene, Views, spread

COARSE = 8.0  # Image pixels per texel above which planes lose much of the images' detail.
CUT = 0.02  # Share of the foreground outside of the cube above which a warning is given.
PALE = 0.15  # Share of the silhouettes with the background's colour above which a warning is given.
EMPTY = 1e-3  # Share of opaque pixels below which an image is almost empty.
FULL = 0.98  # Share of opaque pixels above which a mask hides almost nothing.
MOST_VIEWS = 300  # Most images that are read per split, evenly spaced.
MOST_RAYS = 4096  # Most foreground pixels of an image whose rays are tested against the cube.


@dataclass(frozen=True)
class ImageFacts:
    """Statistics of the pixels of one image.

    Attributes:
        index: Index of the image in its split.
        file: Name of the image.
        coverage: Share of opaque pixels.
        border: Share of opaque pixels along the image's edges.
        middle: Share of opaque pixels in the middle, a tenth as wide and high as the image.
        pale_edge: Share of pixels with the background's colour among the opaque pixels next to
            transparent ones; None if these are too few.
        outside: Share of the foreground whose rays miss the cube.
        stray: Number of pixels with alpha far from the silhouette.
        digest: Hash of the pixels; None if all pixels are equal.
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
    """Statistics of the pixels of at most `MOST_VIEWS` images of a split.

    Args:
        views: The views of the split.
        background: Background colour, from 0 to 1. [3]
        frame: The field's frame; None if the cameras see no common volume.
    """
    return [_facts_of(views, i, background, frame) for i in spread(MOST_VIEWS, len(views))]


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
    # Two pixels away, since semi-transparent pixels lie between opaque and transparent ones.
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
        stray=stray_pixels(alpha),
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


def image_findings(scene: Scene, images: Mapping[str, list[ImageFacts]]) -> Iterator[Finding]:
    """Findings from the images' pixels."""
    seen = [each for split in images.values() for each in split]
    masks = list(_masks(seen))
    yield from masks
    yield from _shared_images(scene, images)
    yield from stray_finding([(each.file, each.stray) for each in seen])
    if masks:
        return  # Silhouettes are unreliable with such masks.
    transparent = [each for each in seen if each.coverage < FULL]
    if 2 * len(transparent) > len(seen):
        yield from _white_edges(transparent)
        share = fmean(each.outside for each in transparent)
        if share > CUT:
            yield Finding(
                "cut",
                f"the cube cuts off {share:.0%} of the foreground: the field is empty outside it. "
                "Raise data.half_side, or mask what does not belong to the scene",
            )
        return
    yield from opaque_findings(scene)


def texel_findings(
    per_texel: float, wide: int, resolution: int, *, fine: bool
) -> Iterator[Finding]:
    """Warn if the images have far more detail than the planes can represent.

    Args:
        per_texel: Pixels of the images in training per texel of the planes.
        wide: Width of these images.
        resolution: Texels along an axis of the planes.
        fine: Whether the model can have additional finer planes (``model.fine``).
    """
    if per_texel > COARSE:
        width = max(1, round(wide * 0.5 * COARSE / per_texel))
        finer = 2 ** round(math.log2(resolution * per_texel / (0.5 * COARSE)))
        more = f"Planes with {finer} texels per side would show it"
        if fine:
            more = f"model.fine.texels={finer} adds finer planes, which help after two minutes"
        yield Finding(
            "texels",
            f"a texel of planes with {resolution} texels per side covers {per_texel:.0f} pixels of "
            f"images {wide} pixels wide. {more}; data.resolution={width} trains faster, and "
            "loses no detail that the planes could represent",
        )


def _shared_images(scene: Scene, images: Mapping[str, list[ImageFacts]]) -> Iterator[Finding]:
    """Scored views with the same pixels as a training view of another camera."""
    if any(shared(scene)):
        return
    train = scene.splits["train"]
    known = {each.digest: each.index for each in images["train"] if each.digest is not None}
    for split in [name for name in scene.splits if name != "train"]:
        poses, found = scene.splits[split].camera_to_world, []
        for each in images[split]:
            other = known.get(each.digest or b"")
            # Images of one pose may be equal, if nothing moves.
            if other is not None and not torch.equal(
                poses[each.index], train.camera_to_world[other]
            ):
                found.append((each.file, train.files[other]))
        yield from shared_finding(split, scene.splits[split], found, "pixels")


def _masks(images: Sequence[ImageFacts]) -> Iterator[Finding]:
    """Masks that hide everything, nothing, or the wrong side."""
    count = len(images)
    empty = [each.file for each in images if each.coverage < EMPTY]
    if len(empty) > 0.05 * count:
        yield Finding(
            "empty",
            f"{len(empty)} of {count} images show almost nothing (under {EMPTY:.1%} of their "
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
