"""Triton kernels for products of planes: on a GPU if there is one, else in the interpreter."""

import pytest
import torch

from xplanes.baselines.products import DYNAMIC, STATIC, plane_product_gpu, plane_product_reference

pytest.importorskip("triton", reason="triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize(
    ("names", "dtype", "channels", "count", "sizes"),
    [
        (DYNAMIC, torch.float32, 1, 9, (3, 4, 5)),
        (DYNAMIC, torch.float32, 8, 70, (3, 4, 5)),
        (DYNAMIC, torch.float32, 40, 13, (3, 4, 5)),
        (STATIC, torch.float32, 3, 129, (3, 4, 5)),
        (STATIC, torch.float32, 32, 16, (3, 4, 5)),
        (DYNAMIC, torch.float64, 2, 7, (3, 4, 5)),
        (DYNAMIC, torch.float64, 2, 7, (1, 1, 1)),
    ],
)
def test_values_and_gradients_are_the_twins(names, dtype, channels, count, sizes):
    """The twin works in float64, from the same numbers."""
    generator = torch.Generator().manual_seed(4)
    steps, *rest = sizes
    stacks = [
        1.3 - torch.rand(1, channels, steps if "t" in n else rest[0], rest[1], generator=generator)
        for n in names
    ]
    places = (2 * torch.rand(count, 4, generator=generator) - 1) * 1.3
    places[:4, 0] = torch.tensor([1.0, -1.0, 1e30, -1e30])
    results = []
    for function, precision in (
        (plane_product_gpu, dtype),
        (plane_product_reference, torch.float64),
    ):
        planes = [p.to(DEVICE, dtype).to(precision).requires_grad_() for p in stacks]
        value = function(planes, places.to(DEVICE), names)
        upstream = torch.linspace(-1, 1, value.numel(), device=DEVICE).to(precision).view_as(value)
        gradients = torch.autograd.grad((value * upstream).sum(), planes)
        results.append([found.detach().cpu() for found in (value, *gradients)])
    most = 5e-5 if dtype == torch.float32 else 1e-12  # In float64 but for rounding.
    for ours, theirs in zip(*results, strict=True):
        assert ours.dtype == dtype
        assert theirs.abs().max() > 0.1 or sizes == (1, 1, 1)
        torch.testing.assert_close(ours, theirs, atol=most, rtol=most, check_dtype=False)


def test_points_that_fill_up_a_block_spread_no_nan():
    planes = [torch.full((1, 4, 3, 3), torch.nan, device=DEVICE) for _ in STATIC]
    for plane in planes:
        plane[..., 0, 0] = 1.0
        plane.requires_grad_()
    value = plane_product_gpu(planes, torch.full((1, 4), -1.0, device=DEVICE), STATIC)
    value.sum().backward()
    assert (value == 1).all()
    for plane in planes:
        assert plane.grad is not None
        assert plane.grad[..., 0, 0].eq(1).all()
        assert plane.grad.sum() == 4
