"""Projection and blending of Gaussians in plain torch, differentiated by autograd.

Zwicker et al. 2002 (EWA splatting), Kerbl et al. 2023 (3D Gaussian splatting).
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.rendering.gaussians.camera import Camera

LOW_PASS = 0.3
"""Variance in pixels^2 that is added to every projected Gaussian (Kerbl et al. 2023)."""

LEAST_ALPHA = 1 / 255
"""Alpha below which a Gaussian leaves a pixel alone (Kerbl et al. 2023)."""

MOST_ALPHA = 0.999
"""Alpha of a pixel at most. Kerbl et al. take 0.99, gsplat this."""

LEAST_TRANSMITTANCE = 1e-4
"""A pixel is done before the first Gaussian that would leave less light (Kerbl et al. 2023)."""

LEAST_QUATERNION = 1e-12
"""Shorter quaternions are divided by this length instead of their own: zero rotates nothing."""

TILE = 16
"""Side of the square tiles, in pixels. The image does not depend on it."""


@dataclass(frozen=True)
class Projection:
    """Gaussians as an image plane sees them.

    Attributes:
        means: In pixels from the left and the top edge. [N, 2]
        whitening: Entries xx, xy and yy of the upper triangular W with W^T W the inverse of the
            covariance: W times an offset in pixels is the offset in standard deviations. [N, 3]
        depths: Of the means, along the camera's axis. [N]
        compensation: Share of a Gaussian's peak that the low-pass filter leaves. [N]
        valid: Whether its mean lies between near and far and its projection is finite. bool [N]
    """

    means: Tensor
    whitening: Tensor
    depths: Tensor
    compensation: Tensor
    valid: Tensor


def project(means: Tensor, quaternions: Tensor, scales: Tensor, camera: Camera) -> Projection:
    """Project Gaussians by the linearised perspective of EWA splatting.

    Arguments as in `rasterise`.
    """
    world_to_camera = camera.world_to_camera.to(means)
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    x, y, z = (means @ rotation.T + translation).unbind(-1)
    valid = (z > camera.near) & (z < camera.far)
    z = torch.where(valid, z, 1.0)  # Keeps what is behind the camera out of the gradients.
    left, right, top, bottom = camera.slant
    slant_x, slant_y = (x / z).clamp(left, right), (y / z).clamp(top, bottom)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [camera.fx / z, zero, -camera.fx * slant_x / z]
        + [zero, camera.fy / z, -camera.fy * slant_y / z],
        dim=-1,
    ).view(-1, 2, 3)
    root = jacobian @ rotation @ rotations(quaternions) * scales[:, None, :]
    along_x, along_y = root.unbind(1)
    # The covariance is root root^T + LOW_PASS. Its determinant from areas: no difference of large
    # numbers, however thin the Gaussian.
    area = torch.linalg.cross(along_x, along_y).norm(dim=-1)
    xx, yy = along_x.square().sum(-1), along_y.square().sum(-1)
    determinant = area.square() + LOW_PASS * (xx + yy) + LOW_PASS**2
    yy = yy + LOW_PASS
    first = (yy / determinant).sqrt()
    shear = -(along_x * along_y).sum(-1) / yy
    projected = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=-1)
    whitening = torch.stack([first, first * shear, yy.rsqrt()], dim=-1)
    finite = projected.isfinite().all(-1) & whitening.isfinite().all(-1) & (whitening[:, 0] > 0)
    return Projection(projected, whitening, z, area / determinant.sqrt(), valid & finite)


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
    """How far alpha is `LEAST_ALPHA` or more along x and y, in pixels; 0 where nowhere. [N, 2]

    At most 3.33 standard deviations, those of an opacity of 1.
    """
    first, shear, last = whitening.unbind(-1)
    reach = (2 * (opacities / LEAST_ALPHA).clamp(min=1).log()).sqrt()
    deviation_y = 1 / last
    deviation_x = torch.hypot(torch.ones_like(shear), shear * deviation_y) / first
    return reach[:, None] * torch.stack([deviation_x, deviation_y], dim=-1)


def blend(
    means: Tensor,
    whitening: Tensor,
    opacities: Tensor,
    features: Tensor,
    depths: Tensor,
    visible: Tensor,
    camera: Camera,
) -> tuple[Tensor, Tensor]:
    """Blend projected Gaussians from front to back, one tile of the image after the other.

    Args:
        means: See `Projection`. [N, 2]
        whitening: See `Projection`. [N, 3]
        opacities: Alpha at the means. [N]
        features: What is blended. [N, K]
        depths: By which Gaussians are sorted; those of equal depth keep their order. [N]
        visible: Which of them to draw. bool [N]
        camera: Size of the image.

    Returns:
        Sums of weight times feature, and opacity. [H, W, K], [H, W]
    """
    order = depths.detach().argsort(stable=True)
    order = order[visible[order]]
    extent = extents(whitening.detach(), opacities.detach())[order] + 1  # A pixel for rounding.
    low, high = means.detach()[order] - extent, means.detach()[order] + extent
    rows = []
    for top in range(0, camera.height, TILE):
        bottom = min(top + TILE, camera.height)
        columns = []
        for left in range(0, camera.width, TILE):
            right = min(left + TILE, camera.width)
            near = (low < low.new_tensor([right, bottom])) & (high > low.new_tensor([left, top]))
            columns.append(
                _blend_tile(
                    *(t[order[near.all(-1)]] for t in (means, whitening, opacities, features)),
                    (top, bottom, left, right),
                )
            )
        rows.append(torch.cat(columns, dim=1))
    image = torch.cat(rows)
    return image[..., :-1], image[..., -1]


def _blend_tile(
    means: Tensor,
    whitening: Tensor,
    opacities: Tensor,
    features: Tensor,
    box: tuple[int, int, int, int],
) -> Tensor:
    """Features and opacity of the pixels in ``box`` from Gaussians sorted by depth. [h, w, K + 1]"""
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


def longest_radii(whitening: Tensor) -> Tensor:
    """Three standard deviations along the longest axis, rounded up to pixels. [N]"""
    first, shear, last = whitening.detach().double().unbind(-1)
    # Eigenvalues of the inverse covariance: the smaller one without a difference of large numbers.
    xx, xy, yy = first * first, first * shear, shear * shear + last * last
    larger = 0.5 * (xx + yy) + torch.hypot(0.5 * (xx - yy), xy)
    smaller = (first * last).square() / larger
    return (3 / smaller.sqrt()).ceil().clamp(max=math.ceil(1e9))
