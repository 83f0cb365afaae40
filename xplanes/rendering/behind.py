"""What rays see behind the field's cube."""

from typing import Any

import torch
from torch import Tensor

from xplanes.fields.background import RADIUS, Background, contract
from xplanes.rendering.box import ray_box
from xplanes.rendering.compositing import OPAQUE, composite

DARK = 1e-3
"""Share of the light that must pass the cube for a ray to look behind it."""


def behind(
    field: Any,
    origins: Tensor,
    directions: Tensor,
    opacity: Tensor,
    plain: Tensor,
    jitter: Tensor | None = None,
) -> Tensor:
    """Colours behind the cube: of the field's background where it has one, else a plain one.

    Args:
        field: Its ``background`` is a `Background`, None, or not there.
        origins: Ray origins in the field's frame. [R, 3]
        directions: Unit directions. [R, 3]
        opacity: Share of each ray's light that the cube stops; the background of rays that it
            stops whole is not computed, and black. [R]
        plain: Colour behind a field without a background. [3] or [R, 3]
        jitter: Place of each ray's samples within their steps; the middle when None. [R]

    Returns:
        Gradients reach the background. [3] or [R, 3]
    """
    background: Background | None = getattr(field, "background", None)
    if background is None:
        return plain
    clear = opacity.detach() < 1 - DARK
    if clear.device.type != "cpu":
        # Looking for those few would be waited for.
        return torch.where(clear[:, None], look(background, origins, directions, jitter), 0)
    seen = clear.nonzero()[:, 0]
    place = None if jitter is None else jitter[seen]
    colour = look(background, origins[seen], directions[seen], place)
    black = torch.zeros_like(directions, dtype=colour.dtype)
    return black.index_put((seen,), colour)


def look(
    background: Background, origins: Tensor, directions: Tensor, jitter: Tensor | None = None
) -> Tensor:
    """Colours that rays see in a background, from where they leave the cube to infinity.

    Samples are even in inverse distance, and the last one, at infinity, is opaque. A ray that
    misses the cube looks from half its origin's distance from the cube's centre on.

    Args:
        background: The background.
        origins: Ray origins in the field's frame. [R, 3]
        directions: Unit directions. [R, 3]
        jitter: Place of each ray's samples within their steps; the middle when None. [R]

    Returns:
        [R, 3]
    """
    rays, count = len(origins), background.samples
    far = ray_box(origins, directions)[1]
    first = torch.where(far > 0, far, 0.5 * origins.norm(dim=-1))[:, None]
    steps = torch.arange(count, device=origins.device)
    within = 0.5 if jitter is None else jitter[:, None]
    horizon = RADIUS * directions[:, None]
    ends = _at(origins, directions, first / (1 - steps / count))
    lengths = torch.cat([ends, horizon], dim=1).diff(dim=1).norm(dim=-1)
    points = _at(origins, directions, first / (1 - (steps + within) / count))
    points = torch.cat([points, horizon], dim=1)
    colour, density = background(points.flatten(0, 1))
    depth = torch.cat(
        [density.view(rays, count + 1)[:, :-1] * lengths, torch.full_like(first, OPAQUE)], dim=1
    )
    index = torch.arange(rays, device=origins.device)
    total, _ = composite(
        depth.flatten(),
        colour,
        torch.zeros_like(depth).flatten(),
        index.repeat_interleave(count + 1),
        index * (count + 1),
    )
    return total[:, :3]


def _at(origins: Tensor, directions: Tensor, distances: Tensor) -> Tensor:
    """Contracted points at distances along rays. [R, S] -> [R, S, 3]"""
    return contract(origins[:, None] + distances[..., None] * directions[:, None])
