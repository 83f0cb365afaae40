"""Plain volume rendering of one triplane with evenly spaced samples."""

import torch
from torch import Tensor

from xplanes.fields.decoder import Decoder
from xplanes.scenes.cameras import cast_rays
from xplanes.synthetic.pretraining.losses import composite, triplane_logits

CHUNK = 2**14
"""Samples decoded at once, so that temporaries fit in the cache."""


def render_view(
    planes: Tensor,
    decoder: Decoder,
    pose: Tensor,
    *,
    side: int,
    focal: float,
    half_side: float = 1.0,
    samples: int = 96,
) -> Tensor:
    """Render one triplane on a white background.

    Args:
        planes: Planes xy, xz, yz. [1, 3, C, H, H]
        decoder: Maps features to logits.
        pose: Camera-to-world matrix in the model's frame. [4, 4]
        side: Height and width in pixels.
        focal: Focal length as a share of the image side.
        half_side: Half the side of the box.
        samples: Samples per ray.

    Returns:
        RGB from 0 to 1. [S, S, 3]
    """
    line, middle = torch.arange(side, device=pose.device), (0.5 * side, 0.5 * side)
    rows, columns = torch.meshgrid(line, line, indexing="ij")
    origins, directions = cast_rays(
        pose, rows.flatten(), columns.flatten(), focal=focal * side, centre=middle
    )
    inverse = 1 / torch.where(directions.abs() < 1e-9, 1e-9, directions)
    middle, reach = -origins * inverse, half_side * inverse.abs()
    near, far = (middle - reach).amax(-1), (middle + reach).amin(-1)
    step = (far - near).clamp_min(0) / samples
    picture = torch.ones(side * side, 3, device=pose.device)
    along = torch.arange(samples, device=pose.device) + 0.5
    rays = (step > 0).nonzero()[:, 0]
    for chosen in rays.split(max(1, CHUNK // samples)):
        distances = near[chosen, None] + step[chosen, None] * along
        points = origins[chosen, None] + distances[..., None] * directions[chosen, None]
        logits = triplane_logits(planes, decoder, points.flatten(0, 1)[None])[0]
        colours, density = decoder.activate(logits)
        picture[chosen] = composite(
            density.unflatten(0, (len(chosen), samples)),
            colours.unflatten(0, (len(chosen), samples)),
            step[chosen, None].expand(-1, samples),
        )[0]
    return picture.clamp(0, 1).unflatten(0, (side, side))
