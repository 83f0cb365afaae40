"""Triton kernels of the plane lookup: on a GPU if there is one, else in triton's interpreter."""

import pytest
import torch

from tests.fields.test_lookup import DEVICE, kernels, outcome, scattered, stacks
from xplanes.fields.lookup import plane_features_reference

triton = pytest.importorskip("triton", reason="triton is not installed")
tl = triton.language

from xplanes.fields import lookup_triton as gpu  # noqa: E402 (needs triton)


def both(plane_set, planes, places):
    """What the kernels come to, and the twin in double precision from the same numbers."""
    exact = [None if plane is None else plane.double() for plane in planes]
    return (
        outcome(kernels, plane_set, *planes, *places),
        outcome(plane_features_reference, plane_set, *exact, *places),
    )


def edges():
    """Points inside, on borders and texels' edges, far outside; times before, at and after ends."""
    points, times = scattered(13, torch.float32)
    corners = [1.0, -1.0, 0.8, -0.8, 1.2, -1.2, 5.0, 1e30]
    for number, corner in enumerate(corners):
        points[number, number % 3] = corner
    times[:4] = torch.tensor([0.0, 1.0, -0.5, 1.5])
    return points, times


@pytest.mark.parametrize(
    ("plane_set", "channels", "count"),
    [
        *(("six", channels, "edges") for channels in (1, 3, 40)),
        *(("nine", channels, "edges") for channels in (3, 40)),
        ("three", 8, "edges"),
        ("three", 131, 2),  # More channels than a program takes.
        *(("six", 32, count) for count in (0, 1, 16, 17)),  # These make blocks of 16 points.
    ],
)
def test_values_and_gradients_are_the_twins(plane_set, channels, count):
    planes = stacks(plane_set, torch.float32, channels=channels)
    places = edges() if count == "edges" else scattered(count, torch.float32, reach=0.9)
    ours, theirs = both(plane_set, planes, places)
    assert ours[0].shape == (len(places[1]), 3, channels)
    torch.testing.assert_close(ours, theirs, atol=2e-5, rtol=2e-5, check_dtype=False)
    assert count in (0, 1) or all(found.abs().max() > 0.1 for found in theirs)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_planes_are_added_up_in_float32(dtype):
    planes, places = stacks("six", dtype, channels=4), scattered(40, torch.float32, reach=0.9)
    for a, b in zip(*both("six", planes, places), strict=True):
        assert a.dtype == dtype
        # What is left is the rounding of the results themselves.
        error = (a.double() - b).abs() / b.abs().clamp_min(1)
        assert error.max() < torch.finfo(dtype).eps


def test_strides_and_precisions_of_points_are_taken_as_they_come():
    space, time = stacks("six", torch.float32)
    points, times = scattered(20, torch.float64)
    turned = space.permute(3, 0, 1, 2).contiguous().permute(1, 2, 3, 0)
    sparse = points.T.contiguous().T, times.repeat_interleave(2)[::2]
    plain = outcome(kernels, "six", space, time, points, times)
    strided = outcome(kernels, "six", turned, time, *sparse)
    assert torch.equal(plain[0], strided[0])
    assert plain[0].dtype == torch.float32
    torch.testing.assert_close(plain[1:], strided[1:])


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
