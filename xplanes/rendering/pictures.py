"""Tensors as pictures: strips of a view, depth in colours, sheets of planes."""

from collections.abc import Mapping
from pathlib import Path

import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from xplanes.files import replacing

_RAMP = torch.tensor(
    [[13, 8, 135], [126, 3, 168], [204, 71, 120], [248, 149, 64], [240, 249, 33]]
).div(255)
"""Five colours from dark blue via magenta to yellow, evenly spaced in lightness."""


def colour_map(values: Tensor) -> Tensor:
    """Maps numbers from 0 to 1 to colours, from dark to light. [...] -> [..., 3]"""
    place = values.nan_to_num(0).clamp(0, 1) * (len(_RAMP) - 1)
    lower = place.long().clamp(max=len(_RAMP) - 2)
    ramp = _RAMP.to(values.device)
    return torch.lerp(ramp[lower], ramp[lower + 1], (place - lower)[..., None])


def depth_picture(depth: Tensor, opacity: Tensor) -> Tensor:
    """Depth as colours: near is light, transparent is white. [H, W], [H, W] -> [H, W, 3]"""
    seen = opacity > 0.5
    if not seen.any():
        return torch.ones(*depth.shape, 3)
    near, far = depth[seen].aminmax()
    colours = colour_map(1 - 0.9 * (depth - near) / (far - near).clamp_min(1e-6))
    return torch.where(seen[..., None], colours, 1.0)


STRIP = ("truth", "colour", "error", "depth")
"""Pictures of a `strip`, from left to right."""


def strip(truth: Tensor, colour: Tensor, depth: Tensor, opacity: Tensor) -> Tensor:
    """Truth, prediction, error (x 4) and depth side by side.

    Args:
        truth: True colours. [H, W, 3]
        colour: Rendered colours. [H, W, 3]
        depth: Rendered depth. [H, W]
        opacity: Rendered opacity. [H, W]

    Returns:
        One picture. [H, 4 W, 3]
    """
    error = colour_map(4 * (colour - truth).abs().mean(dim=-1))
    return torch.cat([truth, colour, error, depth_picture(depth, opacity)], dim=1)


def first_colours(planes: Tensor) -> Tensor:
    """The first three channels, the first one for missing ones. [..., C, H, W] -> [..., 3, H, W]"""
    channels = [channel if channel < planes.shape[-3] else 0 for channel in range(3)]
    return planes[..., channels, :, :].detach().float().cpu()


def plane_sheet(planes: Mapping[str, Tensor]) -> Tensor:
    """Feature planes as pictures, three channels of each as colours, three pictures per row.

    Args:
        planes: Planes by name. [C, rows, columns] each

    Returns:
        One picture. [H, W, 3]
    """
    tiles = []
    for plane in planes.values():
        shown = first_colours(plane)
        spread = 2.5 * shown.std().clamp_min(1e-8)
        shown = ((shown - shown.mean()) / (2 * spread) + 0.5).clamp(0, 1)
        tile = F.interpolate(shown[None], size=(128, 128), mode="nearest")[0].permute(1, 2, 0)
        tiles.append(F.pad(tile, (0, 0, 2, 2, 2, 2), value=1.0))
    while len(tiles) % 3:
        tiles.append(torch.ones_like(tiles[0]))
    rows = [torch.cat(tiles[i : i + 3], dim=1) for i in range(0, len(tiles), 3)]
    return torch.cat(rows)


def to_bytes(picture: Tensor) -> Tensor:
    """Colours from 0 to 1 as bytes. [H, W, 3] -> uint8 [H, W, 3]"""
    return (picture.detach().cpu().clamp(0, 1) * 255 + 0.5).to(torch.uint8)


def write_png(path: Path, picture: Tensor) -> None:
    """Write a picture with colours from 0 to 1 atomically. [H, W, 3]"""
    with replacing(path) as temporary:
        Image.fromarray(to_bytes(picture).numpy()).save(temporary, format="PNG")
