"""What the images' alpha rules out: space that some view shows to be empty."""

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.scenes.views import Views

WINDOW = 0.06
"""Share of the time span over which content is taken to stand still when silhouettes are joined."""


def foreground(views: Views, margin: int) -> Tensor:
    """Pixels with alpha above 0, or within ``margin`` pixels of such. bool [V, H, W]"""
    alpha = (views.images[..., 3] > 0).float()[:, None]
    return F.max_pool2d(alpha, 2 * margin + 1, stride=1, padding=margin)[:, 0] > 0


def silhouette_hull(views: Views, points: Tensor, *, radius: float) -> Tensor:
    """Where and when something may be: the visual hull over short spans of time.

    A point holds something at a view's time only if every view of some span of time around it
    shows foreground where the point projects to. The span is short (`WINDOW`), so that motion
    stays inside the hull; where all views have one time, all must agree. Points out of a view's
    sight are not ruled out by it, and images without alpha rule out nothing.

    Args:
        views: Images with alpha.
        points: World points. [N, 3]
        radius: Distance around each point that counts as the point, in world units.

    Returns:
        For each view's time and point, whether something may be there. bool [V, N]
    """
    distance = (views.camera_to_world[:, :3, 3] - points.mean(dim=0)).norm(dim=-1)
    margin = max(1, int(torch.ceil(radius * views.focal / distance.min()).item()))
    if margin >= min(views.height, views.width) // 2:
        return torch.ones(len(views), len(points), dtype=torch.bool)
    masks = foreground(views, margin)
    inside = torch.ones(len(views), len(points), dtype=torch.bool)
    for index, pose in enumerate(views.camera_to_world):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        depth = -local[:, 2]
        column = (local[:, 0] / depth * views.focal + 0.5 * views.width).floor()
        row = (-local[:, 1] / depth * views.focal + 0.5 * views.height).floor()
        seen = (depth > 0) & (column >= 0) & (column < views.width)
        seen &= (row >= 0) & (row < views.height)
        inside[index, seen] = masks[index, row[seen].long(), column[seen].long()]
    still = bool((views.times == views.times[0]).all())
    span = len(views) if still else max(1, round(WINDOW * len(views)))
    order = views.times.argsort(stable=True)
    runs = inside[order].unfold(0, span, 1).all(dim=-1)
    held = torch.zeros_like(inside)
    for shift in range(span):
        held[shift : shift + len(runs)] |= runs
    result = torch.empty_like(held)
    result[order] = held
    return result
