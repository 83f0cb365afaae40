"""TripoSR's volume renderer and cameras, from their description in formulas."""

import math

import torch
import torch.nn.functional as F

HALF_SIDE = 0.999 * 0.87


def orbit_rays(views, elevation, distance, fovy, height, width):
    """Rays of cameras on a circle, from +x towards +y. [views, height, width, 3] twice"""
    origins, directions = [], []
    focal = 0.5 * height / math.tan(0.5 * math.radians(fovy))
    right = (torch.arange(width) + 0.5 - 0.5 * width) / focal
    up = -(torch.arange(height) + 0.5 - 0.5 * height) / focal
    shape = (height, width)
    local = torch.stack(
        [right.expand(shape), up[:, None].expand(shape), -torch.ones(shape)], dim=-1
    )
    for view in range(views):
        azimuth, height_angle = 2 * math.pi * view / views, math.radians(elevation)
        back = torch.tensor(
            [
                math.cos(height_angle) * math.cos(azimuth),
                math.cos(height_angle) * math.sin(azimuth),
                math.sin(height_angle),
            ]
        )
        side = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back)
        side = side / side.norm()
        rotation = torch.stack([side, torch.linalg.cross(back, side), back], dim=1)
        directions.append(F.normalize(local @ rotation.T, dim=-1))
        origins.append((distance * back).expand(height, width, 3))
    return torch.stack(origins), torch.stack(directions)


def box_interval(origins, directions):
    """Near, far and validity of rays. [..., 3] -> [..., 1], [..., 1], [...]"""
    directions = torch.where(directions.abs() < 1e-6, 1e-6, directions)
    first = (-HALF_SIDE - origins) / directions
    second = (HALF_SIDE - origins) / directions
    near = torch.minimum(first, second).amax(dim=-1).clamp_min(0)
    far = torch.maximum(first, second).amin(dim=-1)
    return near[..., None], far[..., None], far - near > 0.01


def render(query, origins, directions, samples):
    """Render rays that all meet the box.

    Args:
        query: From points [R, S, 3] to rgb [R, S, 3] and density [R, S, 1], the latter per share of
            the ray's way through the box.
        origins: [R, 3]
        directions: [R, 3]
        samples: Samples S of each ray.

    Returns:
        Colour in front of white. [R, 3]
    """
    near, far, _ = box_interval(origins, directions)
    share = (torch.arange(samples) + 0.5) / samples
    distance = near * (1 - share) + far * share
    rgb, density = query(origins[:, None] + distance[..., None] * directions[:, None])
    alpha = 1 - torch.exp(-density / samples)
    passed = torch.cumprod(1 - alpha + 1e-10, dim=1)
    passed = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=1)
    weights = alpha * passed
    return (weights * rgb).sum(dim=1) + 1 - weights.sum(dim=1)
