"""Images of a scene with poses and times, in memory or in a file of pixels."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.scenes.cameras import PosedCamera, cast_rays
from xplanes.scenes.lenses import Lenses, Sight, sight
from xplanes.scenes.matte import silhouette_of
from xplanes.scenes.store import PixelFile, StoredImages

PALE_STEPS, PALE_EDGE = 16, 0.9
"""Largest difference, out of 255, from the background's colour; least share of such edge pixels."""

RIM = 0.02
"""Width of an image's edge, as a share of its smaller side."""

MOST_EDGES = 32
"""Number of views, evenly spread, whose edges are sampled."""

SAME_CAMERA = 1e-4
"""Largest relative difference between intrinsics of one camera."""


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of the cameras of some images, in pixels; pixel centres lie at +0.5.

    Attributes:
        focal: Focal lengths along x and y. float64 [V, 2]
        centre: Principal points, x from the left and y from the top; half of width and height for
            centred images. float64 [V, 2]
        size: Height and width of each image. int64 [V, 2]
        lenses: Lenses that distort the images; None if all cameras are pinholes.
    """

    focal: Tensor
    centre: Tensor
    size: Tensor
    lenses: Lenses | None = None

    def __post_init__(self) -> None:
        for name in ("focal", "centre", "size"):
            value = getattr(self, name)
            if value.shape != (len(self.size), 2):
                raise ValueError(f"intrinsics.{name} is {list(value.shape)}, but must be [V, 2]")
            # In double precision, so that derived sizes and angles are as exact as the files.
            kind = torch.int64 if name == "size" else torch.float64
            object.__setattr__(self, name, value.to(kind))
        if self.lenses is not None:
            if len(self.lenses) != len(self.size):
                raise ValueError(
                    f"intrinsics.lenses are {len(self.lenses)}, but there are {len(self.size)} "
                    "images"
                )
            if self.lenses.are_pinholes:
                object.__setattr__(self, "lenses", None)

    def __len__(self) -> int:
        return len(self.size)

    @classmethod
    def shared(cls, focal: float, height: int, width: int, count: int) -> "Intrinsics":
        """Intrinsics of ``count`` centred images of one camera with square pixels."""
        return cls(
            torch.full((count, 2), focal, dtype=torch.float64),
            torch.tensor([0.5 * width, 0.5 * height], dtype=torch.float64).repeat(count, 1),
            torch.tensor([height, width]).repeat(count, 1),
        )

    def subset(self, indices: Tensor) -> "Intrinsics":
        """Intrinsics of the images at ``indices``, in that order. [K]"""
        lenses = None if self.lenses is None else self.lenses[indices]
        return Intrinsics(self.focal[indices], self.centre[indices], self.size[indices], lenses)

    def joined(self, other: "Intrinsics") -> "Intrinsics":
        """These intrinsics, then those of ``other``."""
        return Intrinsics(
            torch.cat([self.focal, other.focal]),
            torch.cat([self.centre, other.centre]),
            torch.cat([self.size, other.size]),
            self._all_lenses().joined(other._all_lenses()),
        )

    def _all_lenses(self) -> Lenses:
        return self.lenses or Lenses.pinholes(len(self))

    @property
    def is_shared(self) -> bool:
        """Whether all images have the same intrinsics."""
        room = float(SAME_CAMERA * self.size.max())
        rows = [(self.size, 0), (self.focal / self.focal[0], SAME_CAMERA), (self.centre, room)]
        if (lenses := self.lenses) is not None:
            rows += [(lenses.model, 0), (lenses.coefficients, SAME_CAMERA), (lenses.skew, room)]
        return all(bool(((each - each[0]).abs() <= most).all()) for each, most in rows)

    def lens(self, index: int) -> Lenses | None:
        """The lens of image ``index`` alone; None for a pinhole."""
        return None if self.lenses is None else self.lenses[index : index + 1]

    @cached_property
    def sights(self) -> list[Sight] | None:
        """Field of view of each image through its lens; None if all cameras are pinholes. [V]"""
        if self.lenses is None:
            return None
        known: dict[tuple[float, ...], Sight] = {}
        lenses, found = self.lenses, []
        places = self.focal, self.centre, self.size, lenses.model[:, None]
        numbers = torch.cat([*places, lenses.coefficients, lenses.skew[:, None]], dim=1)
        for index, key in enumerate(map(tuple, numbers.tolist())):
            if key not in known:
                height, width = self.size[index].tolist()
                lens = lenses[index : index + 1]
                known[key] = sight(lens, self.focal[index], self.centre[index], height, width)
            found.append(known[key])
        return found

    def has_ray(self, index: int) -> Tensor | None:
        """Pixels of image ``index`` to which its lens maps a direction; None for all. bool [h, w]

        For example, the corners of fisheye images have no rays.
        """
        return None if self.sights is None else self.sights[index].has_ray

    @property
    def pinhole(self) -> Tensor:
        """Focal lengths of pinholes with the same field of view, to replace lenses. [V, 2]"""
        if self.sights is None:
            return self.focal
        return torch.tensor([each.pinhole for each in self.sights], dtype=torch.float64)

    @property
    def fov_y(self) -> float:
        """Vertical field of view of the median image, in radians."""
        return 2 * math.atan(float((0.5 * self.size[:, 0] / self.pinhole[:, 1]).median()))

    def focal_at(self, size: int) -> float:
        """Focal length of the median image if its longer side is resized to ``size`` pixels."""
        longer = self.size.amax(dim=1)
        return float((self.pinhole.mean(dim=1) * size / longer).median())


@dataclass(frozen=True)
class Views:
    """The images of one split with their cameras and times.

    Images may differ in size. Smaller ones are padded with zeros at the bottom and on the right.
    `image`, `composite` and `image_rays` exclude the padding.

    Attributes:
        images: RGB premultiplied by alpha, and alpha, as a tensor or a reader of a file of pixels.
            uint8 [V, H, W, 4]
        camera_to_world: Rigid camera poses with OpenGL axes. [V, 4, 4]
        times: Time of each image, from 0 to 1. [V]
        intrinsics: Focal lengths and principal points in pixels, image sizes and lenses. A number
            is the shared focal length in pixels of centred images of size H x W.
        files: Name of each image, relative to the scene's folder. [V]
        foreground: Share of each pixel that the object covers, from 0 to 255; used only for
            scores. None if unknown. uint8 [V, H, W]
        ignored: Pixels that are neither trained on nor scored; None for none. bool [V, H, W]

    Raises:
        ValueError: If the shapes of ``images``, ``intrinsics``, ``foreground`` and ``ignored``
            disagree.
    """

    images: Tensor | StoredImages
    camera_to_world: Tensor
    times: Tensor
    intrinsics: Intrinsics
    files: tuple[str, ...]
    foreground: Tensor | None = None
    ignored: Tensor | None = None

    def __post_init__(self) -> None:
        count, height, width = self.images.shape[:3]
        if not isinstance(self.intrinsics, Intrinsics):
            shared = Intrinsics.shared(float(self.intrinsics), height, width, count)
            object.__setattr__(self, "intrinsics", shared)
        size = self.intrinsics.size
        if len(size) != count or (count and size.amax(dim=0).tolist() != [height, width]):
            raise ValueError(
                f"views.images is {list(self.images.shape)}, which does not fit views.intrinsics: "
                f"{len(size)} images of at most {size.amax(dim=0).tolist() if len(size) else 0} px"
            )
        for name in ("foreground", "ignored"):
            pixels: Tensor | None = getattr(self, name)
            if pixels is not None and pixels.shape != (count, height, width):
                raise ValueError(
                    f"views.{name} is {list(pixels.shape)}, but views.images are "
                    f"{[count, height, width]}"
                )

    def __len__(self) -> int:
        return len(self.files)

    @property
    def height(self) -> int:
        """Rows of the tallest image."""
        return self.images.shape[1]

    @property
    def width(self) -> int:
        """Columns of the widest image."""
        return self.images.shape[2]

    @property
    def is_padded(self) -> bool:
        """Whether images differ in size, so that smaller ones have padding."""
        return bool((self.intrinsics.size != self.intrinsics.size[:1]).any())

    @property
    def pixels(self) -> int:
        """Number of pixels of all images, without padding."""
        return int(self.intrinsics.size.prod(dim=1).sum())

    @property
    def is_partial(self) -> bool:
        """Whether some pixels are left out: padding, pixels without a ray, and ignored ones."""
        masks = [self.ignored, *(each.has_ray for each in self.intrinsics.sights or [])]
        return self.is_padded or any(mask is not None for mask in masks)

    @cached_property
    def is_opaque(self) -> bool:
        """Whether the silhouettes are the whole images, so that alpha carries no information."""
        for index in range(len(self)):
            silhouette, shown = self.silhouette(index), self.shown(index)
            if not (silhouette if shown is None else silhouette[shown]).all():
                return False
        return True

    @property
    def outline(self) -> str:
        """The images' size, for messages."""
        return f"{'up to ' if self.is_padded else ''}{self.width}x{self.height} px"

    @property
    def positions(self) -> int:
        """Number of distinct camera positions."""
        return len(self.camera_to_world[:, :3, 3].unique(dim=0))

    @property
    def is_static(self) -> bool:
        """Whether all views show one timestep, so that nothing can move."""
        return bool((self.times == self.times[0]).all())

    @property
    def is_stored(self) -> bool:
        """Whether the images are in a file of pixels, not in memory."""
        return isinstance(self.images, StoredImages)

    @property
    def nbytes(self) -> int:
        """Bytes that the images take in memory, or on disk."""
        return self.images.nbytes

    @property
    def identity(self) -> Any:
        """Key that identifies these images: their bytes, or their sources."""
        return self.images if isinstance(self.images, Tensor) else self.images.identity

    def size(self, index: int) -> tuple[int, int]:
        """Height and width of image ``index``."""
        height, width = self.intrinsics.size[index].tolist()
        return height, width

    def image(self, index: int) -> Tensor:
        """Image ``index`` without padding; do not modify it. uint8 [h, w, 4]"""
        if isinstance(self.images, StoredImages):
            return self.images.image(index)
        return self._cropped(self.images, index)

    def _cropped(self, pixels: Tensor, index: int) -> Tensor:
        height, width = self.size(index)
        return pixels[index, :height, :width]

    def shown(self, index: int) -> Tensor | None:
        """Pixels of image ``index`` that are trained on and scored; None for all. bool [h, w]

        Others are ignored, or have no ray.
        """
        has_ray = self.intrinsics.has_ray(index)
        if self.ignored is None:
            return has_ray
        shown = ~self._cropped(self.ignored, index)
        return shown if has_ray is None else shown & has_ray

    def foreground_in(self, index: int) -> Tensor | None:
        """Coverage of each pixel of image ``index`` by the foreground object. uint8 [h, w]

        None if unknown.
        """
        return None if self.foreground is None else self._cropped(self.foreground, index)

    def in_memory(self) -> Tensor:
        """All images, with padding. uint8 [V, H, W, 4]"""
        if isinstance(self.images, Tensor):
            return self.images
        whole = torch.zeros(self.images.shape, dtype=torch.uint8)
        for index in range(len(self)):
            self._cropped(whole, index).copy_(self.images.image(index))
        return whole

    def silhouette(self, index: int) -> Tensor:
        """The silhouette of image ``index``, see `silhouette_of`. bool [h, w]"""
        if isinstance(self.images, StoredImages):
            return self.images.silhouette(index)
        return silhouette_of(self.image(index)[..., 3])

    def valid(self) -> Tensor:
        """Pixels that are not padding, have a ray and are not ignored. bool [V, H, W]"""
        height, width = self.intrinsics.size.unbind(dim=1)
        rows = torch.arange(self.height) < height[:, None]
        columns = torch.arange(self.width) < width[:, None]
        found = rows[:, :, None] & columns[:, None, :]
        for index in range(len(self)):
            if (shown := self.shown(index)) is not None:
                found[index, : shown.shape[0], : shown.shape[1]] &= shown
        return found

    def to(self, device: torch.device) -> "Views":
        """Views in memory, without lenses, on another device."""
        assert isinstance(self.images, Tensor)
        assert self.intrinsics.lenses is None
        names = ("focal", "centre", "size")
        intrinsics = Intrinsics(*(getattr(self.intrinsics, name).to(device) for name in names))
        images, poses = self.images.to(device), self.camera_to_world.to(device)
        return Views(images, poses, self.times.to(device), intrinsics, self.files)

    def subset(self, indices: Tensor | Sequence[int]) -> "Views":
        """Select views by index.

        Args:
            indices: Indices of views, in the order of the result. int64 [K]
        """
        indices = torch.as_tensor(indices, dtype=torch.int64)
        intrinsics = self.intrinsics.subset(indices)
        images = self.images[indices]
        if isinstance(images, Tensor) and len(intrinsics) and self.is_padded:
            height, width = intrinsics.size.amax(dim=0).tolist()
            images = images[:, :height, :width].contiguous()
        height, width = images.shape[1:3]
        return Views(
            images,
            self.camera_to_world[indices],
            self.times[indices],
            intrinsics,
            tuple(self.files[i] for i in indices.tolist()),
            None if self.foreground is None else self.foreground[indices, :height, :width],
            None if self.ignored is None else self.ignored[indices, :height, :width],
        )

    def composite(self, index: int, background: Tensor) -> Tensor:
        """Image ``index`` as floats in [0, 1], composited on ``background`` [3]. [h, w, 3]"""
        image = self.image(index).float() / 255
        return image[..., :3] + (1 - image[..., 3:]) * background

    def edge_share_of(self, index: int, colour: Tensor) -> float:
        """Share of the pixels at the edge of image ``index`` that are close to a colour [3]."""
        image, shown = self.image(index), self.shown(index)
        pale = (image[..., :3].short() - (255 * colour).short()).abs().amax(dim=-1) < PALE_STEPS
        edge = torch.ones_like(pale) if shown is None else shown.clone()
        height, width = pale.shape
        rim = max(1, round(RIM * min(height, width)))
        edge[rim : height - rim, rim : width - rim] = False
        return float(pale[edge].float().mean()) if edge.any() else 0.0

    def camera(self, index: int) -> "PosedCamera":
        """The camera of image ``index``."""
        height, width = self.size(index)
        focal, centre = self.intrinsics.focal[index], self.intrinsics.centre[index]
        lens = self.intrinsics.lens(index)
        return PosedCamera(self.camera_to_world[index], focal, height, width, centre, lens)

    def image_rays(self, index: int) -> tuple[Tensor, Tensor]:
        """Rays through every pixel of image ``index``, row by row.

        Returns:
            Origins and unit directions in the world. [h w, 3], [h w, 3]
        """
        return self.camera(index).rays()

    def outline_rays(self, index: int) -> tuple[Tensor, Tensor]:
        """Rays through the outline of the silhouette of image ``index``.

        The outline is its pixels that have a neighbour outside it, or lie at the image's edge.

        Returns:
            Origins and unit directions in the world. [N, 3], [N, 3]
        """
        mask = self.silhouette(index)
        around = F.pad(mask, (1, 1, 1, 1))
        inside = around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:]
        rows, columns = (mask & ~inside).nonzero().T
        return self.pixel_rays(torch.full_like(rows, index), rows.float(), columns.float())

    def pixel_rays(self, views: Tensor, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Rays through pixels of any images.

        Args:
            views: Index of the image of each ray. int64 [R]
            rows: Pixel rows, from 0 at the top. [R]
            columns: Pixel columns, from 0 at the left. [R]

        Returns:
            Origins and unit directions in the world. [R, 3], [R, 3]
        """
        intrinsics = self.intrinsics
        return cast_rays(
            self.camera_to_world[views],
            rows,
            columns,
            focal=intrinsics.focal[views],
            centre=intrinsics.centre[views],
            lenses=None if intrinsics.lenses is None else intrinsics.lenses[views],
        )


def joined(first: Views, second: Views) -> Views:
    """The views of both; of the two masks, views without one have an empty one."""
    height, width = max(first.height, second.height), max(first.width, second.width)

    def together(parts: Sequence[Tensor]) -> Tensor:
        """Images, padded with zeros at the bottom and on the right. [V, h, w, C] each"""
        whole = parts[0].new_zeros(sum(map(len, parts)), height, width, *parts[0].shape[3:])
        for part, room in zip(parts, whole.split([*map(len, parts)]), strict=True):
            room[:, : part.shape[1], : part.shape[2]] = part
        return whole

    if isinstance(first.images, Tensor) and isinstance(second.images, Tensor):
        images = together([first.images, second.images])
    else:
        images = _stored(first).joined(_stored(second))

    def marked(name: str, kind: torch.dtype) -> Tensor | None:
        given = [getattr(each, name) for each in (first, second)]
        if all(mask is None for mask in given):
            return None
        empty = (torch.zeros(each.images.shape[:3], dtype=kind) for each in (first, second))
        return together([e if m is None else m for m, e in zip(given, empty, strict=True)])

    return Views(
        images,
        torch.cat([first.camera_to_world, second.camera_to_world]),
        torch.cat([first.times, second.times]),
        first.intrinsics.joined(second.intrinsics),
        first.files + second.files,
        foreground=marked("foreground", torch.uint8),
        ignored=marked("ignored", torch.bool),
    )


def _stored(views: Views) -> StoredImages:
    """The images as `StoredImages`; tensors are copied to a `PixelFile` in memory."""
    if isinstance(views.images, StoredImages):
        return views.images
    return StoredImages.all_of(PixelFile.of(views.image(index) for index in range(len(views))))


@dataclass(frozen=True)
class Scene:
    """A scene: its views by split, and what else is known about it.

    Attributes:
        name: Name for titles and run directories.
        splits: Views by split name: "train", "val", "test".
        video: Frames of a fixed camera; None if there are none.
        background: Background colour in scores and rendered images, from 0 to 1. [3]
        static_reason: Why the scene is known to be static; empty if it may be dynamic.
        points: Surface points in the world, for example from COLMAP; None if unknown.
            float32 [N, 3]
        lrm_views: Training views masked to the foreground object, for LRMs alone; None if there are
            no masks, or the alpha of ``splits`` contains them.
        refine_cameras: Whether training corrects the poses of its cameras.
        notes: Observations made while reading the scene: sentences by subject.
    """

    name: str
    splits: dict[str, Views]
    video: Views | None = None
    background: Tensor = field(default_factory=lambda: torch.ones(3))
    static_reason: str = ""
    points: Tensor | None = None
    lrm_views: Views | None = None
    refine_cameras: bool = False
    notes: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def is_surrounded(self) -> bool:
        """Whether the training images show surroundings instead of a constant background.

        True if no pixel is fully transparent and, in a sample of the images, the edges of at most
        half have the background's colour.
        """
        views = self.splits["train"]
        if not views.is_opaque:
            return False
        chosen = range(0, len(views), -(-len(views) // MOST_EDGES))
        plain = [views.edge_share_of(index, self.background) > PALE_EDGE for index in chosen]
        return 2 * sum(plain) <= len(plain)


def spread(count: int, total: int) -> list[int]:
    """``count`` indices spread evenly over ``total``, both ends included."""
    if count >= total:
        return list(range(total))
    return [round(i * (total - 1) / max(count - 1, 1)) for i in range(count)]
