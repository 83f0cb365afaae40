"""Initial points of Gaussians: on the visual hull of the training views, or random in the cube."""

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.baselines.gaussians.field import PointCloud
from xplanes.scenes.cameras import project
from xplanes.scenes.frame import Frame
from xplanes.scenes.silhouettes import may_hold
from xplanes.scenes.views import Views

CELLS = 48
"""Cells along each side of the cube for the visual hull."""

AGREEMENT = 0.95
"""Share of views with a cell in their silhouette, relative to the best cell, for a solid cell."""

VIEWS = 64
"""Most views that are used, evenly spaced."""

CHUNK = 2**15
"""Cells per block."""


def random_points(count: int) -> PointCloud:
    """Grey points, uniform in the cube [-1, 1]^3, drawn with torch's global generator."""
    return PointCloud(2 * torch.rand(count, 3) - 1, torch.full((count, 3), 0.5))


def hull_points(views: Views, frame: Frame, count: int) -> PointCloud:
    """Random points on the surface of the visual hull of all times.

    Args:
        views: Training views. Without alpha the points are random in the cube.
        frame: The field's frame.
        count: Number of points, drawn with torch's global generator in cells that at least half of
            the views see.

    Returns:
        The points; colours are means over the views of their pixels, without regard to occlusion.
    """
    if views.is_opaque:
        return random_points(count)
    chosen = torch.linspace(0, len(views) - 1, min(VIEWS, len(views))).round().long()
    views = views.subset(chosen)
    axis = (torch.arange(CELLS) + 0.5) * (2 / CELLS) - 1
    centres = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
    world, radius = frame.to_world(centres), 0.5 / CELLS / frame.scale
    share = torch.cat([_agreement(views, part, radius) for part in world.split(CHUNK)])
    solid = (share >= AGREEMENT * share.max()).view(1, 1, CELLS, CELLS, CELLS)
    # A cell is inside if its 26 neighbours are solid; cells outside of the cube are empty.
    around = F.max_pool3d(F.pad((~solid).float(), [1] * 6, value=1.0), 3, stride=1) > 0
    surface = (solid & around).flatten().nonzero()[:, 0]
    cells = surface[torch.randint(len(surface), (count,))]
    points = centres[cells] + (2 * torch.rand(count, 3) - 1) / CELLS
    return PointCloud(points, _mean_colours(views, frame.to_world(points)))


def _agreement(views: Views, points: Tensor, radius: float) -> Tensor:
    """Share of views, among those that see a point, with it in their silhouette; 0 if few. [N]"""
    held = may_hold(views, points, radius=radius)
    seen = torch.stack([_pixels(views, index, points)[2] for index in range(len(views))])
    count = seen.sum(dim=0)
    return (held & seen).sum(dim=0) / count.clamp(min=1) * (2 * count >= len(views))


def _pixels(views: Views, index: int, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and columns of world points in a view, and whether they are in the image. [N] each"""
    (height, width), intrinsics = views.size(index), views.intrinsics
    column, row, seen = project(
        views.camera_to_world[index],
        points,
        focal=intrinsics.focal[index],
        centre=intrinsics.centre[index],
        lenses=intrinsics.lens(index),
    )
    seen = seen & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return row, column, seen


def _mean_colours(views: Views, points: Tensor) -> Tensor:
    """Mean colour of world points' pixels, weighted by alpha; grey if there are none. [N, 3]"""
    total, weight = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
    for index in range(len(views)):
        row, column, seen = _pixels(views, index, points)
        pixels = views.image(index)[row[seen].long(), column[seen].long()].float() / 255
        total[seen] += pixels[:, :3]
        weight[seen] += pixels[:, 3:]
    return torch.where(weight > 0, total / weight.clamp(min=1e-6), 0.5).clamp(0, 1)
