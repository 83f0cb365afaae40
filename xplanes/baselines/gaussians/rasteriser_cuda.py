"""Projection and blending on CUDA by gsplat 1.5 (Ye et al. 2024), an optional extra."""

import torch
from torch import Tensor

from xplanes.baselines.gaussians.camera import Camera
from xplanes.baselines.gaussians.reference import LOW_PASS, Splats
from xplanes.optional import require


def draw(
    splats: Splats, camera: Camera, antialiased: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rasterise Gaussians in float32 on CUDA; for the arguments see `rasterise`.

    Returns:
        Projected means (a copy whose ``grad`` the backward pass sets) and radii, see
            `RasterisedImage`; weighted sums of colour and depth; and opacity.
            [N, 2], [N], [H, W, C + 1], [H, W]

    Raises:
        MissingExtraError: If gsplat is not installed.
    """
    gsplat = require("gsplat", extra="gaussians")
    intrinsics = splats.means.new_tensor(
        [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    )
    image, opacity, details = gsplat.rasterization(
        *splats,
        viewmats=camera.world_to_camera.to(splats.means)[None],
        Ks=intrinsics[None],
        width=camera.width,
        height=camera.height,
        near_plane=camera.near,
        far_plane=camera.far,
        eps2d=LOW_PASS,
        packed=False,
        render_mode="RGB+D",
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    attached = details["means2d"]
    means2d = attached.detach()[0]

    def keep(gradient: Tensor) -> None:
        means2d.grad = gradient[0] if means2d.grad is None else means2d.grad + gradient[0]

    if attached.requires_grad:
        means2d.requires_grad_()
        attached.register_hook(keep)
    xx, xy, yy = details["conics"].detach()[0].double().unbind(-1)
    # Eigenvalues of the inverse covariance: the longest axis has the smaller one.
    larger = 0.5 * (xx + yy) + torch.hypot(0.5 * (xx - yy), xy)
    longest = larger / (xx * yy - xy * xy)
    drawn = (details["radii"][0] > 0).all(-1)
    radii = torch.where(drawn, (3 * longest.sqrt()).ceil().clamp(max=1e9), 0).long()
    return means2d, radii, image[0], opacity[0, ..., 0]
