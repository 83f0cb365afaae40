"""K-Planes' field against loops, and against what was published."""

import math

import numpy as np
import pytest
import torch

from tests.baselines.oracles import product_features
from xplanes.baselines.kplanes.field import DensityField, ExplicitDecoder, HybridDecoder, KPlanes
from xplanes.baselines.networks import PaddedMLP, spherical_harmonics, truncated_exponential
from xplanes.baselines.products import PlaneProducts, plane_product, plane_product_reference


def products(time=3, channels=2, scales=(1, 2)):
    torch.manual_seed(0)
    found = PlaneProducts(channels, 4, scales, time, low=0.1, high=0.5)
    with torch.no_grad():
        for _, plane in found.planes():
            plane.uniform_(-1, 1)
    return found


def count(*modules):
    return sum(p.numel() for module in modules for p in module.parameters())


def expected_of(planes, points, times):
    """Features of planes at points by the oracle's loops."""
    arrays = [(name, plane.detach()[0].double().numpy()) for name, plane in planes.planes()]
    places = points.double().numpy(), times.double().numpy()
    return product_features(arrays, planes.channels, *places)


def test_products_of_planes_equal_loops_inside_and_outside_the_cube(monkeypatch):
    monkeypatch.setenv("XPLANES_CPU_LOOPS", "0")
    for time in (3, None):
        planes = products(time).double()
        points, times = torch.randn(40, 3).double(), torch.rand(40).double()
        found = planes(points, times).detach().numpy()
        expected = expected_of(planes, points, times)
        np.testing.assert_allclose(found, expected, atol=1e-12, err_msg=f"time={time}")


@pytest.mark.parametrize(
    ("dtype", "time"),
    # As in training. The other is compiled again, for seconds.
    [(torch.float32, 3), pytest.param(torch.float64, None, marks=pytest.mark.slow)],
)
def test_compiled_loops_equal_the_oracle_and_their_readable_twin(dtype, time):
    single = dtype == torch.float32
    planes = products(time, channels=5).to(dtype)
    points, times = torch.randn(40, 3, dtype=dtype), torch.rand(40, dtype=dtype)
    found = planes(points, times).detach().numpy()
    expected = expected_of(planes, points, times)
    np.testing.assert_allclose(found, expected, atol=5e-6 if single else 1e-12)
    with torch.no_grad():
        for _, plane in planes.planes():
            plane[..., 1, 1] = 0  # A product of zeros has gradients all the same.
    # More points than a block holds, some of them on texels and far outside.
    places = 1.5 * torch.randn(5000, 4, dtype=dtype)
    places[:200] = places[:200].sign()
    places[200] = torch.inf
    upstream = torch.randn(5000, 5, dtype=dtype)
    for scale in planes.scales:
        tensors = [scale[name] for name in planes.names]
        results = []
        for function in (plane_product, plane_product_reference):
            value = function(tensors, places, planes.names)
            gradients = torch.autograd.grad((value * upstream).sum(), tensors)
            results.append((value, *gradients))
        tolerance = {"atol": 2e-4, "rtol": 1e-4} if single else {}
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


def test_spherical_harmonics_are_orthonormal_and_of_their_degree():
    # Gauss-Legendre in height times equal angles integrates all products exactly.
    nodes, mass = np.polynomial.legendre.leggauss(8)
    angles = 2 * math.pi * np.arange(16) / 16
    flat = np.sqrt(1 - nodes**2)
    directions = np.stack(
        [
            np.outer(flat, np.cos(angles)),
            np.outer(flat, np.sin(angles)),
            np.outer(nodes, 1 + 0 * angles),
        ],
        axis=-1,
    ).reshape(-1, 3)
    values = spherical_harmonics(torch.from_numpy(directions)).numpy()
    area = np.repeat(mass, 16) * 2 * math.pi / 16
    np.testing.assert_allclose(values.T @ (area[:, None] * values), np.eye(16), atol=1e-12)
    behind = spherical_harmonics(torch.from_numpy(-directions)).numpy()
    degree = np.array([0] + [1] * 3 + [2] * 5 + [3] * 7)
    np.testing.assert_allclose(behind, (-1.0) ** degree * values, atol=1e-12)
    # The pole has the zonal ones alone.
    pole = spherical_harmonics(torch.tensor([[0.0, 0.0, 1.0]]))[0]
    assert pole.nonzero()[:, 0].tolist() == [0, 2, 6, 12]
    assert (pole[[0, 2, 6, 12]] > 0).all()


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
