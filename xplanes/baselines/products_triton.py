"""Triton kernels for products of planes on CUDA; `products` holds the readable twin."""

# ruff: noqa: D103 (the callers in products.py document these kernels)

import torch
import triton
import triton.language as tl

from xplanes.fields.lookup_triton import read, spread, tiles, time_taps


@triton.jit
def border_taps(places, n, axis, size, live):
    """Two neighbouring texels and their weights, for coordinates clamped to [-1, 1]."""
    value = tl.load(places + 4 * n + axis, mask=live, other=0.0)
    lower, upper, first, second = time_taps((value + 1) * 0.5, size)
    # Padding of the last block must have no effect.
    return lower, upper, tl.where(live, first, 0.0), tl.where(live, second, 0.0)


@triton.jit
def read_all(planes, sizes, places, n, live, channel, AXES: tl.constexpr, CHANNELS: tl.constexpr):
    """Interpolated features of each plane, as a tuple."""
    found = ()
    for p in tl.static_range(len(AXES)):
        column = border_taps(places, n, AXES[p][0], sizes[p][1], live)
        row = border_taps(places, n, AXES[p][1], sizes[p][0], live)
        value = read(planes[p], 0, sizes[p][1], row, column, channel, CHANNELS)
        found = found + (value,)  # noqa: RUF005 (triton unpacks nothing)
    return found


@triton.jit(do_not_specialize=["count"])
def forward(
    planes,
    sizes,
    places,
    product,
    count,
    AXES: tl.constexpr,
    CHANNELS: tl.constexpr,
    POINTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    n = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    channel = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    values = read_all(planes, sizes, places, n, live, channel, AXES, CHANNELS)
    total = values[0]
    for p in tl.static_range(1, len(AXES)):
        total *= values[p]
    mask = live[:, None] & (channel < CHANNELS)[None, :]
    tl.store(product + n[:, None] * CHANNELS + channel[None, :], total, mask=mask)


@triton.jit(do_not_specialize=["count"])
def backward(
    planes,
    sizes,
    places,
    gradient,
    gradients,
    count,
    AXES: tl.constexpr,
    CHANNELS: tl.constexpr,
    POINTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    n = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    channel = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    mask = live[:, None] & (channel < CHANNELS)[None, :]
    upstream = tl.load(gradient + n[:, None] * CHANNELS + channel[None, :], mask=mask, other=0.0)
    values = read_all(planes, sizes, places, n, live, channel, AXES, CHANNELS)
    for p in tl.static_range(len(AXES)):
        # Each factor's gradient is the product of the others; division fails at zeros.
        source = upstream
        for q in tl.static_range(len(AXES)):
            if q != p:
                source *= values[q]
        column = border_taps(places, n, AXES[p][0], sizes[p][1], live)
        row = border_taps(places, n, AXES[p][1], sizes[p][0], live)
        spread(gradients[p], 0, sizes[p][1], row, column, source, channel, CHANNELS)


def multiply(planes, places, axes, product):
    """Launch `forward` for planes [rows, columns, C] each, and write to ``product`` [N, C]."""
    grid, blocks = tiles(*product.shape)
    sizes = tuple(tuple(plane.shape[:2]) for plane in planes)
    with torch.cuda.device_of(product):
        forward[grid](planes, sizes, places, product, len(places), AXES=axes, **blocks)


def multiply_backward(planes, places, axes, gradient, gradients):
    """Launch `backward`, and add to ``gradients``, which have the shapes of ``planes``."""
    grid, blocks = tiles(*gradient.shape)
    sizes = tuple(tuple(plane.shape[:2]) for plane in planes)
    with torch.cuda.device_of(gradient):
        backward[grid](planes, sizes, places, gradient, gradients, len(places), AXES=axes, **blocks)
