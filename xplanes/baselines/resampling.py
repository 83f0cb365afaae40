"""Importance sampling along rays from the weights of earlier samples."""

import torch
from torch import Tensor

from xplanes.rendering.compositing import OPAQUE, stopped


def ray_weights(optical_depth: Tensor) -> Tensor:
    """Compositing weights of samples from their optical depths. [R, S] -> [R, S]

    Equal to the weights of `composite`, for equally many samples per ray, and differentiable.
    """
    depth = optical_depth.clamp(0, OPAQUE)
    return (depth - depth.cumsum(dim=1)).exp() * stopped(depth)


def uniform_edges(rays: int, count: int, uniform: Tensor | None, device: torch.device) -> Tensor:
    """Edges of ``count`` equal bins from 0 to 1, jittered by up to half a bin.

    Args:
        rays: Number of rays R.
        count: Number of bins.
        uniform: Random numbers from 0 to 1; None for no jitter. [R, count + 1]
        device: Device of the edges.

    Returns:
        Ascending edges. [R, count + 1]
    """
    edges = torch.linspace(0, 1, count + 1, device=device).expand(rays, -1)
    if uniform is None:
        return edges
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    lower = torch.cat([edges[:, :1], middle], dim=1)
    upper = torch.cat([middle, edges[:, -1:]], dim=1)
    return lower + (upper - lower) * uniform


def resample(
    edges: Tensor, weights: Tensor, count: int, uniform: Tensor | None, padding: float
) -> Tensor:
    """Edges of new bins with about equal weight, by inverse transform sampling.

    The weights plus ``padding`` are a piecewise constant density; the new edges are at equally
    spaced values of its cumulative distribution.

    Args:
        edges: Ascending edges of the bins. [R, S + 1]
        weights: Weight of each bin, at least 0. [R, S]
        count: Number of new bins.
        uniform: Random numbers from 0 to 1 for stratified sampling; None for the middle of each
            stratum. [R, count + 1]
        padding: Added to each weight; above 0.

    Returns:
        Ascending edges, without gradient. [R, count + 1]

    Source: K-Planes, released code; Mip-NeRF 360, Section 3; NeRF, Section 5.2.
    """
    with torch.no_grad():
        padded = weights + padding
        share = padded / padded.sum(dim=1, keepdim=True)
        total = torch.cat([torch.zeros_like(share[:, :1]), share.cumsum(dim=1)], dim=1)
        total = total.clamp_max(1)
        place = torch.arange(count + 1, device=edges.device, dtype=edges.dtype)
        place = (place + (0.5 if uniform is None else uniform)) / (count + 1)
        place = place.expand(len(edges), -1).contiguous()
        above = torch.searchsorted(total, place, right=True)
        below, above = (above - 1).clamp_min(0), above.clamp_max(edges.shape[1] - 1)
        start, end = total.gather(1, below), total.gather(1, above)
        along = ((place - start) / (end - start)).nan_to_num(0, 0, 0).clamp(0, 1)
        first, last = edges.gather(1, below), edges.gather(1, above)
        return first + along * (last - first)


def covering_weights(edges: Tensor, coarse_edges: Tensor, coarse_weights: Tensor) -> Tensor:
    """Total weight of the coarse bins that overlap each bin.

    Args:
        edges: Ascending edges of the bins. [R, S + 1]
        coarse_edges: Ascending edges of the coarse bins. [R, P + 1]
        coarse_weights: Weights of the coarse bins; gradients reach them. [R, P]

    Returns:
        Weight for each bin. [R, S]

    Source: Mip-NeRF 360, Eq. 12.
    """
    zero = torch.zeros_like(coarse_weights[:, :1])
    total = torch.cat([zero, coarse_weights.cumsum(dim=1)], dim=1)
    last = coarse_weights.shape[1] - 1
    starts, ends = coarse_edges[:, :-1].contiguous(), coarse_edges[:, 1:].contiguous()
    first = torch.searchsorted(starts, edges[:, :-1].contiguous(), right=True) - 1
    final = torch.searchsorted(ends, edges[:, 1:].contiguous(), right=True)
    first, final = first.clamp(0, last), final.clamp(0, last)
    return total.gather(1, final + 1) - total.gather(1, first)
