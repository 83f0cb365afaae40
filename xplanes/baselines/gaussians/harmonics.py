"""Spherical harmonics: colours of Gaussians that depend on the viewing direction."""

import torch
import torch.nn.functional as F
from torch import Tensor

MAX_DEGREE = 3
"""Highest degree, as in Kerbl et al. 2023: 16 coefficients per channel."""


def spherical_harmonics(degree: int, coefficients: Tensor, directions: Tensor) -> Tensor:
    """Evaluate sums of real spherical harmonics, with the order and signs of 3DGS files.

    Within degree l, the order m runs from -l to l, with the Condon-Shortley phase. To obtain a
    colour, 3DGS adds 0.5 to the sum and clamps negative values to 0.

    Args:
        degree: Highest degree, from 0 to 3.
        coefficients: Coefficients of each channel; the first (degree + 1)^2 of K are used.
            [N, K, 3]
        directions: From the camera to the Gaussians, of any length. [N, 3]

    Returns:
        The sums. [N, 3]

    Raises:
        ValueError: If the degree is out of range, or there are too few coefficients.
    """
    if degree not in range(MAX_DEGREE + 1):
        raise ValueError(f"degree={degree}: must be 0 to {MAX_DEGREE}")
    count = (degree + 1) ** 2
    if coefficients.shape[1] < count:
        raise ValueError(
            f"coefficients are {list(coefficients.shape)}: degree {degree} needs {count} of them"
        )
    basis = _basis(degree, F.normalize(directions, dim=-1))
    return (basis[..., None] * coefficients[:, :count]).sum(dim=1)


def _basis(degree: int, directions: Tensor) -> Tensor:
    """Harmonics of unit vectors. [N, (degree + 1)^2]"""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, 0.28209479177387814)]  # sqrt(1 / 4 pi)
    if degree > 0:
        first = 0.4886025119029199  # sqrt(3 / 4 pi)
        values += [-first * y, first * z, -first * x]
    if degree > 1:
        second = 1.0925484305920792  # sqrt(15 / 4 pi)
        values += [
            second * x * y,
            -second * y * z,
            0.31539156525252005 * (3 * z * z - 1),  # sqrt(5 / 16 pi)
            -second * x * z,
            0.5 * second * (x * x - y * y),
        ]
    if degree > 2:
        outer, middle = 0.5900435899266435, 2.890611442640554  # sqrt(35 / 32 pi), sqrt(105 / 4 pi)
        inner = 0.4570457994644658  # sqrt(21 / 32 pi)
        values += [
            -outer * y * (3 * x * x - y * y),
            middle * x * y * z,
            -inner * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),  # sqrt(7 / 16 pi)
            -inner * x * (5 * z * z - 1),
            0.5 * middle * z * (x * x - y * y),
            -outer * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, dim=-1)
