"""OpenLRM's volume renderer, from its description in formulas: slow, readable, for comparison.

Letters: B views, Q rays of a view, S samples of a ray.
"""

import torch
import torch.nn.functional as F

LOWEST = torch.finfo(torch.float32).max


def window_rays(cameras, anchors, resolutions, size):
    """Rays through a window of each view. [B, 25], [B, 2], [B] -> [B, size size, 3] twice"""
    pose = cameras[:, :16].view(-1, 4, 4)
    matrix = cameras[:, 16:].view(-1, 3, 3)
    steps = torch.arange(size) + 0.5
    v = (anchors[:, 0, None] + steps) / resolutions[:, None]
    u = (anchors[:, 1, None] + steps) / resolutions[:, None]
    right = (u - matrix[:, 0, 2, None]) / matrix[:, 0, 0, None]
    down = (v - matrix[:, 1, 2, None]) / matrix[:, 1, 1, None]
    shape = (len(cameras), size, size)
    local = torch.stack(
        [right[:, None, :].expand(shape), -down[:, :, None].expand(shape), -torch.ones(shape)],
        dim=-1,
    ).flatten(1, 2)
    directions = F.normalize(torch.einsum("bij,bqj->bqi", pose[:, :3, :3], local), dim=-1)
    return pose[:, None, :3, 3].expand_as(directions), directions


def box_interval(origins, directions):
    """Where rays enter and leave the cube [-1, 1]^3, start and end. [B, Q, 1] each"""
    first, second = (-1 - origins) / directions, (1 - origins) / directions
    start = torch.minimum(first, second).amax(dim=-1, keepdim=True)
    end = torch.maximum(first, second).amin(dim=-1, keepdim=True)
    hit = end > start
    if not hit.all():
        lowest, highest = start[hit].min(), start[hit].max()
        start, end = torch.where(hit, start, lowest), torch.where(hit, end, highest)
    return start, end


def march(rgb, raw, depths, background):
    """Merge samples by the midpoints of their intervals. Weights [B, Q, S - 1, 1]"""
    delta = depths[:, :, 1:] - depths[:, :, :-1]
    colour = 0.5 * (rgb[:, :, 1:] + rgb[:, :, :-1])
    middle = 0.5 * (depths[:, :, 1:] + depths[:, :, :-1])
    density = F.softplus(0.5 * (raw[:, :, 1:] + raw[:, :, :-1]) - 1)
    alpha = 1 - torch.exp(-density * delta)
    passed = torch.cumprod(1 - alpha + 1e-10, dim=2)
    passed = torch.cat([torch.ones_like(passed[:, :, :1]), passed[:, :, :-1]], dim=2)
    weights = alpha * passed
    total = weights.sum(dim=2)
    depth = (weights * middle).sum(dim=2) / total
    depth = depth.nan_to_num(float("inf")).clamp(depths.min(), depths.max())
    return (weights * colour).sum(dim=2) + background * (1 - total), depth, total, weights


def fine_depths(depths, weights, uniform):
    """Depths drawn where the coarse weights are large. [B Q, S]"""
    count = weights.shape[2]  # S - 1
    flat = weights.reshape(-1, 1, count)
    smooth = F.avg_pool1d(F.max_pool1d(flat, 2, stride=1, padding=1), 2, stride=1)[:, 0] + 0.01
    share = smooth[:, 1:-1] + 1e-5
    share = share / share.sum(dim=-1, keepdim=True)
    cdf = F.pad(torch.cumsum(share, dim=-1), (1, 0))
    bins = (0.5 * (depths[:, :, 1:] + depths[:, :, :-1])).reshape(-1, count)
    index = torch.searchsorted(cdf, uniform.contiguous(), right=True)
    below, above = (index - 1).clamp_min(0), index.clamp_max(count - 2)
    low, high = cdf.gather(1, below), cdf.gather(1, above)
    width = high - low
    width = torch.where(width < 1e-5, torch.ones_like(width), width)
    start = bins.gather(1, below)
    return start + (uniform - low) / width * (bins.gather(1, above) - start)


def render(query, origins, directions, *, u_coarse, u_fine, background, fill):
    """Render rays.

    Args:
        query: From points [B, Q, S, 3] to rgb [B, Q, S, 3] and raw density [B, Q, S, 1].
        origins: [B, Q, 3]
        directions: Unit length. [B, Q, 3]
        u_coarse: Random numbers of the first pass. [B, Q, S, 1]
        u_fine: Random numbers of the second pass. [B Q, S]
        background: [B, 1, 1]
        fill: Raw density outside the box.

    Returns:
        A dict of everything on the way.
    """
    start, end = box_interval(origins, directions)
    samples = u_coarse.shape[2]

    def look(depths):
        points = origins[:, :, None] + depths * directions[:, :, None]
        rgb, raw = query(points)
        inside = ((points >= -1) & (points <= 1)).all(dim=-1, keepdim=True)
        return torch.where(inside, rgb, 0.0), torch.where(inside, raw, fill)

    step = ((end - start) / (samples - 1))[:, :, None]
    coarse = start[:, :, None] + torch.arange(samples)[:, None] * step + u_coarse * step
    coarse_rgb, coarse_raw = look(coarse)
    weights = march(coarse_rgb, coarse_raw, coarse, background)[3]
    fine = fine_depths(coarse, weights, u_fine).view_as(coarse)
    fine_rgb, fine_raw = look(fine)
    depths, order = torch.cat([coarse, fine], dim=2).sort(dim=2)
    rgb = torch.cat([coarse_rgb, fine_rgb], dim=2).gather(2, order.expand(-1, -1, -1, 3))
    raw = torch.cat([coarse_raw, fine_raw], dim=2).gather(2, order)
    colour, depth, total, _ = march(rgb, raw, depths, background)
    return {
        "rgb": colour,
        "depth": depth,
        "weight": total,
        "ray_start": start,
        "ray_end": end,
        "depths_coarse": coarse,
        "weights_coarse": weights,
        "depths_fine": fine,
    }
