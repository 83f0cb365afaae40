"""Linear interpolation of planes as products with small matrices: cheap and differentiable."""

import torch
from torch import Tensor


def space_weights(size_out: int, size_in: int, like: Tensor) -> Tensor:
    """Weights that sample a spatial axis at the cell centres of another resolution.

    The convention is that of LRM planes: ``align_corners=False``, zero outside.

    Args:
        size_out: Cells to sample at.
        size_in: Cells of the plane.
        like: A tensor whose type and device to use.

    Returns:
        One row per sampled cell. [size_out, size_in]
    """
    centres = (torch.arange(size_out, dtype=torch.float64, device=like.device) + 0.5) / size_out
    return _hat(centres * size_in - 0.5, size_in).to(like.dtype)


def time_weights(times: Tensor, size: int, like: Tensor) -> Tensor:
    """Weights that sample the time axis: time t lies at row ``t * (size - 1)``.

    Args:
        times: Times in [0, 1]; clamped to it. [B]
        size: Rows of the plane along time.
        like: A tensor whose type and device to use.

    Returns:
        One row per time. [B, size]
    """
    position = times.to(like.device, torch.float64).clamp(0, 1) * (size - 1)
    return _hat(position, size).to(like.dtype)


def _hat(positions: Tensor, size: int) -> Tensor:
    nodes = torch.arange(size, dtype=torch.float64, device=positions.device)
    return (1 - (positions[:, None] - nodes).abs()).clamp_min(0)
