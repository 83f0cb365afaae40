"""What rays see behind the box in which a field lives."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from xplanes.fields.background import RADIUS, Background, contract
from xplanes.rendering.box import ray_box
from xplanes.rendering.compositing import OPAQUE, composite

DARK = 1e-3
"""Share of the light that must pass the field for a ray to look behind it."""

Ends = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""From origins and directions to the distances at which rays enter and leave a box, see `ray_box`.

[R, 3], [R, 3] -> [R], [R]
"""


def behind(
    field: Any,
    origins: Tensor,
    directions: Tensor,
    opacity: Tensor,
    plain: Tensor,
    jitter: Tensor | None = None,
    ends: Ends = ray_box,
) -> Tensor:
    """Colours behind a field: of its background where it has one, else a plain one.

    Args:
        field: Its ``background`` is a `Background`, None, or not there.
        origins: Ray origins in the field's frame. [R, 3]
        directions: Unit directions. [R, 3]
        opacity: Share of each ray's light that the field stops; the background of rays that it
            stops whole is not computed, and black. [R]
        plain: Colour behind a field without a background. [3] or [R, 3]
        jitter: Place of each ray's samples within their steps; the middle when None. [R]
        ends: Where rays meet the field's box.

    Returns:
        Gradients reach the background. [3] or [R, 3]
    """
    background: Background | None = getattr(field, "background", None)
    if background is None:
        return plain
    clear = opacity.detach() < 1 - DARK
    if clear.device.type != "cpu":
        # Looking for those few would be waited for.
        return torch.where(clear[:, None], look(background, origins, directions, jitter, ends), 0)
    seen = clear.nonzero()[:, 0]
    place = None if jitter is None else jitter[seen]
    colour = look(background, origins[seen], directions[seen], place, ends)
    black = torch.zeros_like(directions, dtype=colour.dtype)
    return black.index_put((seen,), colour)


def look(
    background: Background,
    origins: Tensor,
    directions: Tensor,
    jitter: Tensor | None = None,
    ends: Ends = ray_box,
) -> Tensor:
    """Colours that rays see in a background, from where they leave a field's box to infinity.

    Samples are even in inverse distance, and the last one, at infinity, is opaque. A ray that
    misses the box looks from half its origin's distance from the frame's centre on.

    Args:
        background: The background.
        origins: Ray origins in the field's frame. [R, 3]
        directions: Unit directions. [R, 3]
        jitter: Place of each ray's samples within their steps; the middle when None. [R]
        ends: Where rays meet the box.

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
