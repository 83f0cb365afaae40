"""Terms of the loss that need the samples of rays."""

from collections.abc import Sequence

import torch
from torch import Tensor

from xplanes.rendering.proposal import Level
from xplanes.rendering.resampling import covering_weights

SMALLEST = 1e-7
"""Keeps the histogram term finite where the field sees nothing."""

LEAST_LIGHT = 1e-6
"""Shares of light closer than this to 0 and 1 are taken as that close."""


def histogram_loss(levels: Sequence[Level]) -> Tensor:
    """How far the field's weights rise above what each density field allows.

    For each density field the mean over rays and samples of ``max(0, w - c)^2 / (w + 1e-7)``, w a
    weight of the field and c the weights of all coarse samples that its sample touches.

    Args:
        levels: Density fields, which gradients reach; then the field, which they do not.

    Returns:
        The sum over density fields. []

    Source: Mip-NeRF 360, Eq. 13; K-Planes.
    """
    *coarse, fine = levels
    weights = fine.weights.detach()
    terms = [
        (weights - covering_weights(fine.edges, level.edges, level.weights)).clamp_min(0).square()
        / (weights + SMALLEST)
        for level in coarse
    ]
    return torch.stack([term.mean() for term in terms]).sum()


def light_entropy(opacity: Tensor) -> Tensor:
    """Entropy of whether a ray is stopped or passes, in nats, mean over rays. [R] -> []

    Source: TiNeuVox, released code; DirectVoxGO.
    """
    light = (1 - opacity).clamp(LEAST_LIGHT, 1 - LEAST_LIGHT)
    return -(light * light.log() + (1 - light) * (1 - light).log()).mean()


def sample_colour_error(colours: Tensor, target: Tensor, weights: Tensor, ray: Tensor) -> Tensor:
    """Squared error of each sample's own colour, weighted and summed along rays, mean over rays.

    Args:
        colours: Colour of each sample. [M, 3]
        target: True colour of each ray. [R, 3]
        weights: Share of its ray's light that each sample sends, without gradient. [M]
        ray: Ray of each sample. [M]

    Source: TiNeuVox, released code; DirectVoxGO.
    """
    error = (colours - target[ray]).square().sum(dim=1)
    return (error * weights).sum() / len(target)


def masked_colour_error(colour: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Absolute errors summed over channels, mean over the rays in a mask. [R, 3] x 2, [R] -> []

    Source: NeuS and Tensor4D, released code.
    """
    error = (colour - target).abs().sum(dim=1)
    return (error * mask).sum() / (mask.sum() + 1e-5)


def silhouette_error(opacity: Tensor, mask: Tensor) -> Tensor:
    """Cross entropy between opacities, kept from 0 and 1 by 0.001, and a mask. [R], [R] -> []

    Source: NeuS and Tensor4D, released code.
    """
    # Written out: torch's own stops the program at a NaN, where training leaves out the step.
    light = opacity.clamp(1e-3, 1 - 1e-3)
    return -(mask * light.log() + (1 - mask) * (1 - light).log()).mean()


def eikonal_error(slopes: Tensor, samples: int) -> Tensor:
    """Mean squared distance of gradients from length 1. [M, 3] -> []

    Args:
        slopes: Gradients of the samples in the field's cube. [M, 3]
        samples: Number of all samples: those outside the cube count as right.

    Source: NeuS; IGR; Tensor4D, released code.
    """
    # A gradient of zero has no direction in which its length could grow.
    lengths = (slopes.square().sum(dim=1) + 1e-12).sqrt()
    return (lengths - 1).square().sum() / max(1, samples)


def feature_change(here: Tensor, nearby: Tensor, weights: Tensor, rays: int) -> Tensor:
    """Squared change of features over a small distance: weighted sum along rays, mean over them.

    Args:
        here: Features at samples. [N, F]
        nearby: Features close by. [N, F]
        weights: Share of its ray's light that each sample sends, without gradient. [N]
        rays: Number of rays.

    Source: Tensor4D, released code.
    """
    return ((nearby - here).square().mean(dim=1) * weights).sum() / rays
