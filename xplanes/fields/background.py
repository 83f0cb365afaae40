"""What lies behind the field's cube: static and unbounded, contracted to a ball of radius 2."""

import torch
from torch import Tensor, nn

from xplanes.fields.decoder import Decoder, Precision
from xplanes.fields.lookup import plane_features

RADIUS = 2.0
"""Radius of the ball into which `contract` maps all of space."""

FARTHEST = 1e30
"""Distance of what lies on the ball's surface."""

INITIAL_SCALE = 1e-3
"""Standard deviation of the planes' random initial values."""

DARKEST = 0.02
"""Darkest initial colour, from where it is not far to any other; 1 minus it is the brightest."""

DENSITY_SCALE, DENSITY_BIAS = 25.0, -2.0
"""Of the decoder. A ray keeps about a third of its light for infinity at first."""


def contract(points: Tensor) -> Tensor:
    """Draw all of space into a ball of radius 2; the ball of radius 1 stays as it is.

    ``x`` becomes ``(2 - 1 / |x|) x / |x|`` where ``|x| > 1``.

    Args:
        points: Positions in the field's frame, finite. [..., 3]

    Returns:
        [..., 3]

    Source: Mip-NeRF 360, Eq. 10.
    """
    # The square of a large number would overflow: the largest coordinate is taken out first.
    largest = points.abs().amax(dim=-1, keepdim=True).clamp_min(1)
    share = points / largest
    length = share.norm(dim=-1, keepdim=True)
    outside = largest * length > 1
    unit = share / torch.where(outside, length, 1)
    return torch.where(outside, (RADIUS - 1 / length / largest) * unit, points)


def expand(points: Tensor) -> Tensor:
    """The inverse of `contract`.

    Args:
        points: Positions in the ball of radius 2; what lies on its surface, or beyond, becomes
            `FARTHEST`. [..., 3]

    Returns:
        [..., 3]
    """
    length = points.norm(dim=-1, keepdim=True)
    outside = length > 1
    unit = points / torch.where(outside, length, 1)
    return torch.where(outside, unit / (RADIUS - length).clamp_min(1 / FARTHEST), points)


class Background(nn.Module):
    """Colour and density of a static, unbounded world, on three planes over contracted space.

    Args:
        channels: Channels of each plane.
        resolution: Texels along each side of the planes, which span the ball of radius 2.
        width: Neurons of the decoder's hidden layer.
        samples: Samples of a ray behind the cube, before the one at infinity; 0 leaves that alone,
            so that colour depends on direction only.
        precision: "bf16" multiplies in bfloat16.
        colour: Initial colour, from 0 to 1; whatever the decoder's random weights show when None.
            [3]
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
        places, still = points / RADIUS, torch.zeros_like(points[:, 0])
        return self.decoder(plane_features(self.planes, None, places, still, ()).flatten(1))
