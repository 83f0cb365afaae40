"""Small triplane sequences whose parts are known: smooth features, and a blob that moves."""

import math

import torch
from torch import Tensor
from torch.nn.functional import interpolate

OPTIONS = {
    **{"width": 12, "hidden": 1, "activation": "silu"},
    **{"density": "exp", "density_scale": 2.0, "colour_margin": 0.0},
}
"""Options of a small decoder."""

AXES = ((0, 1), (0, 2), (1, 2))
"""Axes along columns and rows of the planes xy, xz, yz."""


def static_features(channels: int = 8, size: int = 16, seed: int = 0) -> Tensor:
    """Smooth random features. [3, C, H, H]"""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.randn(3, channels, 4, 4, generator=generator)
    return 0.3 * interpolate(coarse, (size, size), mode="bicubic")


def blob(frames: int = 8, channels: int = 8, size: int = 16, seed: int = 1) -> Tensor:
    """A blob that crosses the cube, zero elsewhere. [T, 3, C, H, H]"""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(3, channels, 1, 1, generator=generator)
    grid = (torch.arange(size) + 0.5) / size * 2 - 1
    timesteps = []
    for t in torch.linspace(0, 1, frames).tolist():
        centre = (1.2 * t - 0.6, 0.3 * math.sin(6 * t), 0.2 - 0.5 * t)
        bumps = [(-(((grid - place) / 0.25) ** 2)).exp() for place in centre]
        covers = [bumps[row][:, None] * bumps[column] for column, row in AXES]
        timesteps.append(features * torch.stack(covers)[:, None])
    return torch.stack(timesteps)


def moving_sequence(frames: int = 8, channels: int = 8, size: int = 16) -> Tensor:
    """Static features plus the blob. [T, 3, C, H, H]"""
    return static_features(channels, size) + blob(frames, channels, size)
