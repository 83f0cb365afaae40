"""What all renderers share: what rays see, and whole images of it."""

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
    """What rays see.

    Attributes:
        colour: In front of the background. [R, 3]
        opacity: Share of the light that the scene stops. [R]
        depth: Mean distance of what is seen, 0 where nothing is. [R]
        density: Density of each sample, without gradient. [N]
        samples: The samples that reached the field.
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    density: Tensor
    samples: Samples


class Renderer(ABC):
    """Renders what cameras see of a scene."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Where images are rendered."""

    @abstractmethod
    def view(
        self, field: Any, frame: Frame, camera: PosedCamera, time: float, background: Tensor
    ) -> dict[str, Tensor]:
        """Render what a camera sees at one time.

        Args:
            field: What the renderer takes as a field.
            frame: The field's frame.
            camera: A camera in the world.
            time: From 0 to 1.
            background: Colour behind the scene. [3]

        Returns:
            ``colour`` [H, W, 3], ``opacity`` [H, W], and ``depth`` along the rays in units of the
            field's frame [H, W], on the renderer's device.
        """


def leave_empty(image: dict[str, Tensor], where: Tensor, background: Tensor) -> None:
    """Make pixels background, with opacity and depth of 0.

    Args:
        image: What `Renderer.view` gives; changed in place.
        where: The pixels, such as those that a fisheye lens has no ray for. bool [H, W]
        background: Colour behind the scene. [3]
    """
    for name, value in image.items():
        value[where.to(value.device)] = background.to(value) if name == "colour" else 0


class RayRenderer(Renderer):
    """Renders rays through a field, in a way of its own.

    Attributes:
        rays_at_once: Rays of an image rendered together on the CPU; a GPU takes twice as many.
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
            field: What the renderer takes as a field.
            origins: Ray origins in the field's frame. [R, 3]
            directions: Unit directions. [R, 3]
            times: Time of each ray, from 0 to 1. [R]
            background: Colour behind the scene. [3] or [R, 3]
            jitter: What moves samples within their steps in training; None takes the middle.

        Returns:
            One value per ray; gradients reach the field.
        """

    def pixels(
        self, field: Any, origins: Tensor, directions: Tensor, times: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Colour, opacity and depth of rays without gradients. [R, 3], [R], [R]

        A renderer overrides this where an image can be had for less than what training needs.
        """
        seen = self.render(field, origins, directions, times, background)
        return seen.colour, seen.opacity, seen.depth

    @torch.no_grad()
    def image(
        self,
        field: Any,
        origins: Tensor,
        directions: Tensor,
        time: float,
        background: Tensor,
        *,
        chunk: int | None = None,
    ) -> dict[str, Tensor]:
        """Render any number of rays of one timestep, a chunk at a time.

        Returns:
            ``colour`` [R, 3], ``opacity`` [R] and ``depth`` [R], on the rays' device.
        """
        field, parts = snapshot(field, time), []
        chunk = chunk or self.rays_at_once * (1 if self.device.type == "cpu" else 2)
        for start in range(0, max(len(origins), 1), chunk):
            rays = origins[start : start + chunk], directions[start : start + chunk]
            times = torch.full_like(rays[0][:, 0], time)
            parts.append(self.pixels(field, *rays, times, background))
        colour, opacity, depth = (torch.cat(part) for part in zip(*parts, strict=True))
        return {"colour": colour, "opacity": opacity, "depth": depth}
