"""View-independent (Lambertian) shading."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Light:
    """A sun, a sky that is brightest at the zenith, and ambient light.

    Attributes:
        towards: Direction from the scene to the sun; any length.
        sun: Intensity of the sun on a face towards it.
        sky: Intensity of the sky on a face that points up.
        ambient: Intensity of the ambient light.
        shadow: Fraction of the sunlight that a shadow removes, in [0, 1]; 0 casts no shadow rays.
    """

    towards: tuple[float, float, float] = (0.35, -0.5, 0.8)
    sun: float = 0.5
    sky: float = 0.22
    ambient: float = 0.38
    shadow: float = 0.6

    def direction(self, like: Tensor) -> Tensor:
        """Unit direction to the sun, with the type and device of ``like``. [3]"""
        return torch.nn.functional.normalize(like.new_tensor(self.towards), dim=0)

    def shade(self, colours: Tensor, normals: Tensor, shadowed: Tensor | None = None) -> Tensor:
        """Lambertian shading.

        Args:
            colours: Colours of the surfaces. [N, 3]
            normals: Outward unit normals. [N, 3]
            shadowed: Whether points lie in shadow. bool [N]

        Returns:
            Shaded colours, in [0, 1]. [N, 3]
        """
        facing = (normals @ self.direction(normals)).clamp_min(0) * self.sun
        if shadowed is not None:
            facing = torch.where(shadowed, (1 - self.shadow) * facing, facing)
        light = facing + self.ambient + self.sky * (0.5 + 0.5 * normals[:, 2])
        return (colours * light[:, None]).clamp(0, 1)
