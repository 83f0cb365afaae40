"""Gaussian splatting at every size, distance, opacity and number, against float64."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.baselines import gaussian_oracle as oracle
from tests.stress.references import worst
from xplanes.baselines.gaussians.camera import Camera
from xplanes.baselines.gaussians.rasteriser import GaussianError, rasterise

pytestmark = pytest.mark.stress

SIZE = 16
SIZES = (0.0, 1e-30, 1e-8, 1e-3, 0.1, 10.0, 1e6)
"""Standard deviations, in units of the distance of the camera."""
DISTANCES = (0.02, 1.0, 1e4)
OPACITIES = (0.004, 0.01, 0.5, 0.9999, 1.0)
FLATNESS = (1.0, 1e-4)


@pytest.fixture(params=["1", "0"])
def loops(request, monkeypatch):
    monkeypatch.setenv("XPLANES_CPU_LOOPS", request.param)


def gaussians(count, size, distance, opacity, seed=0, flat=1.0):
    """In front of a camera at the origin that looks along z; one axis ``flat`` times the others."""
    draw = torch.Generator().manual_seed(seed)
    means = 0.2 * torch.randn(count, 3, generator=draw) + torch.tensor([0.0, 0.0, 1.0])
    means[:, 2] = 0.8 + 0.4 * torch.rand(count, generator=draw)
    scales = torch.full((count, 3), size)
    scales[:, 0] *= flat
    return [
        means * distance,
        torch.randn(count, 4, generator=draw),
        scales * distance,
        torch.full((count,), opacity),
        torch.rand(count, 3, generator=draw),
    ]


def compared(tally, given, antialiased, most, length=1.0):
    """Draw forward and back, with quaternions of a length; compare the image with float64."""
    camera = Camera(torch.eye(4), 20.0, 20.0, 0.5 * SIZE, 0.5 * SIZE, SIZE, SIZE)
    leaves = [t.clone().requires_grad_() for t in given]
    leaves[1].data *= length
    image = rasterise(*leaves, camera, antialiased=antialiased)
    outputs = [image.colour, image.opacity, image.depth]
    slope = torch.linspace(-1, 1, SIZE)
    depth = image.depth / given[0][:, 2].max()
    (image.colour.sum(-1) * slope + image.opacity + depth * slope).sum().backward()
    tally.finite(*(t.detach() for t in outputs), *(t.grad for t in leaves))
    if length < 1e-12:
        given[1][:] = torch.tensor([1.0, 0, 0, 0])  # They rotate nothing.
    arrays = [t.double().numpy() for t in given]
    low, expected, high = (
        oracle.splat(arrays, camera, antialiased=antialiased, slack=slack)
        for slack in (-1e-4, 0.0, 1e-4)
    )
    # Rounding decides on which side of a threshold a Gaussian falls that lies on it.
    sure = np.abs(low[1] - high[1]) < 1e-9
    assert sure.any() or not expected[1].any()
    for ours, theirs in zip(outputs, expected, strict=True):
        tally.error(worst(ours.detach()[sure], theirs[sure], 1e-3), most)


@pytest.mark.parametrize("antialiased", [False, True])
def test_grid(tally, loops, antialiased) -> None:
    """Gaussians: sizes 0 to 1e6 x distances 0.02 to 1e4 x opacities 0.004 to 1 x flat or round"""
    for size, distance, opacity, flat in itertools.product(SIZES, DISTANCES, OPACITIES, FLATNESS):
        given = gaussians(20, size, distance, opacity, flat=flat)
        compared(tally, given, antialiased, 1e-4)


def test_drawn(tally, loops) -> None:
    """Gaussians: drawn sizes, distances, opacities, shapes and counts"""

    @settings(max_examples=150, deadline=None, derandomize=True, database=None)
    @given(
        *(st.floats(-12, 4), st.floats(-1.5, 6), st.floats(0.005, 1), st.floats(-6, 0)),
        *(st.integers(1, 60), st.integers(0, 2**32 - 1)),
    )
    def case(size, distance, opacity, flat, count, seed):
        given = gaussians(count, 10**size, 10**distance, opacity, seed, 10**flat)
        compared(tally, given, False, 1e-4)

    case()


def test_layers(tally, loops) -> None:
    """Gaussians: 1 to 10,000 layers of opacities 0.005 to 1, accumulated in float32"""
    for count, opacity in itertools.product((1, 10, 100, 1000, 10_000), (0.005, 0.02, 0.5, 1.0)):
        compared(tally, gaussians(count, 10.0, 1.0, opacity), False, 1e-4)


def test_quaternions(tally, loops) -> None:
    """Gaussians: quaternions of lengths 0 to 1e18"""
    for length in (0.0, 1e-45, 1e-30, 1e-20, 1e-8, 1.0, 1e6, 1e18):
        given = gaussians(20, 0.1, 1.0, 0.5, flat=0.1)
        compared(tally, given, False, 1e-4, length)


def test_numbers_that_are_not_finite(tally, loops) -> None:
    """Gaussians: one number NaN or infinite"""
    names = ("means", "quaternions", "scales", "opacities", "colours")
    for (position, name), bad in itertools.product(enumerate(names), (np.nan, np.inf, -np.inf)):
        given = gaussians(20, 0.1, 1.0, 0.5)
        given[position].view(-1)[7] = bad
        with pytest.raises(GaussianError) as caught:
            compared(tally, given, False, 1e-4)
        tally.diagnosed(str(caught.value), name)
