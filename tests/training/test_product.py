"""L_r in training: a gradient in closed form, unbiased from random frames, equal on all ranks."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from tests.preparation.sequences import blob
from xplanes.decomposition import sparse_product_loss
from xplanes.decomposition.sparse_loss import SparseProduct
from xplanes.fields.xplanes import PLANE_SETS
from xplanes.streams import step_generator

FRAMES = 5


def case(plane_set="six", count=2, **options):
    generator = torch.Generator().manual_seed(0)
    planes = torch.randn(3 if plane_set == "six" else 6, 4, 6, 2, generator=generator)
    sparse = blob(FRAMES, 2, 6)
    return SparseProduct(sparse, PLANE_SETS[plane_set], count, **options), planes, sparse


@pytest.mark.parametrize(("plane_set", "reduction"), [("six", "mean"), ("nine", "sum")])
def test_the_mean_over_steps_is_the_gradient_over_all_frames(plane_set, reduction):
    product, planes, sparse = case(plane_set, reduction=reduction)
    leaf = planes.clone().requires_grad_()
    rows = PLANE_SETS[plane_set]
    sparse_product_loss(leaf, sparse, torch.arange(FRAMES), rows=rows).backward()
    total = torch.zeros_like(planes)
    steps = 2000
    for step in range(steps):
        product.add_gradient(total, planes, 0.5, step_generator(0, step, 7))
    expected = 0.5 * leaf.grad * (sparse.numel() if reduction == "sum" else 1)
    assert (total / steps - expected).norm() < 0.05 * expected.norm()
    with pytest.raises(ValueError, match="reduction is 'total': allowed are mean, sum"):
        case(reduction="total")


@pytest.mark.parametrize("plane_set", ["six", "nine"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_closed_form_is_the_gradient_and_the_value_of_the_twin(plane_set, dtype):
    generator = torch.Generator().manual_seed(0)
    rows = PLANE_SETS[plane_set]
    sparse = torch.randn(FRAMES, 3, 2, 6, 8, generator=generator, dtype=torch.float64).to(dtype)
    planes = torch.randn(3 if plane_set == "six" else 6, 4, 7, 2, generator=generator, dtype=dtype)
    leaf = planes.clone().requires_grad_()
    loss = sparse_product_loss(leaf, sparse, torch.arange(FRAMES), rows=rows)
    loss.backward()
    for reduction, factor in (("mean", 1), ("sum", sparse.numel())):
        product = SparseProduct(sparse, rows, None, reduction=reduction)
        found = torch.zeros_like(planes)
        product.add_gradient(found, planes, 1.0, torch.Generator())
        expected = factor * leaf.grad
        assert (found - expected).abs().max() < 1e-6 * expected.abs().max()
        assert product.value(planes) == pytest.approx(factor * float(loss.detach()), rel=1e-6)


class Sizes(TorchDispatchMode):
    """Keeps the size of the largest tensor that an operation makes, views of others left out."""

    def __init__(self):
        super().__init__()
        self.largest = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        known = {t.data_ptr() for t in tree_leaves(args) if isinstance(t, torch.Tensor)}
        for made in tree_leaves(result):
            if isinstance(made, torch.Tensor) and made.data_ptr() not in known:
                self.largest = max(self.largest, made.numel())
        return result


@pytest.mark.parametrize("plane_set", ["six", "nine"])
def test_a_gradient_over_all_frames_makes_nothing_near_the_size_of_the_sparse_part(plane_set):
    rows = PLANE_SETS[plane_set]
    sparse, planes = torch.randn(9, 3, 2, 40, 40), torch.randn(6, 9, 40, 2)
    product, gradient = SparseProduct(sparse, rows, None), torch.zeros_like(planes)
    with Sizes() as closed:
        product.add_gradient(gradient, planes, 1.0, torch.Generator())
    with Sizes() as value:
        product.value(planes)
    leaf = planes.clone().requires_grad_()
    with Sizes() as twin:
        sparse_product_loss(leaf, sparse, torch.arange(9), rows=rows).backward()
    assert closed.largest < sparse.numel() / 8
    assert value.largest < sparse.numel() / 8
    assert twin.largest >= sparse.numel() / 3
