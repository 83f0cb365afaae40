"""Triton kernels for compositing on CUDA; the reference implementation is in `compositing`.

A program handles one ray, a block of samples at a time, with sums in the precision of the optical
depths. No sum is shared between programs, so that results are deterministic. Imported only when
needed, since triton takes a while to load.
"""

# ruff: noqa: D103 (the callers in compositing.py document these kernels)

import torch
import triton
import triton.language as tl

BLOCK = 32
"""Samples per block of a program: one per thread."""

TERMS = tl.constexpr(12)
"""Terms of the series in `stopped`; the remainder is below the 13th digit."""


@triton.jit
def ends_of(starts, number, rays):
    """Index of a ray, of its first sample, and one past its last sample."""
    ray = tl.program_id(0)
    end = tl.load(starts + ray + 1, mask=ray + 1 < rays, other=tl.load(number))
    return ray, tl.load(starts + ray), end


@triton.jit
def limited(optical_depth, n, live, opaque):
    """Optical depths, clamped to [0, ``opaque``]; NaN stays NaN."""
    depth = tl.load(optical_depth + n, mask=live, other=0.0)
    depth = tl.where(depth < 0, 0.0, depth)
    return tl.where(depth > opaque, opaque, depth).to(optical_depth.dtype.element_ty)


@triton.jit
def stopped(depth):
    """Opacity of an optical depth, with full precision."""
    thin = tl.where(depth < 0.5, depth, 0.0)
    series = tl.full(depth.shape, 1.0, depth.dtype)
    for k in tl.static_range(TERMS):
        series = 1 - thin / (TERMS + 1 - k) * series
    return tl.where(depth < 0.5, thin * series, 1 - tl.exp(-depth))


@triton.jit(do_not_specialize=["rays"])
def forward(
    optical_depth,
    colour,
    distances,
    starts,
    number,
    weights,
    light,
    total,
    rays,
    opaque,
    BLOCK: tl.constexpr,
):
    ray, start, end = ends_of(starts, number, rays)
    zero = tl.zeros([BLOCK], optical_depth.dtype.element_ty)
    red, green, blue, opacity, far, before = zero, zero, zero, zero, zero, zero
    for first in range(start, end, BLOCK):
        n = first + tl.arange(0, BLOCK)
        live = n < end
        # The sum in front excludes the sample itself: subtracting it later would lose digits. A NaN
        # affects only its own weight.
        front = limited(optical_depth, n - 1, live & (n > start), opaque)
        front = tl.where(front == front, front, 0.0)
        left = tl.exp(-(before + tl.cumsum(front, 0)))
        before += tl.sum(front, 0)
        weight = left * stopped(limited(optical_depth, n, live, opaque))
        tl.store(weights + n, weight, mask=live)
        tl.store(light + n, left, mask=live)
        red += weight * tl.load(colour + 3 * n, mask=live, other=0.0)
        green += weight * tl.load(colour + 3 * n + 1, mask=live, other=0.0)
        blue += weight * tl.load(colour + 3 * n + 2, mask=live, other=0.0)
        far += weight * tl.load(distances + n, mask=live, other=0.0)
        opacity += weight
    tl.store(total + 5 * ray, tl.sum(red, 0))
    tl.store(total + 5 * ray + 1, tl.sum(green, 0))
    tl.store(total + 5 * ray + 2, tl.sum(blue, 0))
    tl.store(total + 5 * ray + 3, tl.sum(opacity, 0))
    tl.store(total + 5 * ray + 4, tl.sum(far, 0))


@triton.jit
def value_of(colour, distances, n, live, red, green, blue, opacity, far):
    """Gradient with respect to a sample's weight, from the gradient of its ray's sums."""
    value = red * tl.load(colour + 3 * n, mask=live, other=0.0)
    value += green * tl.load(colour + 3 * n + 1, mask=live, other=0.0)
    value += blue * tl.load(colour + 3 * n + 2, mask=live, other=0.0)
    return value + far * tl.load(distances + n, mask=live, other=0.0) + opacity


@triton.jit(do_not_specialize=["rays"])
def backward(
    optical_depth,
    colour,
    distances,
    starts,
    number,
    weights,
    light,
    gradient,
    d_depth,
    d_colour,
    rays,
    opaque,
    BLOCK: tl.constexpr,
):
    ray, start, end = ends_of(starts, number, rays)
    red, green = tl.load(gradient + 5 * ray), tl.load(gradient + 5 * ray + 1)
    blue, opacity = tl.load(gradient + 5 * ray + 2), tl.load(gradient + 5 * ray + 3)
    far = tl.load(gradient + 5 * ray + 4)
    after = tl.zeros([BLOCK], optical_depth.dtype.element_ty)
    blocks = tl.cdiv(end - start, BLOCK)
    for block in range(blocks):
        n = start + (blocks - 1 - block) * BLOCK + tl.arange(0, BLOCK)
        live, inner = n < end, n + 1 < end
        # From back to front, again without the sample itself: tiny gradients keep all digits, which
        # matters because Adam rescales them.
        value = value_of(colour, distances, n + 1, inner, red, green, blue, opacity, far)
        weight = tl.load(weights + n + 1, mask=inner, other=0.0)
        worth = tl.where(inner, weight * value, 0.0)
        behind = after + tl.cumsum(worth, 0, reverse=True)
        after += tl.sum(worth, 0)
        given = tl.load(optical_depth + n, mask=live, other=0.0)
        inside = (given >= 0) & (given <= opaque)
        left = tl.load(light + n, mask=live, other=0.0) * tl.exp(-tl.where(inside, given, 0.0))
        value = value_of(colour, distances, n, live, red, green, blue, opacity, far)
        # Gain of this sample as its depth grows, minus the loss of all samples behind it.
        tl.store(d_depth + n, tl.where(inside, left * value - behind, 0.0), mask=live)
        weight = tl.load(weights + n, mask=live, other=0.0)
        tl.store(d_colour + 3 * n, weight * red, mask=live)
        tl.store(d_colour + 3 * n + 1, weight * green, mask=live)
        tl.store(d_colour + 3 * n + 2, weight * blue, mask=live)


def launch(kernel, rays, inputs, results, opaque):
    """Launches `forward` or `backward` for a number of rays."""
    if rays:
        with torch.cuda.device_of(inputs[0]):
            kernel[(rays,)](*inputs, *results, rays, opaque, BLOCK=BLOCK, num_warps=1)
