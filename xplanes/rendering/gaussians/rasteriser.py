"""Differentiable rasterisation of 3D Gaussians (Kerbl et al. 2023)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from xplanes.rendering.gaussians import reference
from xplanes.rendering.gaussians.camera import Camera


class GaussianError(ValueError):
    """Gaussians that cannot be drawn; the message names the tensor and the Gaussian."""


@dataclass(frozen=True)
class RasterisedImage:
    """What a camera sees of Gaussians.

    Attributes:
        colour: In front of the background if one was given, else premultiplied. [H, W, C]
        opacity: Share of the light that the Gaussians stop. [H, W]
        depth: Expected depth along the camera's axis, 0 where nothing is. [H, W]
        radii: Three standard deviations of each projected Gaussian along its longest axis, rounded
            up to pixels; 0 for those that are not drawn. int64 [N]
        means2d: Projected means in pixels. After ``means2d.retain_grad()`` and the backward pass,
            ``means2d.grad`` is the gradient by which densification goes. [N, 2]
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    radii: Tensor
    means2d: Tensor


def rasterise(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colours: Tensor,
    camera: Camera,
    background: Tensor | None = None,
    *,
    antialiased: bool = False,
) -> RasterisedImage:
    """Draw Gaussians; gradients reach all tensors but the camera's.

    A Gaussian is drawn in the pixels in which its alpha is 1/255 or more, so that the image does
    not depend on tiles. It is not drawn where its mean is not between near and far, or its
    projection overflows. Gaussians of equal depth are drawn in the order in which they are given.

    Args:
        means: In the world. [N, 3]
        quaternions: Rotations (w, x, y, z) of any length; shorter than 1e-12, they fade to no
            rotation. [N, 4]
        scales: Standard deviations along the rotated axes; zero makes discs, needles and points.
            [N, 3]
        opacities: Alpha at the means, before the low-pass filter if ``antialiased``, in [0, 1]. [N]
        colours: Any number of channels. [N, C]
        camera: Pinhole with OpenCV's axes; `Camera.from_pose` takes those of views.
        background: Colour behind the Gaussians. [C]
        antialiased: Lower the opacity of a Gaussian as the low-pass filter widens it, so that it
            stops as much light as before (Mip-Splatting, Yu et al. 2024).

    Raises:
        GaussianError: If shapes disagree, or a number is not finite.
    """
    given = {
        **{"means": means, "quaternions": quaternions, "scales": scales},
        **{"opacities": opacities, "colours": colours},
    }
    _check(given, background)
    projection = reference.project(means, quaternions, scales, camera)
    if antialiased:
        opacities = opacities * projection.compensation
    drawn = _drawn(projection, opacities, camera)
    colour, opacity = reference.blend(
        projection.means,
        projection.whitening,
        opacities,
        torch.cat([colours, projection.depths[:, None]], dim=1),
        projection.depths,
        drawn,
        camera,
    )
    colour, depth = colour[..., :-1], colour[..., -1]
    if background is not None:
        colour = colour + (1 - opacity)[..., None] * background.to(colour)
    radii = torch.where(drawn, reference.longest_radii(projection.whitening), 0).long()
    return RasterisedImage(
        colour, opacity, depth / opacity.clamp(min=1e-10), radii, projection.means
    )


def _drawn(projection: reference.Projection, opacities: Tensor, camera: Camera) -> Tensor:
    """Which Gaussians reach a pixel of the image. bool [N]"""
    means = projection.means.detach()
    extent = reference.extents(projection.whitening.detach(), opacities.detach())
    size = extent.new_tensor([camera.width, camera.height])
    touches = ((means + extent > 0) & (means - extent < size)).all(-1)
    return projection.valid & touches & (opacities.detach() >= reference.LEAST_ALPHA)


def _check(given: dict[str, Tensor], background: Tensor | None) -> None:
    """Refuse what cannot be drawn, by name."""
    count = given["means"].shape[0] if given["means"].ndim else 0
    wanted = {"means": (3,), "quaternions": (4,), "scales": (3,), "opacities": ()}
    for name, tensor in given.items():
        shape = (count, *wanted.get(name, tensor.shape[1:2] or (1,)))
        if tensor.shape != shape:
            expected = f"[{count}, C]" if name == "colours" else f"{list(shape)}"
            raise GaussianError(f"{name} are {list(tensor.shape)}, but must be {expected}")
        if not tensor.isfinite().all():
            row = int((~tensor.reshape(count, -1).isfinite()).any(-1).nonzero()[0])
            raise GaussianError(
                f"{name} of Gaussian {row} of {count} are {tensor[row].tolist()}: must be finite. "
                "Drop such Gaussians, or lower the learning rate that made them"
            )
    if background is not None and background.shape != given["colours"].shape[1:]:
        raise GaussianError(
            f"background is {list(background.shape)}, but must be "
            f"[{given['colours'].shape[1]}], one value for each channel of colours"
        )
