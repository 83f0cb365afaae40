"""Compositing at every density, length and count, against float64."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.stress import references
from tests.stress.references import worst
from xplanes.baselines.resampling import ray_weights
from xplanes.rendering.compositing import composite

pytestmark = pytest.mark.stress

DENSITIES = (0.0, 1e-30, 1e-8, 1e-3, 1.0, 1e2, 1e4, 1e8)
LENGTHS = (1e-6, 1e-3, 0.03, 1.0, 1e2)
COUNTS = (1, 2, 7, 64, 1024)
TOLERANCE = {torch.bfloat16: 4e-3, torch.float32: 1e-5, torch.float64: 1e-9}


def test_the_quick_reference_is_the_oracle() -> None:
    draw = np.random.default_rng(0)
    depth, colour, upstream = draw.random(9), draw.random((9, 3)), draw.standard_normal(5)
    distances = 2 + np.cumsum(draw.random(9))
    total, weights, d_depth, d_colour = references.composite(depth, colour, distances, upstream)
    expected, expected_weights = oracles.composite(depth, colour, distances, [0] * 9, 1)
    np.testing.assert_allclose(total, expected[0], atol=1e-12)
    np.testing.assert_allclose(weights, expected_weights, atol=1e-12)
    slopes = oracles.composite_gradient(depth, colour, distances, [0] * 9, 1, upstream[None])
    np.testing.assert_allclose(d_depth, slopes[0], atol=1e-12)
    np.testing.assert_allclose(d_colour, slopes[1], atol=1e-12)


def errors(density, length, count, dtype, seed=0):
    """Values, gradients, and their errors against float64 on the same (rounded) inputs."""
    draw = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, generator=draw, dtype=torch.float64)
    depth = (density * length * (0.5 + uniform)).to(dtype).requires_grad_()
    colour = torch.rand(count, 3, generator=draw, dtype=torch.float64).to(dtype).requires_grad_()
    distances = (2 + length * torch.arange(count, dtype=torch.float64)).to(dtype)
    upstream = torch.randn(5, generator=draw, dtype=torch.float64)
    zeros = torch.zeros(count, dtype=torch.long)
    total, weights = composite(depth, colour, distances, zeros, zeros[:1])
    (total.double() * upstream).sum().backward()
    arrays = [t.detach().double().numpy() for t in (depth, colour, distances)]
    expected = references.composite(*arrays, upstream.numpy())
    scale = abs(float(upstream[4])) * float(arrays[2].max())
    found = (total[0].detach(), weights, depth.grad.double(), colour.grad.double())
    # A gradient below the rounding of its own terms counts against these.
    least = (1e-30, 1e-30, 1e-6 * scale, 1e-30)
    return found, max(worst(o, t, s) for o, t, s in zip(found, expected, least, strict=True))


@pytest.mark.parametrize("loops", ["1", "0"])
@pytest.mark.parametrize("dtype", TOLERANCE)
def test_grid(tally, monkeypatch, dtype, loops) -> None:
    """Compositing: densities 0 to 1e8 x lengths 1e-6 to 1e2 x 1 to 1024 samples, three types"""
    monkeypatch.setenv("XPLANES_CPU_LOOPS", loops)
    for density, length, count in itertools.product(DENSITIES, LENGTHS, COUNTS):
        found, error = errors(density, length, count, dtype)
        tally.finite(*found)
        tally.error(error, TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_drawn(tally, dtype) -> None:
    """Compositing: drawn densities, lengths and counts"""

    @settings(max_examples=300, deadline=None, derandomize=True, database=None)
    @given(st.floats(-40, 8), st.floats(-8, 3), st.integers(1, 1024), st.integers(0, 2**32 - 1))
    def case(density, length, count, seed):
        found, error = errors(10**density, 10**length, count, dtype, seed)
        tally.finite(*found)
        tally.error(error, TOLERANCE[dtype])

    case()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dense_weights(tally, dtype) -> None:
    """Weights of density fields: the same grid, with gradients"""
    for density, length, count in itertools.product(DENSITIES, LENGTHS, COUNTS):
        uniform = torch.rand(1, count, dtype=torch.float64)
        depth = (density * length * (0.5 + uniform)).to(dtype).requires_grad_()
        weights = ray_weights(depth)
        upstream = torch.linspace(-1, 1, count, dtype=dtype)
        (weights * upstream).sum().backward()
        exact = depth.detach().double().requires_grad_()
        before = exact.cumsum(1) - exact
        expected = (-before).exp() * -torch.expm1(-exact)
        (expected * upstream.double()).sum().backward()
        tally.finite(weights, depth.grad)
        tally.error(worst(weights.detach(), expected.detach(), 1e-4), 1e-4)
        tally.error(worst(depth.grad, exact.grad, 1e-3), 1e-3)
