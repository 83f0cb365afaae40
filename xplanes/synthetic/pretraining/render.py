"""Plain volume rendering of one triplane with evenly spaced samples."""

import torch
from torch import Tensor

from xplanes.fields.decoder import Decoder
from xplanes.scenes.cameras import cast_rays
from xplanes.synthetic.pretraining.losses import composite, line_box, triplane_logits
from xplanes.synthetic.pretraining.pool import FOCAL

SAMPLES = 96
"""Samples per ray."""

CHUNK = 2**14
"""Samples decoded at once, so that temporaries fit in the cache."""


def render_view(
    planes: Tensor,
    decoder: Decoder,
    pose: Tensor,
    side: int,
) -> Tensor:
    """Render one triplane on a white background.

    Args:
        planes: Planes xy, xz, yz. [1, 3, C, H, H]
        decoder: Maps features to logits.
        pose: Camera-to-world matrix in the model's frame. [4, 4]
        side: Height and width in pixels.

    Returns:
        RGB from 0 to 1. [S, S, 3]
    """
    line, middle = torch.arange(side, device=pose.device), (0.5 * side, 0.5 * side)
    rows, columns = torch.meshgrid(line, line, indexing="ij")
    origins, directions = cast_rays(
        pose, rows.flatten(), columns.flatten(), focal=FOCAL * side, centre=middle
    )
    near, far = line_box(origins, directions, 1.0)
    step = (far - near).clamp_min(0) / SAMPLES
    picture = torch.ones(side * side, 3, device=pose.device)
    along = torch.arange(SAMPLES, device=pose.device) + 0.5
    rays = (step > 0).nonzero()[:, 0]
    for chosen in rays.split(max(1, CHUNK // SAMPLES)):
        distances = near[chosen, None] + step[chosen, None] * along
        points = origins[chosen, None] + distances[..., None] * directions[chosen, None]
        logits = triplane_logits(planes, decoder, points.flatten(0, 1)[None])[0]
        colours, density = decoder.activate(logits)
        picture[chosen] = composite(
            density.unflatten(0, (len(chosen), SAMPLES)),
            colours.unflatten(0, (len(chosen), SAMPLES)),
            step[chosen, None].expand(-1, SAMPLES),
        )[0]
    return picture.clamp(0, 1).unflatten(0, (side, side))
