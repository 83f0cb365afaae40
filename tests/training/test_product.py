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


def time_planes(plane_set, *shape, seed=0, **options):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(3 if plane_set == "six" else 6, *shape, generator=generator, **options)


def gradient_of_the_twin(planes, sparse, rows):
    """The value and the gradient of the loss over all frames."""
    leaf = planes.clone().requires_grad_()
    loss = sparse_product_loss(leaf, sparse, torch.arange(len(sparse)), rows=rows)
    loss.backward()
    return float(loss.detach()), leaf.grad


@pytest.mark.parametrize(("plane_set", "reduction"), [("six", "mean"), ("nine", "sum")])
def test_the_mean_over_steps_is_the_gradient_over_all_frames(plane_set, reduction):
    rows, planes, sparse = (
        PLANE_SETS[plane_set],
        time_planes(plane_set, 4, 6, 2),
        blob(FRAMES, 2, 6),
    )
    product = SparseProduct(sparse, rows, 2, reduction=reduction)
    total, steps = torch.zeros_like(planes), 2000
    for step in range(steps):
        product.add_gradient(total, planes, 0.5, step_generator(0, step, 7))
    _, gradient = gradient_of_the_twin(planes, sparse, rows)
    expected = 0.5 * gradient * (sparse.numel() if reduction == "sum" else 1)
    assert (total / steps - expected).norm() < 0.05 * expected.norm()
    with pytest.raises(ValueError, match="reduction is 'total': allowed are mean, sum"):
        SparseProduct(sparse, rows, 2, reduction="total")


@pytest.mark.parametrize("plane_set", ["six", "nine"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_the_closed_form_is_the_gradient_and_the_value_of_the_twin(plane_set, dtype):
    rows, planes = PLANE_SETS[plane_set], time_planes(plane_set, 4, 7, 2, dtype=dtype)
    generator = torch.Generator().manual_seed(1)
    sparse = torch.randn(FRAMES, 3, 2, 6, 8, generator=generator, dtype=dtype)
    value, gradient = gradient_of_the_twin(planes, sparse, rows)
    for reduction, factor in (("mean", 1), ("sum", sparse.numel())):
        product = SparseProduct(sparse, rows, None, reduction=reduction)
        found, expected = torch.zeros_like(planes), factor * gradient
        product.add_gradient(found, planes, 1.0, torch.Generator())
        assert (found - expected).abs().max() < 1e-6 * expected.abs().max()
        assert product.value(planes) == pytest.approx(factor * value, rel=1e-6)


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
    with Sizes() as twin:
        gradient_of_the_twin(planes, sparse, rows)
    assert closed.largest < sparse.numel() / 8
    assert value.largest < sparse.numel() / 8
    assert twin.largest >= sparse.numel() / 3
