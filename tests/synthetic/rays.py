"""Rays at what lies around the origin."""

import torch


def rays(count, seed=0, distance=4.0, spread=1.0):
    """Rays from a sphere around the origin towards points in a cube, in float64. [N, 3], [N, 3]"""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    origins = distance * origins / origins.norm(dim=-1, keepdim=True)
    targets = spread * (2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1)
    directions = targets - origins
    return origins, directions / directions.norm(dim=-1, keepdim=True)


def float_rays(count, **options):
    """The same in float32."""
    origins, directions = rays(count, **options)
    return origins.float(), directions.float()
