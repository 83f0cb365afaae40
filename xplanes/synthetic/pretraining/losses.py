"""Losses of pretraining: occupancy and colour at points, and rendered rays."""

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.fields.decoder import Decoder
from xplanes.rendering.box import ray_box


def triplane_logits(planes: Tensor, decoder: Decoder, points: Tensor) -> Tensor:
    """Decoder logits at points.

    Args:
        planes: Planes xy, xz, yz. [B, 3, C, H, H]
        decoder: Maps features to logits.
        points: Positions in the model's frame. [B, N, 3]

    Returns:
        Density and colour logits. [B, N, 4]
    """
    grid = torch.stack([points[..., [0, 1]], points[..., [0, 2]], points[..., [1, 2]]], dim=1)
    features = F.grid_sample(
        planes.flatten(0, 1).float(), grid.flatten(0, 1)[:, None], align_corners=False
    )[:, :, 0]
    features = features.unflatten(0, (len(planes), 3)).permute(0, 3, 1, 2).flatten(2)
    return decoder.logits(features.flatten(0, 1)).unflatten(0, features.shape[:2])


def occupancy_loss(logits: Tensor, inside: Tensor) -> Tensor:
    """Binary cross-entropy of opacity over one step of length 1 / density_scale.

    The opacity 1 - exp(-softplus(logit - 1)) of such a step is the sigmoid of logit - 1. The loss
    is computed from the logits. [B, N, 4], [B, N] -> []
    """
    return F.binary_cross_entropy_with_logits(logits[..., 0].float() - 1, inside)


def colour_loss(logits: Tensor, colours: Tensor, margin: float) -> Tensor:
    """Mean absolute error of colours. [B, N, 4], [B, N, 3] -> []"""
    predicted = logits[..., 1:].float().sigmoid() * (1 + 2 * margin) - margin
    return (predicted - colours).abs().mean()


def ray_samples(
    origins: Tensor, directions: Tensor, hits: Tensor, *, half_side: float, jitter: Tensor
) -> tuple[Tensor, Tensor]:
    """Stratified samples on rays: half along the whole ray in the box, half around the surface.

    Args:
        origins: Ray origins. [B, R, 3]
        directions: Unit ray directions. [B, R, 3]
        hits: Distance to the surface, inf for rays that miss. [B, R]
        half_side: Half the side of the box.
        jitter: Position of each sample within its bin, in [0, 1]. [B, R, S]

    Returns:
        Ascending distances and the length of each sample, 0 on rays that miss the box.
        [B, R, S], [B, R, S]
    """
    near, far = ray_box(origins, directions, half_side)
    even = jitter.shape[-1] // 2
    steps = torch.arange(jitter.shape[-1], device=hits.device)
    share = torch.where(steps < even, steps, steps - even) + jitter
    through = near[..., None] + (far - near)[..., None] * share / even
    around = 0.1 * (2 * share / (jitter.shape[-1] - even) - 1) + hits[..., None]
    around = torch.where(
        hits.isfinite()[..., None],
        around,
        near[..., None] + (far - near)[..., None] * (share + 0.5) / (even + 1),
    )
    distances = torch.where(steps < even, through, around)
    distances = torch.minimum(torch.maximum(distances, near[..., None]), far[..., None])
    distances = distances.sort(dim=-1).values
    between = 0.5 * (distances[..., 1:] + distances[..., :-1])
    edges = torch.cat([near[..., None], between, far[..., None]], dim=-1)
    lengths = (edges[..., 1:] - edges[..., :-1]).masked_fill((near >= far)[..., None], 0.0)
    return distances, lengths


def line_box(origins: Tensor, directions: Tensor, half_side: float) -> tuple[Tensor, Tensor]:
    """Near and far of lines in the box, near above far for a miss. [..., 3] -> [...], [...]"""
    inverse = 1 / torch.where(directions.abs() < 1e-9, 1e-9, directions)
    middle, reach = -origins * inverse, half_side * inverse.abs()
    return (middle - reach).amax(dim=-1), (middle + reach).amin(dim=-1)


def composite(density: Tensor, colours: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Colours on white and opacity of rays. [..., S], [..., S, 3], [..., S] -> [..., 3], [...]"""
    depth = density * lengths
    before = depth.cumsum(dim=-1) - depth
    weights = (-before).exp() * -(-depth).expm1()
    alpha = weights.sum(dim=-1)
    return (weights[..., None] * colours).sum(dim=-2) + 1 - alpha[..., None], alpha
