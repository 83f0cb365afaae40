"""L_r: the full sum, and a gradient in closed form that is unbiased from random frames."""

import itertools

import pytest
import torch
from torch.nn.functional import grid_sample
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from tests.preparation.sequences import blob
from xplanes.decomposition import sparse_product_loss
from xplanes.decomposition.sparse_loss import SparseProduct
from xplanes.fields.xplanes import PLANE_SETS
from xplanes.streams import step_generator

FRAMES, CHANNELS, HEIGHT, WIDTH = 5, 2, 6, 6


def example(plane_set, resolution=9, rows=7, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    planes = draw(3 if plane_set == "six" else 6, rows, resolution, CHANNELS)
    return planes, draw(FRAMES, 3, CHANNELS, HEIGHT, WIDTH)


def full_sum(planes, sparse, plane_set):
    """Entry by entry: every cell of every frame looked up with grid_sample on its own."""
    rows, total = planes.shape[1], 0.0
    for frame, index in itertools.product(range(FRAMES), range(3)):
        first, second = PLANE_SETS[plane_set][index]

        def value(plane, cell, size, frame=frame):
            along = (cell + 0.5) / size * 2 - 1
            time = (frame / (FRAMES - 1) * (rows - 1) + 0.5) / rows * 2 - 1
            grid = torch.tensor([[[[along, time]]]], dtype=torch.float64)
            image = planes[plane].permute(2, 0, 1)[None]
            return grid_sample(image, grid, align_corners=False)[0, :, 0, 0]

        for row, column in itertools.product(range(HEIGHT), range(WIDTH)):
            product = value(first, column, WIDTH) * value(second, row, HEIGHT)
            total += (sparse[frame, index, :, row, column] - product).square().sum()
    return total / sparse.numel()


@pytest.mark.parametrize("plane_set", ["six", "nine"])
@pytest.mark.parametrize(("resolution", "rows"), [(6, 5), (9, 7), (4, 3)])
def test_all_frames_give_the_full_sum(plane_set, resolution, rows):
    planes, sparse = example(plane_set, resolution, rows)
    value = sparse_product_loss(planes, sparse, torch.arange(FRAMES), rows=PLANE_SETS[plane_set])
    assert value == pytest.approx(full_sum(planes, sparse, plane_set).item(), rel=1e-10)


@pytest.mark.parametrize(("plane_set", "reduction"), [("six", "mean"), ("nine", "sum")])
def test_the_mean_over_steps_is_the_gradient_over_all_frames(plane_set, reduction):
    planes, _ = example(plane_set, rows=4, resolution=6)
    rows, sparse = PLANE_SETS[plane_set], blob(FRAMES, CHANNELS, WIDTH).double()
    product = SparseProduct(sparse, rows, 2, reduction=reduction)
    total, steps = torch.zeros_like(planes), 1000
    for step in range(steps):
        product.add_gradient(total, planes, 0.5, step_generator(0, step, 7))
    _, gradient = gradient_of_the_twin(planes, sparse, rows)
    expected = 0.5 * gradient * (sparse.numel() if reduction == "sum" else 1)
    assert (total / steps - expected).norm() < 0.05 * expected.norm()
    with pytest.raises(ValueError, match="reduction is 'total': allowed are mean, sum"):
        SparseProduct(sparse, rows, 2, reduction="total")


def gradient_of_the_twin(planes, sparse, rows):
    """The value and the gradient of the loss over all frames."""
    leaf = planes.clone().requires_grad_()
    loss = sparse_product_loss(leaf, sparse, torch.arange(len(sparse)), rows=rows)
    loss.backward()
    return float(loss.detach()), leaf.grad


@pytest.mark.parametrize("plane_set", ["six", "nine"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_the_closed_form_is_the_gradient_and_the_value_of_the_twin(plane_set, dtype):
    rows, planes = PLANE_SETS[plane_set], example(plane_set, rows=4, resolution=7)[0].to(dtype)
    generator = torch.Generator().manual_seed(1)
    sparse = torch.randn(FRAMES, 3, CHANNELS, 6, 8, generator=generator, dtype=dtype)
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


def test_one_frame_and_half_precision_targets():
    planes, sparse = example("six", rows=1)
    value = sparse_product_loss(
        planes.float(), sparse[:1].half(), torch.tensor([0]), rows=PLANE_SETS["six"]
    )
    assert value.dtype == torch.float32
    assert torch.isfinite(value)


def test_the_sparse_part_follows_the_planes_and_nothing_waits_for_a_value():
    """On the device "meta" tensors have no values: asking for one raises."""
    planes, sparse = example("six")
    term = SparseProduct(sparse, PLANE_SETS["six"], 2)
    term.value(planes.float())
    assert term.sparse.dtype == torch.float32
    planes = planes.to("meta")
    term.add_gradient(torch.empty_like(planes), planes, 1.0, torch.Generator())
    assert term.sparse.device.type == "meta"
