"""Feature-like matrices for the decomposition benchmarks.

A standing texture with slow drift, two moving discs that hide it, and noise on every entry.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import interpolate


def feature_matrix(frames: int, channels: int = 40, size: int = 64, noise: float = 0.02) -> Tensor:
    """One column per frame, root mean square near 1, float32. [channels * size * size, frames]"""
    generator = torch.Generator().manual_seed(0)

    def smooth(cells: int) -> Tensor:
        coarse = torch.randn(1, channels, cells, cells, generator=generator)
        return interpolate(coarse, (size, size), mode="bicubic")[0]

    base = smooth(8) + 0.3 * smooth(24)
    base /= base.square().mean().sqrt()
    drifts = [0.05 * smooth(6) for _ in range(3)]
    colour = 1.5 * torch.randn(channels, 1, 1, generator=generator)
    rows, columns = torch.meshgrid(*[torch.arange(size) / size] * 2, indexing="ij")
    video = torch.empty(frames, channels, size, size)
    for frame in range(frames):
        time = frame / max(frames - 1, 1)
        video[frame] = base
        for order, drift in enumerate(drifts):
            video[frame] += math.sin(2 * math.pi * 0.7 * time * (order + 1) + order) * drift
        discs = (
            (0.5 + 0.3 * math.cos(5 * time), 0.5 + 0.3 * math.sin(5 * time), 0.09, 1.0),
            (0.2 + 0.6 * time, 0.3 + 0.2 * math.sin(9 * time), 0.06, -1.0),
        )
        for x, y, radius, sign in discs:
            inside = (columns - x) ** 2 + (rows - y) ** 2 < radius**2
            shading = 1 + 0.2 * torch.sin(20 * (columns - x))
            video[frame] = torch.where(inside, sign * colour * shading, video[frame])
    video += noise * torch.randn(video.shape, generator=generator)
    return video.flatten(1).mT.contiguous()
