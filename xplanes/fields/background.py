"""Static, unbounded background outside the field's cube, contracted to a ball of radius 2."""

import torch
from torch import Tensor, nn

from xplanes.fields.decoder import Decoder, Precision
from xplanes.fields.lookup import plane_features

RADIUS = 2.0
"""Radius of the ball into which `contract` maps all of space."""

INITIAL_SCALE = 1e-3
"""Standard deviation of the planes' random initial values."""

DARKEST = 0.02
"""Initial colours lie between this and 1 minus this, where the sigmoid is not saturated."""

DENSITY_SCALE, DENSITY_BIAS = 25.0, -2.0
"""Scale and bias of the density: about a third of a ray's light initially comes from infinity."""


def contract(points: Tensor) -> Tensor:
    """Contract all of space to a ball of radius 2; the ball of radius 1 is unchanged.

    ``x`` becomes ``(2 - 1 / |x|) x / |x|`` where ``|x| > 1``.

    Args:
        points: Positions in the field's frame, finite. [..., 3]

    Returns:
        [..., 3]

    Source: Mip-NeRF 360, Eq. 10.
    """
    # The square of a large number would overflow: the largest coordinate is factored out first.
    largest = points.abs().amax(dim=-1, keepdim=True).clamp_min(1)
    share = points / largest
    length = share.norm(dim=-1, keepdim=True)
    outside = largest * length > 1
    unit = share / torch.where(outside, length, 1)
    return torch.where(outside, (RADIUS - 1 / length / largest) * unit, points)


class Background(nn.Module):
    """Colour and density of a static, unbounded background: three planes over contracted space.

    Args:
        channels: Channels of each plane.
        resolution: Texels along each side of the planes, which span the ball of radius 2.
        width: Neurons of the decoder's hidden layer.
        samples: Samples of a ray behind the cube, besides the one at infinity; with 0, colour
            depends on direction only.
        precision: "bf16" multiplies in bfloat16.
        colour: Initial colour from 0 to 1; set by the decoder's random weights when None. [3]
    """

    def __init__(
        self,
        channels: int,
        resolution: int,
        *,
        width: int = 32,
        samples: int = 24,
        precision: Precision = "32",
        colour: Tensor | None = None,
    ) -> None:
        super().__init__()
        planes = INITIAL_SCALE * torch.randn(3, resolution, resolution, channels)
        self.planes, self.samples = nn.Parameter(planes), samples
        self.decoder = Decoder(
            channels, width=width, hidden=1, density_scale=DENSITY_SCALE, precision=precision
        )
        with torch.no_grad():
            bias = self.decoder.layers[-1].bias
            bias[0] += DENSITY_BIAS  # type: ignore[index]
            if colour is not None:
                shown = self.decoder.logits(torch.zeros(1, 3 * channels))[0, 1:].float()
                bias[1:] += colour.clamp(DARKEST, 1 - DARKEST).logit() - shown  # type: ignore[index]

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Colour, and density per unit length of contracted space. [N, 3] -> [N, 3], [N]

        Args:
            points: Contracted positions. [N, 3]
        """
        places, times = points / RADIUS, torch.zeros_like(points[:, 0])
        return self.decoder(plane_features(self.planes, None, places, times, ()).flatten(1))
