"""Triton kernels of the plane lookup: on a GPU if there is one, else in triton's interpreter."""

import pytest
import torch

from tests.fields.test_lookup import scattered, stacks
from xplanes.fields.lookup import plane_features_gpu, plane_features_reference
from xplanes.fields.xplanes import PLANE_SETS

triton = pytest.importorskip("triton", reason="triton is not installed")
tl = triton.language

from xplanes.fields import lookup_triton as gpu  # noqa: E402 (needs triton)

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
BAD = [torch.inf, -torch.inf, torch.nan, 3e38, -3e38]


def both(plane_set, space, time, points, times, exact=torch.float64):
    """Values and gradients of the kernels, and of the twin in ``exact`` from the same numbers."""
    results = []
    for function, precision in (
        (plane_features_gpu, space.dtype),
        (plane_features_reference, exact),
    ):
        leaves = [
            plane.to(DEVICE, precision, copy=True).requires_grad_()
            for plane in (space, time)
            if plane is not None
        ]
        places = points.to(DEVICE), times.to(DEVICE)
        moving = leaves[1] if time is not None else None
        value = function(leaves[0], moving, *places, PLANE_SETS[plane_set])
        upstream = torch.linspace(-1, 1, value.numel(), device=DEVICE).to(precision).view_as(value)
        gradients = torch.autograd.grad((value * upstream).sum(), leaves)
        results.append([found.cpu() for found in (value.detach(), *gradients)])
    return results


def compare(found, tolerance, case):
    ours, theirs = found
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        assert b.numel() == 0 or b.abs().max() > 0.1, case
        torch.testing.assert_close(
            a, b, atol=tolerance, rtol=tolerance, check_dtype=False, msg=lambda m: f"{case}: {m}"
        )


def places(dtype):
    """Points inside, on borders and texels' edges, far outside; times before, at and after ends."""
    points, times = scattered(13, dtype)
    corners = [1.0, -1.0, 0.8, -0.8, 1.2, -1.2, 5.0, 1e30]
    for number, corner in enumerate(corners):
        points[number, number % 3] = corner
    times[:4] = torch.tensor([0.0, 1.0, -0.5, 1.5])
    return points, times


def test_values_and_gradients_are_the_twins():
    for plane_set, channels in [
        *(("six", c) for c in (1, 3, 8, 40)),
        ("nine", 3),
        ("nine", 40),
        ("three", 8),
    ]:
        case = f"plane_set={plane_set}, channels={channels}"
        space, time = stacks(plane_set, torch.float32, channels=channels)
        compare(both(plane_set, space, time, *places(torch.float32)), 2e-5, case)
    # More channels than a program takes.
    space, time = stacks("three", torch.float32, size=3, channels=131)
    found = both("three", space, time, *scattered(2, torch.float32, reach=0.9))
    compare(found, 2e-5, "131 channels")


def test_any_number_of_points():
    for count in [0, 1, 16, 17]:
        # 32 channels make blocks of 16 points.
        space, time = stacks("six", torch.float32, channels=32)
        ours, theirs = both("six", space, time, *scattered(count, torch.float32, reach=0.9))
        assert ours[0].shape == (count, 3, 32), count
        for a, b in zip(ours, theirs, strict=True):
            torch.testing.assert_close(
                a, b, atol=2e-5, rtol=2e-5, check_dtype=False, msg=lambda m, c=count: f"{c}: {m}"
            )


def test_half_precision_planes_are_added_up_in_float32():
    for dtype in [torch.bfloat16, torch.float16]:
        space, time = stacks("six", dtype, channels=4)
        points, times = scattered(40, torch.float32, reach=0.9)
        ours, theirs = both("six", space, time, points, times)
        for a, b in zip(ours, theirs, strict=True):
            assert a.dtype == dtype, dtype
            # What is left is the rounding of the results themselves.
            error = (a.double() - b).abs() / b.abs().clamp_min(1)
            assert error.max() < torch.finfo(dtype).eps, dtype


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")  # The interpreter's, on purpose.
def test_infinite_points_are_outside_and_nan_stays_nan():
    space, time = stacks("six", torch.float32)
    points = torch.zeros(6, 3)
    points[:5, 0] = torch.tensor(BAD)
    times = torch.full((6,), 0.4)
    times[5] = torch.nan
    value = both("six", space, time, points, times)[0][0]
    untouched = [0, 1, 3, 4]
    assert (value[untouched, :2] == 0).all()  # xy and xz see x; yz does not
    assert value[untouched, 2].isfinite().all()
    assert value[2, :2].isnan().all()
    assert value[2, 2].isfinite().all()
    assert value[5].isnan().all()


def test_strides_and_precisions_of_points_are_taken_as_they_come():
    space, time = stacks("six", torch.float32)
    points, times = scattered(20, torch.float64)
    turned = space.permute(3, 0, 1, 2).contiguous().permute(1, 2, 3, 0)
    plain = both("six", space, time, points, times)[0]
    strided = both("six", turned, time, points.T.contiguous().T, times.repeat_interleave(2)[::2])[0]
    assert torch.equal(plain[0], strided[0])
    assert plain[0].dtype == torch.float32
    torch.testing.assert_close(plain[1:], strided[1:])


def test_only_the_planes_that_ask_get_gradients():
    space, time = (plane.to(DEVICE) for plane in stacks("six", torch.float32))
    places = [where.to(DEVICE) for where in scattered(9, torch.float32)]
    for leaf in (space, time):
        leaf.requires_grad_()
        plane_features_gpu(space, time, *places, PLANE_SETS["six"]).sum().backward()
        assert leaf.grad is not None
        assert leaf.grad.abs().max() > 0
        assert (space.grad is None) == (leaf is not space)
        assert (time.grad is None) == (leaf is not time)
        leaf.requires_grad_(False).grad = None


@triton.jit
def offsets(texels, found, CHANNELS: tl.constexpr):
    four = tl.arange(0, 4)
    texel = tl.load(texels + four)
    offset, mask = gpu.reach(texel, texel * 1.0, four, CHANNELS)
    tl.store(found + four[:, None] * 4 + four[None, :], offset, mask=mask)


def test_offsets_beyond_32_bits():
    texels = torch.tensor([0, 1, 2**27, 2**30], dtype=torch.int32, device=DEVICE)
    found = torch.full((4, 4), -1, device=DEVICE)
    offsets[(1,)](texels, found, CHANNELS=32)
    expected = texels.long()[:, None] * 32 + torch.arange(4, device=DEVICE)
    expected[0] = -1  # A weight of zero reads nothing.
    assert torch.equal(found, expected)
