"""K-Planes' field against loops, and against what was published."""

import math

import numpy as np
import pytest
import torch

from tests.baselines.oracles import product_features
from xplanes.baselines.kplanes.field import DensityField, ExplicitDecoder, HybridDecoder, KPlanes
from xplanes.baselines.networks import PaddedMLP, truncated_exponential
from xplanes.baselines.products import PlaneProducts, plane_product, plane_product_reference


def products(time=3, channels=2, scales=(1, 2)):
    torch.manual_seed(0)
    found = PlaneProducts(channels, 4, scales, time, low=0.1, high=0.5)
    with torch.no_grad():
        for _, plane in found.planes():
            plane.uniform_(-1, 1)
    return found


@pytest.mark.parametrize(("loops", "time"), [("0", 3), ("0", None), ("1", 3)])
def test_products_of_planes_are_those_of_the_formula(monkeypatch, loops, time):
    """Inside and outside of the cube."""
    monkeypatch.setenv("XPLANES_CPU_LOOPS", loops)
    planes, points = products(time, channels=5).double(), torch.randn(40, 3).double()
    times = torch.rand(40).double()
    arrays = [(name, plane.detach()[0].numpy()) for name, plane in planes.planes()]
    expected = product_features(arrays, points.numpy(), times.numpy())
    np.testing.assert_allclose(planes(points, times).detach(), expected, atol=1e-12)


@pytest.mark.parametrize(("dtype", "time"), [(torch.float32, 3), (torch.float64, None)])
def test_compiled_loops_equal_their_readable_twin(dtype, time):
    planes = products(time, channels=5).to(dtype)
    with torch.no_grad():
        for _, plane in planes.planes():
            plane[..., 1, 1] = 0  # A product of zeros has gradients all the same.
    # More points than a block holds, some of them on texels and far outside.
    places = 1.5 * torch.randn(5000, 4, dtype=dtype)
    places[:200] = places[:200].sign()
    places[200] = torch.inf
    upstream = torch.randn(5000, 5, dtype=dtype)
    tolerance = {"atol": 2e-4, "rtol": 1e-4} if dtype == torch.float32 else {}
    for scale in planes.scales:
        tensors = [scale[name] for name in planes.names]
        results = []
        for function in (plane_product, plane_product_reference):
            value = function(tensors, places, planes.names)
            gradients = torch.autograd.grad((value * upstream).sum(), tensors)
            results.append((value, *gradients))
        for fast, plain in zip(*results, strict=True):
            torch.testing.assert_close(fast, plain, **tolerance)


def test_padding_acts_as_columns_of_ones():
    torch.manual_seed(0)
    network = PaddedMLP([5, 16, 2]).double()
    values = torch.randn(7, 5).double()
    filled = torch.cat([values, torch.ones(7, 11).double()], dim=1)
    first, second = network.weights
    torch.testing.assert_close(network(values), (filled @ first.T).relu() @ second.T)
    network(values).sum().backward()
    bias = first.grad[:, 5:]
    assert (bias == bias[:, :1]).all()
    assert bias.abs().max() > 0


def test_truncated_exponential_has_the_gradient_of_a_limited_logit():
    logits = torch.tensor([-20.0, 0.0, 3.0, 40.0], dtype=torch.float64, requires_grad=True)
    values = truncated_exponential(logits)
    torch.testing.assert_close(values, logits.detach().exp())
    values.sum().backward()
    expected = [math.exp(min(max(x, -15), 15)) for x in (-20, 0, 3, 40)]
    torch.testing.assert_close(logits.grad, torch.tensor(expected, dtype=torch.float64))


def test_densities_are_exponentials_of_a_shifted_logit_in_units_of_the_frame():
    torch.manual_seed(0)
    points, times = 2 * torch.rand(50, 3) - 1, torch.rand(50)
    proposal = DensityField(PlaneProducts(4, 6, [1], 3, low=0.1, high=0.15), 8, unit=2.5)
    logit = proposal.network(proposal.products(points, times))[:, 0]
    torch.testing.assert_close(proposal(points, times), 2.5 * (logit - 1).exp())
    products = PlaneProducts(4, 6, [1], 3, low=0.1, high=0.5)
    for decoder in (HybridDecoder(products.features, 8), ExplicitDecoder(products.features, 8)):
        field = KPlanes(products, decoder, 2.5)
        logit, _ = decoder.geometry(products(points, times))
        torch.testing.assert_close(field.geometry(points, times)[0], 2.5 * (logit - 1).exp())
