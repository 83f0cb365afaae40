"""Compiled loops for products of planes on the CPU; `products` holds the readable twin."""

# ruff: noqa: D103 (the callers in products.py document these loops)

from numba import prange

from xplanes.backend import njit
from xplanes.fields.lookup_numba import add, time_taps


@njit(forceinline=True)
def border_taps(value, size):
    return time_taps((value + type(value)(1)) * type(value)(0.5), size)


@njit(parallel=True)
def multiply(planes, places, axes, product):
    channels = product.shape[1]
    for n in prange(places.shape[0]):
        for p in range(len(planes)):
            plane = planes[p]
            c0, c1, u0, u1 = border_taps(places[n, axes[p, 0]], plane.shape[1])
            r0, r1, v0, v1 = border_taps(places[n, axes[p, 1]], plane.shape[0])
            w00, w01, w10, w11 = v0 * u0, v0 * u1, v1 * u0, v1 * u1
            for c in range(channels):
                value = (
                    w00 * plane[r0, c0, c]
                    + w01 * plane[r0, c1, c]
                    + w10 * plane[r1, c0, c]
                    + w11 * plane[r1, c1, c]
                )
                if p == 0:
                    product[n, c] = value
                else:
                    product[n, c] *= value


@njit(parallel=True)
def multiply_backward(planes, places, axes, gradient, spread, gradients):
    """Gradients of `multiply`, in blocks whose intermediate results fit in the cache."""
    block, count, channels = spread.shape
    for start in range(0, places.shape[0], block):
        size = min(block, places.shape[0] - start)
        for i in prange(size):
            n = start + i
            for p in range(count):
                plane = planes[p]
                c0, c1, u0, u1 = border_taps(places[n, axes[p, 0]], plane.shape[1])
                r0, r1, v0, v1 = border_taps(places[n, axes[p, 1]], plane.shape[0])
                w00, w01, w10, w11 = v0 * u0, v0 * u1, v1 * u0, v1 * u1
                for c in range(channels):
                    spread[i, p, c] = (
                        w00 * plane[r0, c0, c]
                        + w01 * plane[r0, c1, c]
                        + w10 * plane[r1, c0, c]
                        + w11 * plane[r1, c1, c]
                    )
            for c in range(channels):
                # Each factor's gradient is the product of the others; division fails at zeros.
                before = gradient[n, c]
                for p in range(count):
                    value = spread[i, p, c]
                    spread[i, p, c] = before
                    before *= value
                    for q in range(p):
                        spread[i, q, c] *= value
        for p in prange(count):
            plane, target = planes[p], gradients[p]
            for i in range(size):
                n = start + i
                c0, c1, u0, u1 = border_taps(places[n, axes[p, 0]], plane.shape[1])
                r0, r1, v0, v1 = border_taps(places[n, axes[p, 1]], plane.shape[0])
                source = spread[i, p]
                add(target[r0, c0], source, v0 * u0)
                add(target[r0, c1], source, v0 * u1)
                add(target[r1, c0], source, v1 * u0)
                add(target[r1, c1], source, v1 * u1)
