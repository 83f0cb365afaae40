"""Rendering of posed assemblies to antialiased RGBA images, and the demo cameras."""

import random
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from xplanes.scenes.cameras import camera_around, cast_rays, focal_length, look_at
from xplanes.synthetic.demo.posed import Posed

CAMERA_ANGLE_X = 0.6911112070083618
"""Horizontal field of view of D-NeRF's cameras, in radians."""

CAMERA_DISTANCE = 4.031128874149275
"""Distance of D-NeRF's cameras from the origin."""


def render_image(
    posed: Posed,
    camera_to_world: Tensor,
    resolution: int,
    samples: int = 2,
    angle_x: float = CAMERA_ANGLE_X,
) -> NDArray:
    """Render one image.

    Args:
        posed: The assembly at one timestep.
        camera_to_world: Camera-to-world matrix. [4, 4]
        resolution: Height and width in pixels.
        samples: Rays per pixel and axis.
        angle_x: Field of view in radians.

    Returns:
        Straight-alpha RGBA. uint8 [resolution, resolution, 4]
    """
    layers = image_samples(posed.render, camera_to_world, resolution, samples, angle_x)
    alpha = layers[..., 3:]
    straight = torch.cat([layers[..., :3] / alpha.clamp_min(1e-6), alpha], dim=-1)
    return (straight.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def image_samples(
    see: Callable[[Tensor, Tensor], Tensor],
    camera_to_world: Tensor,
    resolution: int,
    samples: int,
    angle_x: float,
) -> Tensor:
    """Mean of the values of all rays of each pixel.

    Args:
        see: Function from origins and unit directions [N, 3] to values [N, 4].
        camera_to_world: Camera-to-world matrix. [4, 4]
        resolution: Height and width in pixels.
        samples: Rays per pixel and axis.
        angle_x: Field of view in radians.

    Returns:
        [resolution, resolution, 4]
    """
    steps = (torch.arange(resolution * samples) + 0.5) / samples - 0.5
    rows, columns = torch.meshgrid(steps, steps, indexing="ij")
    origins, directions = cast_rays(
        camera_to_world.float(),
        rows.flatten(),
        columns.flatten(),
        focal=focal_length(angle_x, resolution),
        centre=(0.5 * resolution, 0.5 * resolution),
    )
    layers = see(origins, directions)
    return layers.reshape(resolution, samples, resolution, samples, 4).mean(dim=(1, 3))


def hemisphere_cameras(count: int, draw: random.Random) -> Tensor:
    """Cameras uniformly distributed over the upper hemisphere. [count, 4, 4]"""
    places = np.empty((count, 3))
    for place in places:
        height, turn = draw.uniform(0.02, 0.98), draw.uniform(0, 2 * np.pi)
        flat = np.sqrt(1 - height * height)
        place[:] = flat * np.cos(turn), flat * np.sin(turn), height
    return look_at(torch.from_numpy(places) * CAMERA_DISTANCE)


def camera_at(azimuth: float, elevation: float) -> Tensor:
    """Camera at an azimuth (from +x towards +y) and elevation in degrees. [4, 4]"""
    return camera_around(azimuth, elevation, CAMERA_DISTANCE)
