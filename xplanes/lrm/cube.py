"""Another cube for a triplane: more or less room around the middle."""

import math

import torch.nn.functional as F
from torch import Tensor

MOST = 2.0
"""A cube grows by this factor at most: what lies beyond is not the model's to say."""


def fit_cube(triplanes: Tensor, half_side: float, wanted: float) -> tuple[Tensor, float]:
    """Add or take texels on all sides until the planes span another cube.

    Inside both cubes the field stays the same function. What is added continues the border texels.

    Args:
        triplanes: Planes xy, xz, yz. [T, 3, C, H, H]
        half_side: Half the side of the cube that they span.
        wanted: Half the side of the cube that they are to hold.

    Returns:
        The planes, and half the side of their cube: ``wanted``, rounded up to whole texels.
        [T, 3, C, H', H']
    """
    size = triplanes.shape[-1]
    texel = 2 * half_side / size
    span = min(wanted, MOST * half_side)
    # A hair more than a whole number of texels is that number.
    texels = math.ceil((span - half_side) / texel - 1e-6)
    if not texels:
        return triplanes, half_side
    flat = triplanes.flatten(0, 1)
    if texels > 0:
        flat = F.pad(flat, (texels,) * 4, mode="replicate")
    else:
        flat = flat[..., -texels:texels, -texels:texels]
    return flat.unflatten(0, triplanes.shape[:2]), half_side + texels * texel
