"""Light that does not depend on where the camera stands."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Light:
    """A sun, a sky that is brighter above, and light from everywhere.

    Attributes:
        towards: Direction from the scene to the sun; any length.
        sun: Strength of the sun on a face turned to it.
        sky: Strength of the sky on a face turned up.
        ambient: Strength of the light from everywhere.
        shadow: Share of the sun that a shadow takes away; 0 casts no shadow rays.
    """

    towards: tuple[float, float, float] = (0.35, -0.5, 0.8)
    sun: float = 0.5
    sky: float = 0.22
    ambient: float = 0.38
    shadow: float = 0.6

    def direction(self, like: Tensor) -> Tensor:
        """Unit direction to the sun, of the kind and device of ``like``. [3]"""
        return torch.nn.functional.normalize(like.new_tensor(self.towards), dim=0)

    def shade(self, colours: Tensor, normals: Tensor, shadowed: Tensor | None = None) -> Tensor:
        """Lambert's law.

        Args:
            colours: Colours of the surfaces. [N, 3]
            normals: Outward unit normals. [N, 3]
            shadowed: Which points the sun does not reach. bool [N]

        Returns:
            Colours as seen, in [0, 1]. [N, 3]
        """
        facing = (normals @ self.direction(normals)).clamp_min(0) * self.sun
        if shadowed is not None:
            facing = torch.where(shadowed, (1 - self.shadow) * facing, facing)
        light = facing + self.ambient + self.sky * (0.5 + 0.5 * normals[:, 2])
        return (colours * light[:, None]).clamp(0, 1)
