"""Surroundings of an object: opaque images, and masks of the object."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from xplanes.synthetic.demo.assembly import Assembly, Part
from xplanes.synthetic.demo.geometry import Colour
from xplanes.synthetic.demo.render import CAMERA_ANGLE_X, image_samples

CLOUDS = 0.06
"""Amplitude of the variation of the sky's colour."""


@dataclass(frozen=True)
class World:
    """Static surroundings of an object.

    Attributes:
        parts: Parts of the surroundings, including the ground.
        zenith: Colour of the sky at the zenith.
        horizon: Colour of the sky at the horizon; distant surfaces fade to it.
        haze: Distance at which surfaces have faded by 63%.
    """

    parts: tuple[Part, ...]
    zenith: Colour
    horizon: Colour
    haze: float = 40.0

    def sky(self, directions: Tensor) -> Tensor:
        """Colour of the sky along unit directions. [N, 3] -> [N, 3]"""
        x, y, z = directions.unbind(dim=-1)
        height = z.clamp_min(0).sqrt()[:, None]
        low, high = (directions.new_tensor(colour) for colour in (self.horizon, self.zenith))
        clouds = (7 * x + 2 * (5 * z).sin()).sin() * (23 * z - 3 * (4 * y).sin()).sin()
        return (torch.lerp(low, high, height) + CLOUDS * height * clouds[:, None]).clamp(0, 1)

    def picture(
        self,
        thing: Assembly,
        time: float,
        camera_to_world: Tensor,
        resolution: int,
        samples: int = 2,
        angle_x: float = CAMERA_ANGLE_X,
    ) -> tuple[NDArray, NDArray]:
        """Render one image of an object with these surroundings.

        Args:
            thing: The object.
            time: From 0 to 1.
            camera_to_world: Camera-to-world matrix. [4, 4]
            resolution: Height and width in pixels.
            samples: Rays per pixel and axis.
            angle_x: Field of view in radians.

        Returns:
            Colours, uint8 [resolution, resolution, 3], and the share of each pixel that the object
            covers, uint8 [resolution, resolution].
        """
        whole = replace(thing, parts=(*thing.parts, *self.parts)).pose(time)

        def see(origins: Tensor, directions: Tensor) -> Tensor:
            hits = whole.cast(origins, directions)
            far = (-hits.distance / self.haze).exp()[:, None]
            colour = torch.lerp(directions.new_tensor(self.horizon), hits.colour, far)
            colour = torch.where(hits.part[:, None] < 0, self.sky(directions), colour)
            own = (hits.part >= 0) & (hits.part < len(thing.parts))
            return torch.cat([colour, own[:, None].float()], dim=-1)

        layers = image_samples(see, camera_to_world, resolution, samples, angle_x)
        shown = (layers.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        return np.ascontiguousarray(shown[..., :3]), np.ascontiguousarray(shown[..., 3])
