"""Intersection of rays with the field's cube, and evaluation of the field at their samples."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Field = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Maps points [N, 3] and times [N] to colour [N, 3] and density [N]."""


def ray_box(origins: Tensor, directions: Tensor, half: float = 1.0) -> tuple[Tensor, Tensor]:
    """Distances at which rays enter and leave the cube [-half, half]^3.

    Args:
        origins: Ray origins. [R, 3]
        directions: Ray directions; distances are in units of their length. [R, 3]
        half: Half the side of the cube.

    Returns:
        Near and far, near >= 0 (0 from inside). Both are 0 for a ray that misses the cube, has
        direction 0 or contains a NaN. [R], [R]
    """
    # A ray parallel to a face divides by zero. The slab test works with the infinities that result;
    # 0 * inf (a ray within a face) counts as inside that slab.
    inverse = directions.reciprocal()
    first, second = (-half - origins) * inverse, (half - origins) * inverse
    near = torch.minimum(first, second).nan_to_num(-torch.inf, torch.inf, -torch.inf)
    far = torch.maximum(first, second).nan_to_num(torch.inf, torch.inf, -torch.inf)
    near, far = near.amax(dim=-1).clamp_min(0), far.amin(dim=-1)
    hit = (far > near) & (far + origins.sum(dim=-1) + directions.sum(dim=-1)).isfinite()
    return torch.where(hit, near, 0), torch.where(hit, far, 0)


def snapshot(field: Any, time: float) -> Any:
    """The `RadianceField.snapshot` of a field at one time, if it has that method, else itself."""
    taken = getattr(field, "snapshot", None)
    return field if taken is None else taken(time)


def shade(
    field: Any, points: Tensor, times: Tensor, directions: Tensor, ray: Tensor
) -> tuple[Tensor, Tensor]:
    """Colour and density at the samples of rays.

    Args:
        field: Maps points and times, and also directions if it is ``view_dependent``.
        points: Positions of the samples. [N, 3]
        times: Time of each ray. [R]
        directions: Unit direction of each ray. [R, 3]
        ray: Ray of each sample. [N]

    Returns:
        [N, 3], [N]
    """
    if getattr(field, "view_dependent", False):
        return field(points, times[ray], directions[ray])
    return field(points, times[ray])
