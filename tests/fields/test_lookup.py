"""Plane lookup: compiled loops, readable twin and NumPy oracle come to the same numbers."""

import importlib.util

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles import plane_features as oracle
from xplanes.backend import threads
from xplanes.fields import lookup
from xplanes.fields import lookup_numba as cpu
from xplanes.fields.lookup import plane_features, plane_features_gpu, plane_features_reference
from xplanes.fields.xplanes import PLANE_SETS, SPACE_PLANES, TIME_PLANES

TOLERANCE = {torch.float32: 2e-6, torch.float64: 1e-13}
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def kernels(*given):
    """The Triton kernels: on a GPU if there is one, else in triton's interpreter."""
    *tensors, rows = given
    there = (None if tensor is None else tensor.to(DEVICE) for tensor in tensors)
    return plane_features_gpu(*there, rows).cpu()


PLAIN = (plane_features, plane_features_reference)
of_each = pytest.mark.parametrize(
    "function", [*PLAIN, *([kernels] if importlib.util.find_spec("triton") else [])]
)
of_each_set = pytest.mark.parametrize("plane_set", PLANE_SETS)
of_each_float = pytest.mark.parametrize("dtype", TOLERANCE)


def stacks(plane_set, dtype=torch.float64, *, size=5, time_rows=4, time_size=7, channels=3, seed=0):
    """Space planes [3, H, H, C] and time planes [P, T, H', C] of different resolutions."""
    generator = torch.Generator().manual_seed(seed)
    space = torch.randn(3, size, size, channels, generator=generator, dtype=dtype)
    count = len(TIME_PLANES[plane_set])
    time = torch.randn(count, time_rows, time_size, channels, generator=generator, dtype=dtype)
    return space, time if count else None


def named(plane_set, space, time):
    planes = dict(zip(SPACE_PLANES, space, strict=True))
    planes.update(zip(TIME_PLANES[plane_set], [] if time is None else time, strict=True))
    return {name: plane.permute(2, 0, 1).numpy() for name, plane in planes.items()}


def scattered(count, dtype=torch.float64, seed=1, reach=1.4):
    generator = torch.Generator().manual_seed(seed)
    points = (2 * torch.rand(count, 3, generator=generator, dtype=dtype) - 1) * reach
    times = torch.rand(count, generator=generator, dtype=dtype) * 1.4 - 0.2
    return points, times


def outcome(function, plane_set, space, time, points, times):
    """Values and gradients of the planes, with upstream gradients of the planes' precision."""
    leaves = [p.clone().requires_grad_() for p in (space, time) if p is not None]
    moving = leaves[1] if time is not None else None
    value = function(leaves[0], moving, points, times, PLANE_SETS[plane_set])
    upstream = torch.linspace(-1, 1, value.numel()).to(space.dtype).view_as(value)
    gradients = torch.autograd.grad((value * upstream).sum(), leaves)
    return [value.detach(), *gradients]


def both(*given):
    """What the compiled loops and the readable twin come to."""
    return [outcome(function, *given) for function in PLAIN]


@of_each_float
@of_each_set
def test_loops_and_twin_come_to_equation_15_and_to_the_same_gradients(dtype, plane_set):
    space, time = stacks(plane_set, dtype)
    points, times = scattered(40, dtype)
    compiled, reference = both(plane_set, space, time, points, times)
    expected = oracle(named(plane_set, space, time), plane_set, points, times)
    for value in (compiled[0], reference[0]):
        np.testing.assert_allclose(value, expected, atol=4 * TOLERANCE[dtype])
    torch.testing.assert_close(compiled, reference, atol=60 * TOLERANCE[dtype], rtol=1e-5)
    assert {found.dtype for found in (*compiled, *reference)} == {dtype}
    assert all(found.abs().max() > 0.1 for found in reference)


@pytest.mark.parametrize("asks", [(True, True), (True, False), (False, True)])
@of_each_float
def test_further_planes_are_added_to_the_first_channels(dtype, asks, monkeypatch):
    coarse, fine = stacks("three", dtype)[0], stacks("three", dtype, size=9, channels=2, seed=2)[0]
    points, times = scattered(300, dtype)

    def attempt():
        leaves = [
            p.clone().requires_grad_(asked) for p, asked in zip((coarse, fine), asks, strict=True)
        ]
        found = plane_features(leaves[0], None, points, times, (), leaves[1])
        upstream = torch.linspace(-1, 1, found.numel(), dtype=dtype).view_as(found)
        asked = [leaf for leaf in leaves if leaf.requires_grad]
        return [found.detach(), *torch.autograd.grad((found * upstream).sum(), asked)]

    compiled = attempt()
    parts = [plane_features_reference(p, None, points, times, ()) for p in (coarse, fine)]
    parts[0][..., :2] += parts[1]
    torch.testing.assert_close(compiled[0], parts[0], atol=4 * TOLERANCE[dtype], rtol=1e-5)
    monkeypatch.setattr(lookup, "cpu_loops", lambda planes: False)
    reference = attempt()
    torch.testing.assert_close(compiled, reference, atol=60 * TOLERANCE[dtype], rtol=1e-5)
    assert all(found.abs().max() > 0.1 for found in reference)


@of_each
@pytest.mark.parametrize("asking", [0, 1], ids=["space", "time"])
def test_only_the_planes_that_ask_get_gradients(function, asking):
    planes = stacks("six", torch.float32)
    planes[asking].requires_grad_()
    function(*planes, *scattered(9, torch.float32), PLANE_SETS["six"]).sum().backward()
    assert planes[asking].grad.abs().max() > 0
    assert planes[1 - asking].grad is None


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")  # The interpreter's, on purpose.
@of_each
@of_each_float
def test_infinite_points_are_outside_and_nan_stays_nan(function, dtype):
    points, times = torch.zeros(6, 3, dtype=dtype), torch.full((6,), 0.4, dtype=dtype)
    points[:5, 0] = torch.tensor([torch.inf, -torch.inf, torch.nan, 3e38, -3e38])
    times[5] = torch.nan
    value = function(*stacks("six", dtype), points, times, PLANE_SETS["six"])
    untouched = [0, 1, 3, 4]
    assert (value[untouched, :2] == 0).all()  # xy and xz see x; yz does not
    assert value[untouched, 2].isfinite().all()
    assert value[2, :2].isnan().all()
    assert value[2, 2].isfinite().all()
    assert value[5].isnan().all()


@of_each_set
def test_results_are_the_same_bits_however_many_tasks_share_a_plane(monkeypatch, plane_set):
    found = []
    for tasks, count in ((1, 1), (2, 2), (4, 2), (32, 1)):
        monkeypatch.setattr(cpu, "tasks_a_plane", lambda planes, tasks=tasks: tasks)
        with threads(count):
            given = stacks(plane_set, torch.float32, size=16, time_rows=5, channels=8)
            found.append(both(plane_set, *given, *scattered(5000, torch.float32)))
    for loops, twin in found:
        assert all(map(torch.equal, loops, found[0][0]))
        torch.testing.assert_close(loops, twin, atol=1e-3, rtol=1e-4)


def test_each_thread_has_a_task(monkeypatch):
    for count, tasks in ((1, [1, 1]), (2, [1, 1]), (4, [2, 1]), (8, [4, 2])):
        monkeypatch.setattr(cpu, "get_num_threads", lambda count=count: count)
        assert [cpu.tasks_a_plane(3), cpu.tasks_a_plane(6)] == tasks, count


@settings(max_examples=40, deadline=None)
@given(
    size=st.integers(1, 6),
    rows=st.integers(1, 5),
    time_size=st.integers(1, 6),
    point=st.tuples(*[st.floats(-1.5, 1.5, width=32)] * 3),
    time=st.floats(-0.5, 1.5, width=32),
)
def test_any_point_of_any_resolution(size, rows, time_size, point, time):
    space, moving = stacks("nine", size=size, time_rows=rows, time_size=time_size, channels=2)
    points, times = torch.tensor([point]).double(), torch.tensor([time]).double()
    expected = oracle(named("nine", space, moving), "nine", points, times)
    found = both("nine", space, moving, points, times)
    for value, *_ in found:
        np.testing.assert_allclose(value.numpy(), expected, atol=1e-12)
    torch.testing.assert_close(*found, atol=1e-12, rtol=0)
