"""Triton kernels for products of planes: on a GPU if there is one, else in the interpreter."""

import pytest
import torch

from xplanes.baselines.products import DYNAMIC, STATIC, plane_product_gpu, plane_product_reference

pytest.importorskip("triton", reason="triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def both(names, dtype, *, channels, count, sizes=(3, 4, 5), reach=1.3):
    """Values and gradients of the kernels, and of the twin in float64 from the same numbers."""
    generator = torch.Generator().manual_seed(4)
    steps, *rest = sizes
    stacks = [
        1.3 - torch.rand(1, channels, steps if "t" in n else rest[0], rest[1], generator=generator)
        for n in names
    ]
    places = (2 * torch.rand(count, 4, generator=generator) - 1) * reach
    places[:4, 0] = torch.tensor([1.0, -1.0, 1e30, -1e30])[:count]
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
    return results


@pytest.mark.slow
def test_values_and_gradients_are_the_twins():
    for names, channels, count in [
        (DYNAMIC, 1, 9),
        (DYNAMIC, 8, 70),
        (DYNAMIC, 40, 13),
        (STATIC, 3, 129),
        (STATIC, 32, 16),
    ]:
        case = f"{len(names)} planes, channels={channels}, count={count}"
        ours, theirs = both(names, torch.float32, channels=channels, count=count)
        assert len(ours) == len(names) + 1, case
        for a, b in zip(ours, theirs, strict=True):
            assert a.dtype == torch.float32, case
            assert b.abs().max() > 0.1, case
            torch.testing.assert_close(
                a, b, atol=5e-5, rtol=5e-5, check_dtype=False, msg=lambda m, c=case: f"{c}: {m}"
            )


def test_in_float64_nothing_but_rounding_is_left():
    for sizes in [(3, 4, 5), (1, 1, 1)]:
        ours, theirs = both(DYNAMIC, torch.float64, channels=2, count=7, sizes=sizes)
        for a, b in zip(ours, theirs, strict=True):
            torch.testing.assert_close(
                a, b, atol=1e-12, rtol=1e-12, msg=lambda m, c=sizes: f"{c}: {m}"
            )


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
