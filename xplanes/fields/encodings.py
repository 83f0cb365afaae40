"""Fixed encodings of positions, times and directions."""

import math

import torch
from torch import Tensor


def octaves(values: Tensor, count: int) -> Tensor:
    """The values, then their sines and cosines at ``count`` frequencies 1, 2, 4, ...

    Args:
        values: What to encode. [N, D]
        count: Number of frequencies; 0 leaves the values alone.

    Returns:
        Values, then sines and cosines, frequency by frequency. [N, D (1 + 2 count)]

    Source: NeRF, Eq. 4, without the factor pi.
    """
    parts = [values]
    for power in range(count):
        parts += [(values * 2**power).sin(), (values * 2**power).cos()]
    return torch.cat(parts, dim=-1)


def spherical_harmonics(directions: Tensor) -> Tensor:
    """The 16 real spherical harmonics up to degree 3, with the Condon-Shortley phase.

    Args:
        directions: Unit vectors. [N, 3]

    Returns:
        Degree by degree, order from -l to l. [N, 16]
    """
    x, y, z = directions.unbind(dim=-1)
    xx, yy, zz = x * x, y * y, z * z
    pi = math.pi
    one, two, three = math.sqrt(3 / pi) / 2, math.sqrt(15 / pi) / 2, math.sqrt(5 / pi) / 4
    outer, inner = math.sqrt(35 / (2 * pi)) / 4, math.sqrt(21 / (2 * pi)) / 4
    middle, axis = math.sqrt(105 / pi) / 2, math.sqrt(7 / pi) / 4
    return torch.stack(
        [
            torch.full_like(x, 0.5 / math.sqrt(pi)),
            -one * y,
            one * z,
            -one * x,
            two * x * y,
            -two * y * z,
            three * (3 * zz - 1),
            -two * x * z,
            two / 2 * (xx - yy),
            outer * y * (yy - 3 * xx),
            middle * x * y * z,
            inner * y * (1 - 5 * zz),
            axis * z * (5 * zz - 3),
            inner * x * (1 - 5 * zz),
            middle / 2 * z * (xx - yy),
            outer * x * (3 * yy - xx),
        ],
        dim=-1,
    )
