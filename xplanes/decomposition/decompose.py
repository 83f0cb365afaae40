"""A triplane sequence as the sum of a static (low-rank) and a dynamic (sparse) part."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from xplanes.decomposition.rpca import robust_pca

ORIENTATIONS = ("xy", "xz", "yz")


@dataclass(frozen=True)
class Decomposition:
    """Low-rank and sparse parts of a triplane sequence, with reports of robust PCA.

    Attributes:
        low_rank: The static part. [T, 3, C, H, W]
        sparse: The dynamic part. [T, 3, C, H, W]
        reports: Output of `RobustPCA.report` for each of "xy", "xz" and "yz".
    """

    low_rank: Tensor
    sparse: Tensor
    reports: dict[str, dict[str, Any]]


def decompose(triplanes: Tensor, **options: Any) -> Decomposition:
    """Apply robust PCA to each orientation, with one column per frame (X-Planes, Eq. 8-12).

    The columns are read in place. The tensor is copied only if it has half precision or its planes
    are not contiguous.

    Args:
        triplanes: One triplane per frame: planes xy, xz, yz, the first axis along W. Any
            floating-point type; not modified. [T, 3, C, H, W]
        **options: Options of `robust_pca` except ``out``.

    Raises:
        ValueError: If the shape is wrong, a value is NaN or infinite, or an option is out of range.
        TypeError: If the tensor is not of a floating-point type.
    """
    check_triplanes(triplanes, "triplanes")
    kind = triplanes.dtype if triplanes.dtype == torch.float64 else torch.float32
    low_rank = torch.empty(triplanes.shape, dtype=kind, device=triplanes.device)
    sparse = torch.empty_like(low_rank)
    reports = {}
    for index, name in enumerate(ORIENTATIONS):
        parts = low_rank[:, index].flatten(1).mT, sparse[:, index].flatten(1).mT
        matrix = triplanes[:, index].flatten(1).mT
        reports[name] = robust_pca(matrix, out=parts, **options).report()
    return Decomposition(low_rank, sparse, reports)


def check_triplanes(triplanes: Tensor, name: str) -> None:
    """Check that a tensor is a non-empty triplane sequence.

    Args:
        triplanes: The tensor. [T, 3, C, H, W]
        name: Its name in error messages.

    Raises:
        ValueError: For a wrong shape.
    """
    if triplanes.dim() != 5 or triplanes.shape[1] != 3 or not triplanes.numel():
        raise ValueError(
            f"{name} must be [T, 3, C, H, W] and not empty, not {tuple(triplanes.shape)}"
        )
