"""Plane lookup and its gradients with planes of every size, against float64."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.stress.references import worst
from xplanes.fields.lookup import plane_features, plane_features_reference
from xplanes.fields.products import plane_product, plane_product_reference
from xplanes.fields.xplanes import PLANE_SETS, SPACE_PLANES, TIME_PLANES

pytestmark = pytest.mark.stress

VALUES = (0.0, 1e-30, 1e-15, 1.0, 1e4, 1e15, "mixed")
"""Two time planes are multiplied, so that 1e15 is near the largest float32 can take."""

ROWS = (1, 2, 300)
TOLERANCE = {torch.float32: 5e-5, torch.float64: 1e-11}
"""A time among 300 rows is known to 300 times the type's precision."""


def spread(shape, value, generator):
    """Random planes of a size; "mixed" holds zeros and 1e-30 to 1e15 of both signs at once."""
    planes = torch.randn(shape, generator=generator, dtype=torch.float64)
    if value == "mixed":
        exponents = torch.randint(-30, 16, shape, generator=generator).double()
        return planes.sign() * 10.0**exponents * (planes.abs() > 0.1)
    return planes * value


def case(plane_set, value, rows, dtype, seed=0, count=12):
    generator = torch.Generator().manual_seed(seed)
    space = spread((3, 4, 4, 2), value, generator).to(dtype)
    names = TIME_PLANES[plane_set]
    time = spread((len(names), rows, 4, 2), value, generator).to(dtype) if names else None
    points = (2.6 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1.3).to(dtype)
    times = torch.rand(count, generator=generator, dtype=torch.float64).to(dtype)
    times[:2] = torch.tensor([0.0, 1.0])
    return space, time, points, times


def values_and_gradients(function, space, time, points, times, rows):
    leaves = [plane.clone().requires_grad_() for plane in (space, time) if plane is not None]
    moving = None if time is None else leaves[1]
    value = function(leaves[0], moving, points, times, rows)
    upstream = torch.linspace(-1, 1, value.numel(), dtype=value.dtype).view_as(value)
    return value.detach(), *torch.autograd.grad((value * upstream).sum(), leaves)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("plane_set", PLANE_SETS)
def test_lookup(tally, plane_set, dtype) -> None:
    """Lookup: planes of 0 to 1e15 and mixed, 1 to 300 rows of time, two types"""
    for value in VALUES:
        for rows in ROWS if plane_set != "three" else (1,):
            inputs = case(plane_set, value, rows, dtype)
            found = values_and_gradients(plane_features, *inputs, PLANE_SETS[plane_set])
            exact = [None if t is None else t.double() for t in inputs]
            expected = values_and_gradients(plane_features_reference, *exact, PLANE_SETS[plane_set])
            tally.finite(*found)
            for ours, theirs in zip(found, expected, strict=True):
                tally.error(worst(ours, theirs, 1e-37), TOLERANCE[dtype])
            planes = dict(zip(SPACE_PLANES, exact[0], strict=True))
            planes |= dict(
                zip(TIME_PLANES[plane_set], () if exact[1] is None else exact[1], strict=True)
            )
            planes = {name: plane.permute(2, 0, 1).numpy() for name, plane in planes.items()}
            truth = oracles.plane_features(planes, plane_set, *exact[2:])
            tally.error(worst(found[0], truth, 1e-37), TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("value", [0.0, 1e-5, 1.0, 1e5])
def test_products(tally, value, dtype) -> None:
    """Products: six planes of 0 to 1e5, 1 to 300 rows of time, two types"""
    names = ("xy", "xz", "xt", "yz", "yt", "zt")
    for rows in ROWS:
        generator = torch.Generator().manual_seed(rows)
        exact = [
            spread((1, 2, rows if "t" in name else 4, 4), value, generator).to(dtype).double()
            for name in names
        ]
        places = 3 * torch.rand(20, 4, generator=generator) - 1.5
        results = []
        for function, planes in (
            (plane_product, [plane.to(dtype) for plane in exact]),
            (plane_product_reference, exact),
        ):
            leaves = [plane.clone().requires_grad_() for plane in planes]
            product = function(leaves, places.to(leaves[0].dtype), names)
            results.append((product.detach(), *torch.autograd.grad(product.sum(), leaves)))
        tally.finite(*results[0])
        for ours, theirs in zip(*results, strict=True):
            tally.error(worst(ours, theirs, 1e-30), 1e-4 if dtype == torch.float32 else 1e-11)


def test_drawn_points(tally) -> None:
    """Lookup: drawn points, times and sizes of planes, far outside the cube too"""
    numbers = st.floats(-1e30, 1e30)

    @settings(max_examples=300, deadline=None, derandomize=True, database=None)
    @given(
        st.lists(st.tuples(numbers, numbers, numbers, numbers), min_size=1, max_size=6),
        st.floats(-30, 15),
        st.integers(1, 300),
    )
    def case_of(places, exponent, rows):
        space, time, *_ = case("nine", 10**exponent, rows, torch.float32)
        place = torch.tensor(places, dtype=torch.float32)
        found = values_and_gradients(
            plane_features, space, time, place[:, :3], place[:, 3], PLANE_SETS["nine"]
        )
        tally.finite(*found)
        # A point beyond the planes' last half texel sees none of them.
        outside = (place[:, :3].abs() > 1.3).all(dim=1)
        np.testing.assert_array_equal(found[0][outside], 0)

    case_of()
