import functools
import itertools

import pytest
import torch
from torch.nn.functional import grid_sample

from xplanes.decomposition import sparse_product_loss
from xplanes.decomposition.sparse_loss import SparseProduct
from xplanes.fields.xplanes import PLANE_SETS

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


def test_the_mean_over_all_draws_is_the_full_loss():
    planes, sparse = example("nine")
    rows = PLANE_SETS["nine"]
    full = sparse_product_loss(planes, sparse, torch.arange(FRAMES), rows=rows)
    for draws in [1, 2]:
        values = [
            sparse_product_loss(planes, sparse, torch.tensor(frames), rows=rows)
            for frames in itertools.product(range(FRAMES), repeat=draws)
        ]
        assert torch.stack(values).mean() == pytest.approx(full.item(), rel=1e-12), draws


@pytest.mark.parametrize("plane_set", ["six", "nine"])
def test_gradients(plane_set):
    planes, sparse = example(plane_set, resolution=4, rows=3)
    options = {"frames": torch.tensor([0, 3, 3]), "rows": PLANE_SETS[plane_set]}
    loss = functools.partial(sparse_product_loss, sparse=sparse, **options)
    assert torch.autograd.gradcheck(loss, planes.requires_grad_())


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
    term, planes = SparseProduct(sparse, PLANE_SETS["six"], 2), planes.to("meta")
    term.add_gradient(torch.empty_like(planes), planes, 1.0, torch.Generator())
    assert term.sparse.device.type == "meta"
