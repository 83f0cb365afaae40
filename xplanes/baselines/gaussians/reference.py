"""Projection and blending of Gaussians in plain torch, differentiated by autograd.

Zwicker et al. 2002 (EWA splatting), Kerbl et al. 2023 (3D Gaussian splatting).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.baselines.gaussians.camera import Camera

LOW_PASS = 0.3
"""Variance in pixels^2 that is added to every projected Gaussian (Kerbl et al. 2023)."""

LEAST_ALPHA = 1 / 255
"""Alpha below which a Gaussian does not affect a pixel (Kerbl et al. 2023)."""

MOST_ALPHA = 0.999
"""Largest alpha of a pixel, as in gsplat; Kerbl et al. use 0.99."""

LEAST_TRANSMITTANCE = 1e-4
"""Blending stops before the Gaussian that would lower transmittance below it (Kerbl et al.)."""

LEAST_QUATERNION = 1e-12
"""Shorter quaternions are divided by this length instead; zero gives the identity."""

TILE = 16
"""Side of the square tiles, in pixels. The image does not depend on it."""


class Splats(NamedTuple):
    """Gaussians in the world; see `rasterise` in rasteriser.py."""

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    colours: Tensor


@dataclass(frozen=True)
class Projection:
    """Gaussians projected to the image plane.

    Attributes:
        means: In pixels from the left and the top edge. [N, 2]
        whitening: Entries xx, xy and yy of the upper triangular W with W^T W the inverse of the
            covariance: W times an offset in pixels is the offset in standard deviations. [N, 3]
        depths: Depths of the means along the optical axis. [N]
        opacities: Alpha at the means. [N]
        radii: See `RasterisedImage`; 0 for Gaussians that are not drawn, whose other values are
            undefined. int64 [N]
    """

    means: Tensor
    whitening: Tensor
    depths: Tensor
    opacities: Tensor
    radii: Tensor


def project(splats: Splats, camera: Camera, antialiased: bool) -> Projection:
    """Project Gaussians by the linearised perspective of EWA; arguments as in `rasterise`."""
    with torch.no_grad():
        everything = torch.ones_like(splats.opacities, dtype=torch.bool)
        radii = _project(splats, camera, antialiased, everything).radii
    # Gaussians that are not drawn are replaced, so that their overflows do not reach gradients.
    return replace(_project(splats, camera, antialiased, radii > 0), radii=radii)


def _project(splats: Splats, camera: Camera, antialiased: bool, wanted: Tensor) -> Projection:
    """Project; Gaussians that are not wanted are replaced by one in front of the camera."""
    means, quaternions, scales, opacities, _ = splats
    world_to_camera = camera.world_to_camera.to(means)
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    x, y, z = (means @ rotation.T + translation).unbind(-1)
    x, y, z = torch.where(wanted, x, 0), torch.where(wanted, y, 0), torch.where(wanted, z, 1)
    scales = torch.where(wanted[:, None], scales, 1)
    left, right, top, bottom = camera.slant
    slant_x, slant_y = (x / z).clamp(left, right), (y / z).clamp(top, bottom)
    zero = torch.zeros_like(z)
    along_x = torch.stack([camera.fx / z, zero, -camera.fx * slant_x / z], dim=-1)
    along_y = torch.stack([zero, camera.fy / z, -camera.fy * slant_y / z], dim=-1)
    jacobian = torch.stack([along_x, along_y], dim=1)
    root = jacobian @ rotation @ rotations(quaternions) * scales[:, None, :]  # [N, 2, 3]
    # The covariance is root root^T + LOW_PASS. Its determinant is computed from areas, which avoids
    # cancellation for thin Gaussians.
    area = torch.linalg.cross(root[:, 0], root[:, 1]).norm(dim=-1)
    xx, yy = root.square().sum(-1).unbind(-1)
    determinant = area.square() + LOW_PASS * (xx + yy) + LOW_PASS**2
    xx, yy = xx + LOW_PASS, yy + LOW_PASS
    xy = (root[:, 0] * root[:, 1]).sum(-1)
    first = (yy / determinant).sqrt()
    whitening = torch.stack([first, -first * xy / yy, yy.rsqrt()], dim=-1)
    projected = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=-1)
    if antialiased:
        opacities = opacities * area / determinant.sqrt()
    with torch.no_grad():
        finite = torch.cat([projected, whitening], dim=1).isfinite().all(-1)
        extent = extents(whitening, opacities)
        size = extent.new_tensor([camera.width, camera.height])
        touches = ((projected + extent > 0) & (projected - extent < size)).all(-1)
        drawn = finite & touches & (whitening[:, 0] > 0) & (opacities >= LEAST_ALPHA)
        drawn &= (z > camera.near) & (z < camera.far)
        longest = 0.5 * (xx + yy) + torch.hypot(0.5 * (xx - yy), xy)
        radii = torch.where(drawn, (3 * longest.sqrt()).ceil().clamp(max=1e9), 0).long()
    return Projection(projected, whitening, z, opacities, radii)


def rotations(quaternions: Tensor) -> Tensor:
    """Rotation matrices of quaternions (w, x, y, z) of any length. [N, 4] -> [N, 3, 3]"""
    w, x, y, z = F.normalize(quaternions, dim=-1, eps=LEAST_QUATERNION).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).view(-1, 3, 3)


def extents(whitening: Tensor, opacities: Tensor) -> Tensor:
    """Half sizes in pixels of the boxes in which alpha is at least `LEAST_ALPHA`. [N, 2]

    They are 0 if alpha is below it everywhere, and at most 3.33 standard deviations.
    """
    first, shear, last = whitening.unbind(-1)
    reach = (2 * (opacities / LEAST_ALPHA).clamp(min=1).log()).sqrt()
    deviation_y = 1 / last
    deviation_x = torch.hypot(torch.ones_like(shear), shear * deviation_y) / first
    return reach[:, None] * torch.stack([deviation_x, deviation_y], dim=-1)


def blend(projection: Projection, features: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Blend projected Gaussians from front to back, tile by tile.

    Args:
        projection: Projected Gaussians; those of equal depth keep their order.
        features: Features to blend. [N, K]
        camera: Size of the image.

    Returns:
        Sums of weight times feature, and opacity. [H, W, K], [H, W]
    """
    order = projection.depths.detach().argsort(stable=True)
    order = order[projection.radii[order] > 0]
    means, whitening, opacities = (
        t[order] for t in (projection.means, projection.whitening, projection.opacities)
    )
    features = features[order]
    with torch.no_grad():
        extent = extents(whitening, opacities) + 1  # A pixel for rounding.
        low, high = means - extent, means + extent
    rows = []
    for top in range(0, camera.height, TILE):
        bottom = min(top + TILE, camera.height)
        columns = []
        for left in range(0, camera.width, TILE):
            right = min(left + TILE, camera.width)
            near = (low < low.new_tensor([right, bottom])) & (high > low.new_tensor([left, top]))
            members = near.all(-1).nonzero()[:, 0]
            given = (t[members] for t in (means, whitening, opacities, features))
            columns.append(_blend_tile(*given, box=(top, bottom, left, right)))
        rows.append(torch.cat(columns, dim=1))
    image = torch.cat(rows)
    return image[..., :-1], image[..., -1]


def _blend_tile(
    means: Tensor,
    whitening: Tensor,
    opacities: Tensor,
    features: Tensor,
    *,
    box: tuple[int, int, int, int],
) -> Tensor:
    """Features and opacity of the pixels of a box; Gaussians sorted by depth. [h, w, K + 1]"""
    top, bottom, left, right = box
    y = torch.arange(top, bottom).to(means)[:, None, None] + 0.5 - means[:, 1]
    x = torch.arange(left, right).to(means)[:, None] + 0.5 - means[:, 0]
    u, v = whitening[:, 0] * x + whitening[:, 1] * y, whitening[:, 2] * y
    alpha = (opacities * (-0.5 * (u * u + v * v)).exp()).clamp(max=MOST_ALPHA)  # [h, w, n]
    alpha = torch.where(alpha >= LEAST_ALPHA, alpha, 0.0)
    alpha = torch.where((1 - alpha).cumprod(-1) >= LEAST_TRANSMITTANCE, alpha, 0.0)
    after = (1 - alpha).cumprod(-1)
    before = torch.cat([torch.ones_like(x + y)[..., :1], after[..., :-1]], dim=-1)
    weights = alpha * before
    return torch.cat([weights @ features, weights.sum(-1, keepdim=True)], dim=-1)
