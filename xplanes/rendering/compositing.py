"""Volume rendering: from densities and colours along rays to pixels."""

import functools
import importlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from xplanes.backend import compiled, cpu_loops, gpu_kernels, proven, waves

OPAQUE = 80.0
"""Optical depth that counts as opaque: exp(-80) is 2e-35."""


def composite(
    optical_depth: Tensor,
    colour: Tensor,
    distances: Tensor,
    ray: Tensor,
    starts: Tensor,
    number: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Composite the samples of each ray (Beer-Lambert law).

    Each ray has weights ``w_i = exp(-sum_{j<i} tau_j) (1 - exp(-tau_i))``, from sums of optical
    depths: finite depths of at least 0 never give NaN or infinity. A NaN depth makes its ray NaN.
    Gradients reach depths and colours. Computed by compiled loops on the CPU, by Triton kernels on
    CUDA if they pass their trial, and otherwise by `composite_reference`.

    Args:
        optical_depth: Density times length of each sample; samples of a ray are contiguous, from
            front to back. [N]
        colour: Colour of each sample. [N, 3]
        distances: Distance of each sample from the ray's origin. [N]
        ray: Ray of each sample, ascending. [N]
        starts: Index of each ray's first sample, or of the next ray's if it has none. [R]
        number: Number of samples if the tensors have unused slots at the end, else None. Unused
            slots belong to the last ray and have depth 0. int64 []

    Returns:
        For each ray the sums of weight times (colour, 1, distance) in float32 or better, and the
        weights, which carry no gradient. [R, 5], [N]
    """
    if optical_depth.dtype in (torch.float16, torch.bfloat16):
        optical_depth = optical_depth.float()
    colour, distances = colour.to(optical_depth.dtype), distances.to(optical_depth.dtype)
    if cpu_loops(optical_depth):
        return _Composite.apply(optical_depth, colour, distances, starts)  # type: ignore[return-value]
    if gpu_kernels(optical_depth) and _kernels_hold(optical_depth.device, optical_depth.dtype):
        return composite_gpu(optical_depth, colour, distances, starts, number)
    return composite_reference(optical_depth, colour, distances, ray, starts)


def composite_reference(
    optical_depth: Tensor, colour: Tensor, distances: Tensor, ray: Tensor, starts: Tensor
) -> tuple[Tensor, Tensor]:
    """Reference implementation of `composite`."""
    weights = sample_weights(optical_depth, ray, starts)
    values = torch.cat([colour, torch.ones_like(distances)[:, None], distances[:, None]], dim=1)
    total = torch.zeros(len(starts), 5, dtype=weights.dtype, device=weights.device)
    return total.index_add(0, ray, weights[:, None] * values), weights.detach()


def composite_gpu(
    optical_depth: Tensor,
    colour: Tensor,
    distances: Tensor,
    starts: Tensor,
    number: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """`composite` in Triton: one kernel for the values, one for the gradients."""
    return _Kernels.apply(optical_depth, colour, distances, starts, number)  # type: ignore[return-value]


def stopped(optical_depth: Tensor) -> Tensor:
    """Opacity of an optical depth, with full precision in value and gradient. [...]

    Autograd computes the gradient of ``expm1`` from its value, and loses digits near -1.
    """
    thin = -torch.expm1(-optical_depth)
    return torch.where(optical_depth < 0.5, thin, 1 - (-optical_depth).exp())


def depth_before(optical_depth: Tensor, ray: Tensor, starts: Tensor) -> Tensor:
    """Sum of the values in front of each sample on its own ray, such as optical depths. float64 [N]

    One running sum over all rays, minus the sum at the ray's first sample. In float64, with depths
    limited to `OPAQUE`, a million samples keep seven decimal places.
    """
    depth = optical_depth.double()
    total = depth.cumsum(0) - depth
    # The backward of indexing sorts the indices on a GPU, which takes 3 ms per batch.
    return total - total.index_select(0, starts[ray])


def sample_weights(optical_depth: Tensor, ray: Tensor, starts: Tensor) -> Tensor:
    """The weights of `composite` with gradients, for losses on them.

    Args:
        optical_depth: Density times length of each sample, as in `composite`. [N]
        ray: Ray of each sample, ascending. [N]
        starts: Index of each ray's first sample, or of the next ray's if it has none. [R]

    Returns:
        Weights. [N]
    """
    depth = optical_depth.clamp(0, OPAQUE)
    # A NaN must not reach other rays through the running sum; it affects only its own weight.
    before = depth_before(depth.nan_to_num(0), ray, starts)
    return before.neg().exp().to(depth.dtype) * stopped(depth)


def distortion(
    weights: Tensor,
    distances: Tensor,
    ray: Tensor,
    starts: Tensor,
    total: Tensor,
    ends: Tensor,
    step: float,
) -> Tensor:
    """Distortion loss: expected distance between two absorption events on a ray, mean over rays.

    Light that passes all samples counts as absorbed at ``ends``. The loss is zero for rays that end
    at one surface, and large for fog or a semi-transparent surface in front of another.

    Args:
        weights: Weights of the samples, from `sample_weights`. [N]
        distances: Distance of each sample from the ray's origin. [N]
        ray: Ray of each sample, ascending. [N]
        starts: Index of each ray's first sample, or of the next ray's if it has none. [R]
        total: Sums per ray from `composite`. [R, 5]
        ends: Distance at which light that passes all samples is absorbed. [R]
        step: Length of a sample.

    Returns:
        In units of ``distances``, differentiable with respect to weights. []

    Source: Mip-NeRF 360, Eq. 15, with the transmitted light as one more sample.
    """
    # Pairs in which each sample is the farther one, and pairs within a sample.
    pairs = distances * depth_before(weights, ray, starts)
    pairs = weights * (pairs - depth_before(weights * distances, ray, starts))
    within = weights.square() * (step / 3)
    passing = (1 - total[:, 3]) * (total[:, 3] * ends - total[:, 4])
    return (2 * (pairs.sum() + passing.sum()) + within.sum()).to(weights.dtype) / max(
        1, len(starts)
    )


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, optical_depth: Tensor, colour: Tensor, distances: Tensor, starts: Tensor
    ) -> tuple[Tensor, Tensor]:
        cpu = compiled("xplanes.rendering.rays_numba")
        inputs = [t.contiguous() for t in (optical_depth, colour, distances, starts)]
        weights = torch.empty_like(optical_depth)
        total = optical_depth.new_empty(len(starts), 5)
        arrays = [t.detach().numpy() for t in inputs]
        cpu.composite(*arrays, OPAQUE, weights.numpy(), total.numpy())
        ctx.save_for_backward(*inputs, weights)
        ctx.mark_non_differentiable(weights)
        return total, weights

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        cpu = compiled("xplanes.rendering.rays_numba")
        *inputs, weights = ctx.saved_tensors
        d_depth, d_colour = torch.empty_like(inputs[0]), torch.empty_like(inputs[1])
        arrays = [t.detach().numpy() for t in inputs]
        cpu.composite_backward(
            *arrays,
            OPAQUE,
            weights.numpy(),
            gradients[0].to(weights.dtype).contiguous().numpy(),
            d_depth.numpy(),
            d_colour.numpy(),
        )
        return d_depth, d_colour, None, None


class _Kernels(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        optical_depth: Tensor,
        colour: Tensor,
        distances: Tensor,
        starts: Tensor,
        number: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        gpu = importlib.import_module("xplanes.rendering.compositing_triton")
        if number is None:
            number = starts.new_full((), len(optical_depth))
        inputs = [t.contiguous() for t in (optical_depth, colour, distances, starts, number)]
        # The kernel does not write to unused slots at the end.
        weights, light = torch.zeros_like(inputs[0]), torch.empty_like(inputs[0])
        total = optical_depth.new_empty(len(starts), 5)
        gpu.launch(gpu.forward, len(starts), inputs, (weights, light, total), OPAQUE)
        ctx.save_for_backward(*inputs, weights, light)
        ctx.mark_non_differentiable(weights)
        return total, weights

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        gpu = importlib.import_module("xplanes.rendering.compositing_triton")
        *inputs, weights, light = ctx.saved_tensors
        d_depth, d_colour = torch.zeros_like(inputs[0]), torch.zeros_like(inputs[1])
        gradient = gradients[0].to(weights.dtype).contiguous()
        results = weights, light, gradient, d_depth, d_colour
        gpu.launch(gpu.backward, len(gradient), inputs, results, OPAQUE)
        return d_depth, d_colour, None, None, None


@functools.cache
def _kernels_hold(device: torch.device, dtype: torch.dtype) -> bool:
    """Whether the kernels pass their trial on rays of several lengths, gradients included."""

    def attempt(function: Callable[..., Any], precision: torch.dtype) -> list[Tensor]:
        # A ray of many samples, one of none, and one of a single sample.
        ray = torch.zeros(50, dtype=torch.int64, device=device)
        ray[-1] = 2
        starts = torch.searchsorted(ray, torch.arange(4, device=device))
        leaves = [0.2 + waves(device, 50).abs(), waves(device, 50, 3)]
        leaves = [leaf.to(precision).requires_grad_() for leaf in leaves]
        distances = waves(device, 50).to(precision)
        total, weights = function(*leaves, distances, ray, starts)
        upstream = waves(device, 4, 5).to(precision)
        return [total, weights, *torch.autograd.grad((total * upstream).sum(), leaves)]

    def kernels(
        optical_depth: Tensor, colour: Tensor, distances: Tensor, ray: Tensor, starts: Tensor
    ) -> tuple[Tensor, Tensor]:
        return composite_gpu(optical_depth, colour, distances, starts)

    what = f"compositing ({dtype})"
    return proven(what, device, attempt, kernels, composite_reference, dtype)
