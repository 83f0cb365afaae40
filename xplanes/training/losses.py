"""Terms of the loss that need the samples of rays."""

from collections.abc import Sequence

import torch
from torch import Tensor

from xplanes.rendering.proposal import Level
from xplanes.rendering.resampling import covering_weights

SMALLEST = 1e-7
"""Keeps the histogram term finite where the field sees nothing."""


def histogram_loss(levels: Sequence[Level]) -> Tensor:
    """How far the field's weights rise above what each density field allows.

    For each density field the mean over rays and samples of ``max(0, w - c)^2 / (w + 1e-7)``, w a
    weight of the field and c the weights of all coarse samples that its sample touches.

    Args:
        levels: Density fields, which gradients reach; then the field, which they do not.

    Returns:
        The sum over density fields. []

    Source: Mip-NeRF 360, Eq. 13; K-Planes, Section 3.4.
    """
    *coarse, fine = levels
    weights = fine.weights.detach()
    terms = [
        (weights - covering_weights(fine.edges, level.edges, level.weights)).clamp_min(0).square()
        / (weights + SMALLEST)
        for level in coarse
    ]
    return torch.stack([term.mean() for term in terms]).sum()
