"""Reading feature planes at points, and writing gradients back.

A plane is stored channels-last, [H, W, C]: the C numbers of a texel are contiguous, so that one
memory access reads them all. Plane "ab" has axis a along its columns and axis b along its rows.

Space axes follow the LRMs' convention: coordinates from -1 to 1 span whole texels
(``align_corners=False``), and planes are zero outside. The time axis runs from the centre of the
first row (t = 0) to that of the last (t = 1): with as many rows as frames, each frame has its own.
"""

import functools
import importlib
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from xplanes.backend import compiled, cpu_loops, gpu_kernels, proven, waves

Rows = tuple[tuple[int, int], ...]
"""For each space plane, the two time planes whose product is added to it."""

SPACE_COLUMNS = (0, 0, 1)
SPACE_ROWS = (1, 2, 2)
"""Axes (x = 0, y = 1, z = 2) along columns and rows of the planes xy, xz, yz."""


def time_plane_axes(rows: Rows) -> list[int]:
    """Space axis along the columns of each time plane of a plane set, in order of the planes."""
    axes: dict[int, int] = {}
    for (first, second), column, row in zip(rows, SPACE_COLUMNS, SPACE_ROWS, strict=bool(rows)):
        axes[first], axes[second] = column, row
    return [axes[plane] for plane in sorted(axes)]


def plane_features(
    space: Tensor,
    time: Tensor | None,
    points: Tensor,
    times: Tensor,
    rows: Rows,
    fine: Tensor | None = None,
) -> Tensor:
    """Features of Eq. 15: each space plane plus the product of its two time planes.

    Gradients reach the planes only. Computed by compiled loops on the CPU, by Triton kernels on
    CUDA if they pass their trial, and otherwise by `plane_features_reference`.

    Args:
        space: Planes xy, xz, yz. [3, H, H, C]
        time: Space-time planes, with time along the rows; None for a static scene. [P, T, H', C]
        points: Positions in the field's frame. [N, 3]
        times: Times from 0 to 1. [N]
        rows: For each space plane, the two time planes that are multiplied.
        fine: Further planes xy, xz, yz that are added to the first channels, C' <= C.
            [3, F, F, C']

    Returns:
        One feature vector per space plane. [N, 3, C]

    Source: X-Planes, Eq. 15.
    """
    if cpu_loops(space):
        return _Features.apply(space, time, fine, points, times, rows)  # type: ignore[return-value]
    if fine is not None:
        found = plane_features(space, time, points, times, rows)
        further = plane_features(fine, None, points, times, ())
        return found + F.pad(further, (0, space.shape[3] - fine.shape[3]))
    if gpu_kernels(space) and _kernels_hold(
        space.device, space.dtype, space.shape[3], rows if time is not None else ()
    ):
        return plane_features_gpu(space, time, points, times, rows)
    return plane_features_reference(space, time, points, times, rows)


def plane_features_reference(
    space: Tensor, time: Tensor | None, points: Tensor, times: Tensor, rows: Rows
) -> Tensor:
    """Reference implementation of `plane_features`: one ``grid_sample`` per plane."""
    # Planes are zero beyond 2; clamping avoids the NaNs that infinite coordinates would give.
    points, times = points.to(space.dtype).clamp(-4, 4), times.to(space.dtype)

    def sample(plane: Tensor, columns: Tensor, line: Tensor) -> Tensor:
        grid = torch.stack([columns, line], dim=-1)[None, None]
        return F.grid_sample(plane.permute(2, 0, 1)[None], grid, align_corners=False)[0, :, 0].T

    features = [
        sample(plane, points[:, column], points[:, row])
        for plane, column, row in zip(space, SPACE_COLUMNS, SPACE_ROWS, strict=True)
    ]
    if time is not None:
        # Time runs from the centre of the first row to the centre of the last.
        line = (2 * times.clamp(0, 1) - 1) * (1 - 1 / time.shape[1])
        axes = time_plane_axes(rows)
        factors = [sample(p, points[:, axis], line) for p, axis in zip(time, axes, strict=True)]
        features = [f + factors[a] * factors[b] for f, (a, b) in zip(features, rows, strict=True)]
    return torch.stack(features, dim=1)


def plane_features_gpu(
    space: Tensor, time: Tensor | None, points: Tensor, times: Tensor, rows: Rows
) -> Tensor:
    """`plane_features` in Triton: one kernel for the values, one for the gradients.

    Planes of half precision are interpolated and accumulated in float32.
    """
    return _Kernels.apply(space, time, points, times, rows)  # type: ignore[return-value]


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        space: Tensor,
        time: Tensor | None,
        fine: Tensor | None,
        points: Tensor,
        times: Tensor,
        rows: Rows,
    ) -> Tensor:
        cpu = compiled("xplanes.fields.lookup_numba")
        moving = space.new_zeros(0, 1, 1, space.shape[3]) if time is None else time
        count, channels = len(points), space.shape[3]
        points, times = points.to(space.dtype).contiguous(), times.to(space.dtype).contiguous()
        pairs = torch.tensor(rows or [(0, 0)] * 3)
        axes = torch.tensor(time_plane_axes(rows), dtype=torch.int64)
        features = space.new_empty(count, 3, channels)
        factors = space.new_empty(count, len(moving), channels)
        cpu.gather(*_arrays(space, moving, points, times, pairs, axes), *_arrays(features, factors))
        if fine is not None:
            cpu.gather_onto(*_arrays(fine, points, features))
        ctx.save_for_backward(points, times, pairs, axes, factors)
        ctx.shapes = (space.shape, moving.shape, None if fine is None else fine.shape)
        return features

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        cpu = compiled("xplanes.fields.lookup_numba")
        points, times, pairs, axes, factors = ctx.saved_tensors
        gradient = gradients[0].to(factors.dtype).contiguous()
        space, time, fine = (
            gradient.new_zeros(shape) if asked else None
            for shape, asked in zip(ctx.shapes, ctx.needs_input_grad, strict=False)
        )
        for planes in (space, fine):
            if planes is not None:
                tasks = cpu.tasks_a_plane(len(planes))
                cpu.scatter_space(*_arrays(points, gradient), tasks, *_arrays(planes))
        if time is not None:
            spread = torch.empty_like(factors)
            cpu.product_gradients(*_arrays(pairs, gradient, factors, spread))
            tasks = cpu.tasks_a_plane(len(time))
            cpu.scatter_time(*_arrays(points, times, axes, spread), tasks, *_arrays(time))
        return space, time, fine, None, None, None


class _Kernels(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, space: Tensor, time: Tensor | None, points: Tensor, times: Tensor, rows: Rows
    ) -> Tensor:
        exact = torch.promote_types(space.dtype, torch.float32)
        points, times = points.to(exact).contiguous(), times.to(exact).contiguous()
        space, time = space.contiguous(), None if time is None else time.contiguous()
        axes = () if time is None else tuple(time_plane_axes(rows))
        features = space.new_empty(len(points), 3, space.shape[3])
        if len(points):
            gpu = importlib.import_module("xplanes.fields.lookup_triton")
            gpu.gather(space, time, points, times, rows, axes, features)
        ctx.save_for_backward(time, points, times)
        ctx.space, ctx.rows, ctx.axes = (space.shape, space.dtype), rows, axes
        return features

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        time, points, times = ctx.saved_tensors
        (shape, dtype), rows, axes = ctx.space, ctx.rows, ctx.axes
        gradient = gradients[0].to(points.dtype).contiguous()
        of_space = gradient.new_zeros(shape) if ctx.needs_input_grad[0] else None
        of_time = gradient.new_zeros(time.shape) if ctx.needs_input_grad[1] else None
        if len(points):
            gpu = importlib.import_module("xplanes.fields.lookup_triton")
            gpu.scatter(shape[1], time, points, times, rows, axes, gradient, of_space, of_time)
        of_space = None if of_space is None else of_space.to(dtype)
        of_time = None if of_time is None else of_time.to(time.dtype)
        return of_space, of_time, None, None, None


@functools.cache
def _kernels_hold(device: torch.device, dtype: torch.dtype, channels: int, rows: Rows) -> bool:
    """Whether the kernels pass their trial for such planes, gradients included."""

    def attempt(function: Callable[..., Tensor], precision: torch.dtype) -> list[Tensor]:
        stacks = [waves(device, 3, 5, 5, channels)]
        if rows:
            stacks.append(waves(device, len(time_plane_axes(rows)), 4, 7, channels))
        leaves = [stack.to(dtype).to(precision).requires_grad_() for stack in stacks]
        moving, points, times = leaves[1] if rows else None, waves(device, 50, 3), waves(device, 50)
        value = function(leaves[0], moving, 1.4 * points, 0.5 + 0.6 * times, rows)
        upstream = waves(device, 50, 3, channels).to(precision)
        return [value, *torch.autograd.grad((value * upstream).sum(), leaves)]

    what = f"plane lookup ({channels} channels, {dtype})"
    return proven(what, device, attempt, plane_features_gpu, plane_features_reference, dtype)


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    return tuple(tensor.detach().numpy() for tensor in tensors)
