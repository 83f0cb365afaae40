"""L_r in training: an unbiased gradient from random frames, equal on all ranks."""

import pytest
import torch

from tests.preparation.sequences import blob
from xplanes.decomposition import sparse_product_loss
from xplanes.decomposition.sparse_loss import SparseProduct
from xplanes.fields.xplanes import PLANE_SETS
from xplanes.streams import step_generator

FRAMES = 5


def case(plane_set="six", count=2):
    generator = torch.Generator().manual_seed(0)
    planes = torch.randn(3 if plane_set == "six" else 6, 4, 6, 2, generator=generator)
    sparse = blob(FRAMES, 2, 6)
    return SparseProduct(sparse, PLANE_SETS[plane_set], count), planes, sparse


@pytest.mark.parametrize("plane_set", ["six", "nine"])
def test_the_mean_over_steps_is_the_gradient_over_all_frames(plane_set):
    product, planes, sparse = case(plane_set)
    leaf = planes.clone().requires_grad_()
    rows = PLANE_SETS[plane_set]
    sparse_product_loss(leaf, sparse, torch.arange(FRAMES), rows=rows).backward()
    total = torch.zeros_like(planes)
    steps = 2000
    for step in range(steps):
        product.add_gradient(total, planes, 0.5, step_generator(0, step, 7))
    assert (total / steps - 0.5 * leaf.grad).norm() < 0.05 * leaf.grad.norm()


def test_it_adds_to_what_is_there_and_leaves_the_planes_alone():
    product, planes, _ = case()
    parameter = torch.nn.Parameter(planes.clone())
    first = torch.zeros_like(planes)
    product.add_gradient(first, parameter, 1.0, step_generator(0, 3, 7))
    second = torch.ones_like(planes)
    product.add_gradient(second, parameter, 1.0, step_generator(0, 3, 7))
    torch.testing.assert_close(second - 1, first, atol=1e-6, rtol=0)
    assert parameter.grad is None
    assert torch.equal(parameter, planes)


def test_it_works_where_gradients_are_switched_off():
    product, planes, _ = case()
    gradient = torch.zeros_like(planes)
    with torch.no_grad():
        product.add_gradient(gradient, planes, 1.0, step_generator(0, 0, 7))
    assert gradient.abs().max() > 0


def test_the_value_is_the_same_at_each_call_and_exact_over_all_frames():
    product, planes, sparse = case(count=FRAMES)
    whole = sparse_product_loss(planes, sparse, torch.arange(FRAMES), rows=PLANE_SETS["six"])
    assert product.value(planes) == product.value(planes) == pytest.approx(float(whole))
