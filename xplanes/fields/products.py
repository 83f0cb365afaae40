"""Products of feature planes at several scales: what K-Planes reads from."""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

AXES = "xyzt"

MOVING = ("xy", "xz", "xt", "yz", "yt", "zt")
STILL = ("xy", "xz", "yz")
"""Planes in the order of the product."""


class PlaneProducts(nn.Module):
    """At each scale the product of all planes, channel by channel.

    Plane "ab" has axis a along its columns, b along its rows. Coordinates from -1 to 1 run from the
    first texel's centre to the last one's (``align_corners=True``); what lies beyond takes the
    value at the border.

    Args:
        channels: Channels of each plane.
        resolution: Texels along each space axis at scale 1.
        scales: Factors on the resolution.
        time_resolution: Rows of time, at every scale; None for a scene that stands still.
        low: Space planes start uniform between this
        high: and this; time planes start at 1.

    Source: K-Planes, Eq. 2 and Section 3.1.
    """

    def __init__(
        self,
        channels: int,
        resolution: int,
        scales: Sequence[int],
        time_resolution: int | None,
        *,
        low: float,
        high: float,
    ) -> None:
        super().__init__()
        self.names = STILL if time_resolution is None else MOVING
        self.channels = channels
        self.scales = nn.ModuleList()
        for scale in scales:
            planes = nn.ParameterDict()
            for name in self.names:
                size = resolution * scale
                rows = time_resolution if "t" in name else size
                plane = torch.ones(1, channels, rows or 0, size)
                planes[name] = nn.Parameter(plane if "t" in name else plane.uniform_(low, high))
            self.scales.append(planes)

    @property
    def features(self) -> int:
        """Columns of the output."""
        return self.channels * len(self.scales)

    def planes(self) -> list[tuple[str, Tensor]]:
        """Name and parameter of every plane, scale by scale. [1, C, rows, columns] each"""
        return [(name, scale[name]) for scale in self.scales for name in self.names]  # type: ignore[index]

    def forward(self, points: Tensor, times: Tensor) -> Tensor:
        """Features of points at times.

        Args:
            points: Positions, the planes' cube being [-1, 1]^3. [N, 3]
            times: Times from 0 to 1. [N]

        Returns:
            The scales side by side. [N, channels * scales]
        """
        place = torch.cat([points, 2 * times[:, None] - 1], dim=1)
        # Grids of a pair of axes are the same at all scales.
        grids = {n: place[:, [AXES.index(n[0]), AXES.index(n[1])]][None, None] for n in self.names}
        found = []
        for scale in self.scales:
            factors = (
                F.grid_sample(
                    scale[name],  # type: ignore[index]
                    grids[name],
                    padding_mode="border",
                    align_corners=True,
                )
                for name in self.names
            )
            found.append(math.prod(factors, start=torch.ones((), device=points.device)))
        return torch.cat(found, dim=1)[0, :, 0].T
