"""Smoothness gradients written straight into ``.grad`` equal autograd's."""

import itertools

import pytest
import torch

from tests import oracles
from xplanes.fields.regularisers import (
    add_distance_gradient,
    add_time_smoothness_gradient,
    add_total_variation_gradient,
    time_smoothness,
    total_variation,
)

SHAPES = [(3, 5, 5, 2), (6, 4, 7, 3), (1, 2, 2, 1), (2, 1, 4, 2), (2, 4, 1, 2), (1, 1, 1, 1)]
MORE_ROWS = [*SHAPES, (2, 3, 4, 2), (2, 2, 4, 2), (1, 9, 2, 1)]
DIMS = [(1,), (2,), (1, 2), (2, 1), ()]


def planes_of(shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def check_gradient(shape, add, value):
    """What ``add`` adds to a gradient is what autograd finds for ``value``."""
    planes = planes_of(shape).requires_grad_()
    before = planes_of(shape, seed=1)
    gradient = before.clone()
    add(gradient, planes)
    (value(planes) + 0 * planes.sum()).backward()
    torch.testing.assert_close(
        gradient - before, planes.grad, atol=1e-13, rtol=0, msg=lambda text: f"{shape}: {text}"
    )


def test_values_are_the_oracle_s():
    for shape, dims in itertools.product(SHAPES, DIMS):
        planes = planes_of(shape)
        expected = oracles.total_variation(planes.numpy(), dims)
        found = float(total_variation(planes, dims))
        assert found == pytest.approx(expected, rel=1e-12, abs=1e-15), (shape, dims)
    for shape in MORE_ROWS:
        planes = planes_of(shape)
        expected = oracles.time_smoothness(planes.numpy())
        found = float(time_smoothness(planes))
        assert found == pytest.approx(expected, rel=1e-12, abs=1e-15), shape


@pytest.mark.parametrize("dims", DIMS)
def test_total_variation_gradient_is_autograd_s(dims):
    for shape in SHAPES:
        check_gradient(
            shape,
            lambda gradient, planes: add_total_variation_gradient(gradient, planes, dims, 0.7),
            lambda planes: 0.7 * total_variation(planes, dims),
        )


def test_time_smoothness_gradient_is_autograd_s():
    for shape in MORE_ROWS:
        check_gradient(
            shape,
            lambda gradient, planes: add_time_smoothness_gradient(gradient, planes, 0.3),
            lambda planes: 0.3 * time_smoothness(planes),
        )


def test_distance_gradient_is_autograd_s():
    for shape in SHAPES:
        initial = planes_of(shape, seed=2)
        check_gradient(
            shape,
            lambda gradient, planes, initial=initial: add_distance_gradient(
                gradient, planes, initial, 0.6
            ),
            lambda planes, initial=initial: 0.6 * (planes - initial).square().mean(),
        )
