"""The background of rays, behind the field's bounding box."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from xplanes.fields.background import RADIUS, Background, contract
from xplanes.rendering.box import ray_box
from xplanes.rendering.compositing import OPAQUE, composite

DARK = 1e-3
"""Transmittance of the field below which a ray's background is not computed."""

Ends = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Maps ray origins and directions to entry and exit distances for a box, as `ray_box` does.

[R, 3], [R, 3] -> [R], [R]
"""


def behind(
    field: Any,
    origins: Tensor,
    directions: Tensor,
    opacity: Tensor,
    constant: Tensor,
    jitter: Tensor | None = None,
    ends: Ends = ray_box,
) -> Tensor:
    """Colours behind a field: its learnt background if it has one, else a constant colour.

    Args:
        field: A field whose ``background`` is a `Background`, None or missing.
        origins: Ray origins in the field's frame. [R, 3]
        directions: Unit directions. [R, 3]
        opacity: Opacity of the field along each ray. The background behind opaque rays is black,
            not computed. [R]
        constant: Colour behind a field without a background. [3] or [R, 3]
        jitter: Offset of each ray's samples within their steps; the middle when None. [R]
        ends: Intersects rays with the field's box.

    Returns:
        Colours; gradients reach the background. [3] or [R, 3]
    """
    background: Background | None = getattr(field, "background", None)
    if background is None:
        return constant
    clear = opacity.detach() < 1 - DARK
    if clear.device.type != "cpu":
        # Selecting the rays would make the host wait for the device.
        return torch.where(
            clear[:, None], background_colour(background, origins, directions, jitter, ends), 0
        )
    seen = clear.nonzero()[:, 0]
    offset = None if jitter is None else jitter[seen]
    colour = background_colour(background, origins[seen], directions[seen], offset, ends)
    black = torch.zeros_like(directions, dtype=colour.dtype)
    return black.index_put((seen,), colour)


def background_colour(
    background: Background,
    origins: Tensor,
    directions: Tensor,
    jitter: Tensor | None = None,
    ends: Ends = ray_box,
) -> Tensor:
    """Colours of a background along rays, from their exit from the field's box to infinity.

    Samples are uniform in inverse distance, and the last one, at infinity, is opaque. On rays that
    miss the box, they start at half the distance between ray origin and frame centre.

    Args:
        background: The background.
        origins: Ray origins in the field's frame. [R, 3]
        directions: Unit directions. [R, 3]
        jitter: Offset of each ray's samples within their steps; the middle when None. [R]
        ends: Intersects rays with the box.

    Returns:
        [R, 3]
    """
    rays, count = len(origins), background.samples
    far = ends(origins, directions)[1]
    first = torch.where(far > 0, far, 0.5 * origins.norm(dim=-1))[:, None]
    steps = torch.arange(count, device=origins.device)
    within = 0.5 if jitter is None else jitter[:, None]
    horizon = RADIUS * directions[:, None]
    edges = _at(origins, directions, first / (1 - steps / count))
    lengths = torch.cat([edges, horizon], dim=1).diff(dim=1).norm(dim=-1)
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
