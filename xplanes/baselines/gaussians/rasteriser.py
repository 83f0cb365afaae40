"""Differentiable rasterisation of 3D Gaussians (Kerbl et al. 2023)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from xplanes.backend import compiled, cpu_loops
from xplanes.baselines.gaussians import rasteriser_cuda
from xplanes.baselines.gaussians.camera import Camera
from xplanes.baselines.gaussians.reference import Splats, blend, project
from xplanes.errors import XPlanesError

MOST = 2**24
"""Number of consecutive integers that float32 represents exactly."""


class GaussianError(XPlanesError, ValueError):
    """Gaussians that cannot be rasterised; the message names the tensor and the Gaussian."""


@dataclass(frozen=True)
class RasterisedImage:
    """An image of Gaussians, rendered by `rasterise`.

    Attributes:
        colour: Composited on the background if one was given, else premultiplied by opacity.
            [H, W, C]
        opacity: Accumulated opacity, from 0 to 1. [H, W]
        depth: Expected depth along the optical axis in world units; 0 where opacity is 0. [H, W]
        radii: Three standard deviations of each projected Gaussian along its longest axis, rounded
            up to pixels; 0 for Gaussians that are not drawn. int64 [N]
        means2d: Projected means in pixels. After ``means2d.retain_grad()`` and the backward pass,
            ``means2d.grad`` is the gradient that densification uses. [N, 2]
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
    """Rasterise Gaussians; gradients reach all tensors except the camera's.

    A Gaussian is drawn in the pixels where its alpha is at least 1/255, so the image does not
    depend on tiles. It is not drawn if its mean does not lie between near and far, or if its
    projection overflows. Gaussians of equal depth are drawn in the given order.

    Args:
        means: Positions in the world. [N, 3]
        quaternions: Rotations (w, x, y, z), normalised internally; below a length of 1e-12 they
            approach the identity. [N, 4]
        scales: Standard deviations along the rotated axes in world units, 0 or more; with zeros
            Gaussians become discs, lines or points. [N, 3]
        opacities: Alpha at the means, before the low-pass filter if ``antialiased``, in [0, 1]. [N]
        colours: Any number of channels. [N, C]
        camera: Pinhole camera with OpenCV axes; `Camera.from_pose` accepts the poses of `Views`.
        background: Colour behind the Gaussians. [C]
        antialiased: Lower the opacity of each Gaussian to compensate for its widening by the
            low-pass filter (Mip-Splatting, Yu et al. 2024).

    In float32, the CPU uses compiled loops, which are deterministic, and CUDA uses gsplat (extra
    ``gaussians``), which is not. In float64, both use plain torch.

    Raises:
        GaussianError: If shapes disagree, a number is not finite or out of range, or there are too
            many Gaussians.
        MissingExtraError: If float32 tensors are on CUDA and gsplat is not installed.

    Source: Kerbl et al. 2023 (3D Gaussian splatting).
    """
    given = Splats(means, quaternions, scales, opacities, colours)
    _check(given._asdict(), background)
    dtype = torch.float64 if means.dtype == torch.float64 else torch.float32
    splats = Splats(*(tensor.to(dtype) for tensor in given))
    draw = _draw_reference
    if dtype == torch.float32:
        if cpu_loops(splats.means):
            draw = _draw
        elif means.is_cuda:
            draw = rasteriser_cuda.draw
    means2d, radii, image, opacity = draw(splats, camera, antialiased)
    colour, depth = image[..., :-1], image[..., -1]
    if background is not None:
        colour = colour + (1 - opacity)[..., None] * background.to(colour)
    depth = depth / opacity.clamp(min=1e-10)
    return RasterisedImage(colour, opacity, depth, radii, means2d)


def _draw_reference(
    splats: Splats, camera: Camera, antialiased: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Projected means and radii, sums of colours and depths, and opacity, in plain torch."""
    projection = project(splats, camera, antialiased)
    features = torch.cat([splats.colours, projection.depths[:, None]], dim=1)
    return projection.means, projection.radii, *blend(projection, features, camera)


def _draw(
    splats: Splats, camera: Camera, antialiased: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Version of `_draw_reference` with compiled loops."""
    parts = _Project.apply(camera, antialiased, *splats[:4])
    means2d, _, depths, _, radii = parts  # type: ignore[misc]
    features = torch.cat([splats.colours, depths[:, None]], dim=1)
    return means2d, radii, *_Blend.apply(camera, *parts, features)  # type: ignore[misc]


class _Project(torch.autograd.Function):
    """Means, quaternions, scales and opacities to the parts of a `Projection`."""

    @staticmethod
    def forward(ctx: Any, camera: Camera, antialiased: bool, *given: Tensor) -> tuple[Tensor, ...]:
        inputs = [t.contiguous() for t in given]
        ctx.camera = np.array(
            [
                *camera.world_to_camera[:3].double().flatten().tolist(),
                *(camera.fx, camera.fy, camera.cx, camera.cy),
                *camera.slant,
            ]
        )
        ctx.antialiased, count = antialiased, len(inputs[0])
        shapes = ((count, 2), (count, 3), (count,), (count,))
        outputs = [inputs[0].new_empty(shape) for shape in shapes]
        outputs.append(torch.empty(count, dtype=torch.int64))
        compiled("xplanes.baselines.gaussians.rasteriser_numba").project(
            *(t.detach().numpy() for t in inputs),
            ctx.camera,
            *(camera.near, camera.far, antialiased, camera.width, camera.height),
            *(t.numpy() for t in outputs),
        )
        ctx.save_for_backward(*inputs, outputs[-1])
        ctx.mark_non_differentiable(outputs[-1])
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        *inputs, radii = ctx.saved_tensors
        found = [torch.empty_like(t) for t in inputs]
        compiled("xplanes.baselines.gaussians.rasteriser_numba").project_backward(
            *(t.detach().numpy() for t in inputs),
            *(ctx.camera, ctx.antialiased, radii.numpy()),
            *(t.contiguous().numpy() for t in gradients[:-1]),
            *(t.numpy() for t in found),
        )
        return None, None, *found


class _Blend(torch.autograd.Function):
    """The parts of a `Projection` and features to their weighted sums, and opacity."""

    @staticmethod
    def forward(ctx: Any, camera: Camera, *given: Tensor) -> tuple[Tensor, Tensor]:
        means, whitening, depths, opacities, radii, features = given
        cpu = compiled("xplanes.baselines.gaussians.rasteriser_numba")
        order = cpu.depth_order(depths.numpy(), radii.numpy())
        channels = -(-features.shape[1] // cpu.GROUP) * cpu.GROUP
        geometry = np.empty((len(order), cpu.GEOMETRY), np.float32)
        gathered = np.empty((len(order), channels), np.float32)
        arrays = [t.detach().numpy() for t in (means, whitening, opacities, features)]
        cpu.gather(order, *arrays, geometry, gathered)
        columns, rows = -(-camera.width // cpu.TILE_WIDTH), -(-camera.height // cpu.TILE_HEIGHT)
        slots = np.zeros(len(order) + 1, np.int64)
        cpu.count_tiles(geometry, columns, rows, slots[1:])
        slots.cumsum(out=slots)
        if max(len(order), slots[-1] >> 7) >= MOST:
            raise GaussianError(
                f"{len(order)} Gaussians reach {slots[-1]} tiles: must be less than {MOST} and "
                f"{MOST << 7}. Prune them, or render a smaller image"
            )
        tiles, owners = np.empty((2, slots[-1]), np.int32)
        cpu.list_tiles(geometry, columns, rows, slots, tiles, owners)
        members, starts = cpu.bin_tiles(tiles, columns * rows)
        image = means.new_empty(camera.height, camera.width, channels)
        state = np.empty((columns * rows, 2, cpu.PIXELS), np.float32)
        opacity = means.new_empty(camera.height, camera.width)
        blended = (geometry, gathered, owners, members, starts, columns)
        cpu.blend(*blended, image.numpy(), opacity.numpy(), state)
        ctx.order, ctx.slots, ctx.blended, ctx.state = order, slots, blended, state
        ctx.shapes = [t.shape for t in (means, whitening, opacities, features)]
        return image[..., : features.shape[1]], opacity

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, d_image: Tensor, d_opacity: Tensor
    ) -> tuple[Tensor | None, ...]:
        cpu = compiled("xplanes.baselines.gaussians.rasteriser_numba")
        geometry, gathered = ctx.blended[:2]
        partial = np.empty((ctx.slots[-1], cpu.MOMENTS + gathered.shape[1]), np.float32)
        padded = F.pad(d_image, (0, gathered.shape[1] - d_image.shape[2]))
        cpu.blend_backward(
            *ctx.blended,
            ctx.state,
            *(padded.contiguous().numpy(), d_opacity.contiguous().numpy()),
            partial,
        )
        d_means, d_whitening, d_opacities, d_features = (d_image.new_zeros(s) for s in ctx.shapes)
        found = [t.numpy() for t in (d_means, d_whitening, d_opacities, d_features)]
        cpu.scatter(ctx.order, geometry, ctx.slots, partial, *found)
        return None, d_means, d_whitening, None, d_opacities, None, d_features


def _check(given: dict[str, Tensor], background: Tensor | None) -> None:
    """Check the tensors; errors name the one that is wrong."""
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
    scales, opacities = given["scales"], given["opacities"]
    for name, wrong, allowed in (
        ("scales", (scales < 0).any(-1), "0 or more"),
        ("opacities", (opacities < 0) | (opacities > 1), "from 0 to 1"),
    ):
        if wrong.any():
            row = int(wrong.nonzero()[0])
            value = given[name][row].tolist()
            raise GaussianError(f"{name} of Gaussian {row} are {value}: must be {allowed}")
    if background is not None and background.shape != given["colours"].shape[1:]:
        raise GaussianError(
            f"background is {list(background.shape)}, but must be "
            f"[{given['colours'].shape[1]}], one value for each channel of colours"
        )
