"""Time planes that minimise the product loss frame by frame, on the triplanes' own grid."""

import torch
from torch import Tensor

_SLICES = 256
_POWER_ITERATIONS = 30
_SWEEPS = 15


def rank1_factors(planes: Tensor) -> tuple[Tensor, Tensor]:
    """Best rank-1 product of every slice: the minimiser of the product loss for nine planes.

    Power iteration from the longest row; slices that are zero are not touched. Each pair is signed
    like the one of the frame before, so that interpolation in time does not pass through zero.

    Args:
        planes: One orientation of the sparse part. [T, C, H, W]

    Returns:
        Factors along the width and along the rows, each with half of the magnitude, so that
        ``rows x width`` is the slice. [T, W, C], [T, H, C]
    """
    frames, channels, height, width = planes.shape
    slices = planes.reshape(-1, height, width)
    kind = planes.dtype if planes.dtype == torch.float64 else torch.float32
    first = torch.zeros(len(slices), width, dtype=kind, device=planes.device)
    second = torch.zeros(len(slices), height, dtype=kind, device=planes.device)
    active = slices.abs().amax(dim=(1, 2)).nonzero()[:, 0]
    for chosen in active.split(_SLICES):
        # In units of the largest entry the squares stay in range for any scale.
        part = slices[chosen].to(kind)
        unit = part.abs().amax(dim=(1, 2), keepdim=True)
        part = part / unit
        longest = part.square().sum(-1).argmax(-1)
        right = part[torch.arange(len(part), device=part.device), longest][..., None]
        for _ in range(_POWER_ITERATIONS):
            right = part.mT @ (part @ right)
            right = right / torch.linalg.vector_norm(right, dim=1, keepdim=True)
        left = part @ right
        root = torch.linalg.vector_norm(left, dim=1, keepdim=True).sqrt()
        first[chosen] = (right * root * unit.sqrt())[..., 0]
        second[chosen] = (left / root * unit.sqrt())[..., 0]
    wide = first.view(frames, channels, width).mT
    tall = second.view(frames, channels, height).mT
    signs = _running_signs(wide, tall)
    return wide * signs, tall * signs


def shared_factors(sparse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Time planes xt, yt, zt of six planes, each shared by two orientations.

    Alternating least squares per frame and channel: with two factors fixed the third has a closed
    form, so the product loss never rises. It starts from the rank-1 pairs of each orientation,
    every factor as the mean of its two candidates with their signs made equal.

    Args:
        sparse: The sparse part, square planes. [T, 3, C, N, N]

    Returns:
        Factors along x, y and z. [T, N, C], [T, N, C], [T, N, C]
    """
    few = max(1, _SLICES // sparse.shape[2])
    parts = [_shared_in_cache(frames) for frames in sparse.split(few)]
    x, y, z = (torch.cat(factors) for factors in zip(*parts, strict=True))
    signs = _running_signs(x, y, z)
    # The product of any two keeps its value only if all three are flipped together.
    return x * signs, y * signs, z * signs


def _shared_in_cache(sparse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    pairs = [[f.mT[..., None] for f in rank1_factors(sparse[:, i])] for i in range(3)]
    (x1, y1), (x2, z1), (y2, z2) = pairs
    x2, z1 = (factor * _sign(x1, x2) for factor in (x2, z1))
    y2, z2 = (factor * _sign(y1, y2) for factor in (y2, z2))
    x, y, z = (x1 + x2) / 2, (y1 + y2) / 2, (z1 + z2 * _sign(z1, z2)) / 2
    xy, xz, yz = sparse.to(x.dtype).unbind(1)
    for _ in range(_SWEEPS):
        x = _solve(xy.mT @ y + xz.mT @ z, y, z)
        y = _solve(xy @ x + yz.mT @ z, x, z)
        z = _solve(xz @ x + yz @ y, x, y)
    return x[..., 0].mT, y[..., 0].mT, z[..., 0].mT


def _solve(right_side: Tensor, first: Tensor, second: Tensor) -> Tensor:
    weight = first.square().sum(-2, keepdim=True) + second.square().sum(-2, keepdim=True)
    return torch.where(weight > 0, right_side / weight.clamp_min(1e-30), 0)


def _sign(first: Tensor, second: Tensor) -> Tensor:
    agreement = (first * second).sum(-2, keepdim=True)
    return torch.where(agreement < 0, -1.0, 1.0).to(first)


def _running_signs(*factors: Tensor) -> Tensor:
    """Signs that keep a frame's factors, taken together, from opposing the frame before.

    Args:
        *factors: Factors of the same frames and channels. [T, N, C] each

    Returns:
        One sign per frame and channel. [T, 1, C]
    """
    agreement = torch.stack([(f[1:] * f[:-1]).sum(1) for f in factors]).sum(0)
    flips = torch.where(agreement < 0, -1.0, 1.0).to(factors[0])
    return torch.cat([torch.ones_like(factors[0][:1, 0]), flips]).cumprod(0)[:, None]
