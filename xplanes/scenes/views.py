"""Posed, timed images of a scene, held in memory as bytes."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from xplanes.scenes.cameras import pixel_rays
from xplanes.scenes.errors import SceneError


@dataclass(frozen=True)
class Views:
    """The images of one split with their cameras.

    Attributes:
        images: Colour, already multiplied by alpha, and alpha. uint8 [V, H, W, 4]
        camera_to_world: Rigid camera poses. [V, 4, 4]
        times: Time of each image, from 0 to 1. [V]
        focal: Focal length in pixels, equal on both axes.
        files: Name of each image, relative to the scene's folder.
    """

    images: Tensor
    camera_to_world: Tensor
    times: Tensor
    focal: float
    files: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.files)

    @property
    def height(self) -> int:
        """Rows of every image."""
        return self.images.shape[1]

    @property
    def width(self) -> int:
        """Columns of every image."""
        return self.images.shape[2]

    @property
    def is_still(self) -> bool:
        """Whether all views show one moment, so that nothing can move."""
        return bool((self.times == self.times[0]).all())

    @property
    def nbytes(self) -> int:
        """Bytes that the images take in memory."""
        return self.images.numel()

    def subset(self, indices: Tensor) -> "Views":
        """The views at ``indices``, in that order. [K]"""
        return Views(
            self.images[indices],
            self.camera_to_world[indices],
            self.times[indices],
            self.focal,
            tuple(self.files[i] for i in indices.tolist()),
        )

    def composite(self, index: int, background: Tensor) -> Tensor:
        """Image ``index`` as floats in [0, 1] in front of ``background`` [3]. [H, W, 3]"""
        image = self.images[index].float() / 255
        return image[..., :3] + (1 - image[..., 3:]) * background

    def image_rays(self, index: int) -> tuple[Tensor, Tensor]:
        """Rays through every pixel of image ``index``, row by row. [H W, 3], [H W, 3]"""
        return camera_rays(self.camera_to_world[index], self.focal, self.height, self.width)


def joined(first: Views, second: Views) -> Views:
    """The views of both.

    Raises:
        SceneError: If their sizes or focal lengths differ.
    """
    for what in ("height", "width", "focal"):
        one, other = getattr(first, what), getattr(second, what)
        if abs(one - other) > 1e-4 * one:
            raise SceneError(
                f"{first.files[0]} and {second.files[0]} cannot be trained on together: {what} "
                f"{one:g} and {other:g} pixels; set data.train_on_video=false"
            )
    return Views(
        torch.cat([first.images, second.images]),
        torch.cat([first.camera_to_world, second.camera_to_world]),
        torch.cat([first.times, second.times]),
        first.focal,
        first.files + second.files,
    )


@dataclass(frozen=True)
class Scene:
    """A filmed scene.

    Attributes:
        name: Name for titles and run directories.
        splits: Views by split name: train, val, test.
        video: Frames of a fixed camera, where the scene has one.
        background: What lies behind the scene in scores and pictures. [3]
        still: How it is known that nothing moves; empty where something may.
    """

    name: str
    splits: dict[str, Views]
    video: Views | None = None
    background: Tensor = field(default_factory=lambda: torch.ones(3))
    still: str = ""


def camera_rays(
    camera_to_world: Tensor, focal: float, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """Rays through every pixel of one camera, row by row. [H W, 3], [H W, 3]"""
    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=torch.float32),
        torch.arange(width, dtype=torch.float32),
        indexing="ij",
    )
    return pixel_rays(
        camera_to_world,
        rows.flatten(),
        columns.flatten(),
        focal=focal,
        height=height,
        width=width,
    )
