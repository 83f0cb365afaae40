"""Base classes of renderers: results for rays, and whole images."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from xplanes.rendering.box import snapshot
from xplanes.rendering.marching import Samples
from xplanes.scenes.cameras import PosedCamera
from xplanes.scenes.frame import Frame


@dataclass(frozen=True)
class Rendering:
    """Rendered rays.

    Attributes:
        colour: Colour, background included. [R, 3]
        opacity: Accumulated opacity. [R]
        depth: Expected depth, 0 where opacity is 0. [R]
        density: Density of each sample, without gradient. [N]
        samples: The samples that reached the field.
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    density: Tensor
    samples: Samples

    @property
    def shown(self) -> Tensor | None:
        """Whether the samples of each ray fitted the slots; None if all did. bool [R]"""
        return getattr(self.samples, "shown", None)


class Renderer(ABC):
    """Renders images of a field from cameras."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Device on which images are rendered."""

    @abstractmethod
    def view(
        self, field: Any, frame: Frame, camera: PosedCamera, time: float, background: Tensor
    ) -> dict[str, Tensor]:
        """Render the image of a camera at one time.

        Args:
            field: A field that the renderer accepts.
            frame: The field's frame.
            camera: A camera in the world.
            time: From 0 to 1.
            background: Colour behind the scene. [3]

        Returns:
            ``colour`` [H, W, 3], ``opacity`` [H, W], and ``depth`` along the rays in units of the
            field's frame [H, W], on the renderer's device.
        """


def leave_empty(image: dict[str, Tensor], where: Tensor, background: Tensor) -> None:
    """Set pixels to the background, with opacity and depth 0.

    Args:
        image: Result of `Renderer.view`; changed in place.
        where: The pixels, such as those for which a fisheye lens has no ray. bool [H, W]
        background: Colour behind the scene. [3]
    """
    for name, value in image.items():
        value[where.to(value.device)] = background.to(value) if name == "colour" else 0


class RayRenderer(Renderer):
    """Base class of renderers that trace rays through a field.

    Attributes:
        rays_at_once: Rays of an image rendered together on the CPU; twice as many on a GPU.
    """

    rays_at_once = 4096

    def reaches(self, points: Tensor) -> Tensor:
        """Whether points of the cube [N, 3] can have samples: by default all of them. bool [N]"""
        return torch.ones_like(points[:, 0], dtype=torch.bool)

    def view(
        self, field: Any, frame: Frame, camera: PosedCamera, time: float, background: Tensor
    ) -> dict[str, Tensor]:
        device, shape = self.device, (camera.height, camera.width)
        origins, directions = (ray.to(device) for ray in frame.rays(*camera.rays()))
        image = self.image(field, origins, directions, time, background.to(device))
        return {name: value.view(*shape, *value.shape[1:]) for name, value in image.items()}

    @abstractmethod
    def render(
        self,
        field: Any,
        origins: Tensor,
        directions: Tensor,
        times: Tensor,
        background: Tensor,
        jitter: Any = None,
    ) -> Rendering:
        """Render rays.

        Args:
            field: A field that the renderer accepts.
            origins: Ray origins in the field's frame. [R, 3]
            directions: Unit directions. [R, 3]
            times: Time of each ray, from 0 to 1. [R]
            background: Colour behind the scene. [3] or [R, 3]
            jitter: Offsets of samples within their steps in training; the middle when None.

        Returns:
            One value per ray; gradients reach the field.
        """

    def pixels(
        self, field: Any, origins: Tensor, directions: Tensor, times: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Colour, opacity and depth of rays without gradients. [R, 3], [R], [R]

        Overridden by renderers for which images are cheaper than training batches.
        """
        seen = self.render(field, origins, directions, times, background)
        return seen.colour, seen.opacity, seen.depth

    def for_image(self, field: Any, time: float, rays: int) -> "RayRenderer":
        """The renderer to use for an image; itself by default.

        Args:
            field: The field, or its snapshot at that time.
            time: Time of the image, from 0 to 1.
            rays: Number of its rays.
        """
        return self

    @torch.no_grad()
    def image(
        self, field: Any, origins: Tensor, directions: Tensor, time: float, background: Tensor
    ) -> dict[str, Tensor]:
        """Render any number of rays of one timestep, a chunk at a time.

        Returns:
            ``colour`` [R, 3], ``opacity`` [R] and ``depth`` [R], on the rays' device.
        """
        field, parts = snapshot(field, time), []
        renderer = self.for_image(field, time, len(origins))
        chunk = self.rays_at_once * (1 if self.device.type == "cpu" else 2)
        for start in range(0, max(len(origins), 1), chunk):
            rays = origins[start : start + chunk], directions[start : start + chunk]
            times = torch.full_like(rays[0][:, 0], time)
            parts.append(renderer.pixels(field, *rays, times, background))
        colour, opacity, depth = (torch.cat(part) for part in zip(*parts, strict=True))
        return {"colour": colour, "opacity": opacity, "depth": depth}
