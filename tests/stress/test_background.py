"""The contraction of space, and what is seen in it, at their extremes."""

import numpy as np
import pytest
import torch

from tests.stress.references import worst
from xplanes.fields.background import RADIUS, Background, contract, contract_cube, expand
from xplanes.rendering.behind import behind
from xplanes.streams import Stream, initial_values

pytestmark = pytest.mark.stress

LENGTHS = (0.0, 1e-30, 1e-10, 0.5, 1 - 1e-7, 1.0, 1 + 1e-6, 2.0, 1e3, 1e10, 1e19, 1e25, 1e30)


def towards():
    """Unit vectors along the axes, the diagonals, near the axes, and drawn. float64 [D, 3]"""
    generator = np.random.default_rng(0)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    near = axes + 1e-8 * generator.standard_normal(axes.shape)
    found = np.concatenate([axes, near, np.ones((1, 3)), generator.standard_normal((40, 3))])
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_contraction_to_a_cube(tally, kind) -> None:
    """Contraction to a cube: points 0 to 1e30 away, on and near the axes, against float64"""
    for length in LENGTHS:
        points = torch.from_numpy(length * towards()).to(kind)
        exact = points.double().numpy()
        far = np.abs(exact).max(axis=1, keepdims=True).clip(1)
        found = contract_cube(points)
        tally.finite(found)
        tally.error(worst(found, (2 - 1 / far) * exact / far), 1e-6)
        assert (found.double().abs() <= RADIUS * (1 + 1e-6)).all()


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_contraction(tally, kind) -> None:
    """Contraction of space: points 0 to 1e30 away, on and near the axes, against float64"""
    for length in LENGTHS:
        points = torch.from_numpy(length * towards()).to(kind)
        exact = points.double().numpy()
        far = np.sqrt((exact**2).sum(axis=1, keepdims=True))
        shrunk = (2 - 1 / np.maximum(far, 1e-300)) * exact / np.maximum(far, 1e-300)
        expected = np.where(far > 1, shrunk, exact)
        found = contract(points)
        tally.finite(found)
        tally.error(worst(found, expected), 1e-6)
        assert (found.double().norm(dim=1) <= RADIUS * (1 + 1e-6)).all()


def test_expansion(tally) -> None:
    """Contraction undone: points 0 to 1e6 away, and at infinity, in float64"""
    for length in (each for each in LENGTHS if each <= 1e6):
        points = torch.from_numpy(length * towards())
        back = expand(contract(points))
        tally.finite(back)
        tally.error(worst(back, points), 1e-6)
    tally.finite(expand(torch.from_numpy(RADIUS * towards()).float()), expand(torch.zeros(1, 3)))


def test_a_nan_stays_where_it_is(tally) -> None:
    """Contraction: a point that is NaN stays so, and spoils no other"""
    points = torch.tensor([[1.0, 2.0, 3.0], [float("nan"), 0.0, 1.0], [0.1, 0.0, 0.0]])
    for function in (contract, contract_cube, expand):
        found = function(points)
        assert found[1].isnan().any()
        tally.finite(found[[0, 2]])


@pytest.mark.parametrize("samples", [0, 1, 24, 1024])
def test_degenerate_rays(tally, samples) -> None:
    """Background: rays of no direction, from 1e-30 to 1e18 away, values and gradients"""
    with initial_values(0, Stream.BACKGROUND):
        background = Background(4, 8, width=8, samples=samples)
    field = type("Field", (), {"background": background})()
    for length in (0.0, 1e-30, 1.0, 1e6, 1e18):
        ways = torch.from_numpy(towards()).float()
        origins = (length * ways).flip(0)
        for directions in (ways, -ways, torch.zeros_like(ways)):
            opacity = torch.linspace(0, 1, len(ways))
            colour = behind(field, origins, directions, opacity, torch.ones(3))
            background.zero_grad()
            colour.sum().backward()
            tally.finite(colour, *(p.grad for p in background.parameters()))
            assert (colour >= -0.01).all()
            assert (colour <= 1.01).all()
