"""Sampling: compiled loops, readable twin and NumPy oracle place the same samples.

The three may round differently, so a sample that lies on a border may fall to either side. In
float64 that is not seen with random rays, and they must agree exactly. In float32 the loops compute
places in float64 and the twin in float32: cells may differ for samples within 1e-4 cells of a
border of their cell, and samples may come or go within 1e-5 of where the ray leaves the cube;
nothing else may differ.
"""

import copy
import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles import march as oracle
from tests.oracles import ray_box
from xplanes.rendering.marching import Rays, march, march_gpu, march_reference
from xplanes.rendering.occupancy import OccupancyGrid

try:
    import triton
except ImportError:
    triton = None

STEP = 0.07

needs_triton = pytest.mark.skipif(triton is None, reason="triton is not installed")


def grid_of(resolution=6, bins=3, *, seed=0, filled=0.4, dense=20.0):
    """A grid whose cells let through a random share of light at most; some are empty."""
    generator = torch.Generator().manual_seed(seed)
    grid = OccupancyGrid(resolution, bins, step=STEP)
    uniform = torch.rand(len(grid.least), generator=generator)
    grid.least.copy_(dense * torch.rand(len(uniform), generator=generator))
    grid.occupied.copy_(uniform < filled)
    return grid


def rays_of(count, dtype=torch.float64, seed=1):
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(count, 3, generator=generator, dtype=dtype)
    origins = 3 * origins / origins.norm(dim=-1, keepdim=True)
    origins[::4] *= 0.2  # some start inside
    target = torch.rand(count, 3, generator=generator, dtype=dtype) * 2.4 - 1.2
    directions = target - origins
    directions = directions / directions.norm(dim=-1, keepdim=True)
    times, jitter = torch.rand(2, count, generator=generator, dtype=dtype)
    return origins, directions, times, jitter


def loops(rays, grid, **options):
    return march(Rays(*rays), grid, **{"step": STEP, **options})


def details(grid, *, step=STEP, skip_empty=True, occlusion=0.0, **options):
    """What the parts of `march` are given for its own options."""
    limit = -math.log(occlusion) if occlusion > 0 else math.inf
    occupied = grid.occupied if skip_empty else None
    return {"step": step, "occupied": occupied, "limit": limit, **options}


def twin(rays, grid, room=None, **options):
    return march_reference(Rays(*rays), grid, room=room, **details(grid, **options))


def by_kernel(rays, grid, room=None, **options):
    """The Triton kernel: on a GPU if there is one, else in triton's interpreter."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    grid, rays = copy.deepcopy(grid).to(device), [ray.to(device) for ray in rays]
    found = march_gpu(Rays(*rays), grid, room=room, **details(grid, **options))
    on_cpu = {n: t.cpu() for n, t in vars(found).items() if isinstance(t, torch.Tensor)}
    return dataclasses.replace(found, **on_cpu)


of_each = pytest.mark.parametrize("take", [loops, twin, *([by_kernel] if triton else [])])


def as_the_oracle(rays, grid, *, skip_empty=True, **options):
    """Loops and twin take the samples of the oracle, whose counts are returned."""
    shape = (grid.time_bins, *[grid.resolution] * 3)
    cells = (cells.view(shape).double().numpy() for cells in (grid.occupied, grid.least))
    given = {"step": STEP, "occlusion": 0.0, **options}
    kept, counts = oracle(*(ray.double().numpy() for ray in rays), *cells, skip=skip_empty, **given)
    for take in (loops, twin):
        found = take(rays, grid, skip_empty=skip_empty, **options)
        assert found.ray.tolist() == [row[0] for row in kept]
        assert found.cells.tolist() == [row[2] for row in kept]
        np.testing.assert_allclose(found.distances, [row[1] for row in kept], atol=1e-12)
        points = np.array([row[3:] for row in kept]).reshape(-1, 3)
        np.testing.assert_allclose(found.points, points, atol=1e-12)
        assert (found.candidates, found.empty, found.occluded) == counts
        number = torch.bincount(found.ray, minlength=len(rays[0]))
        assert torch.equal(found.starts, number.cumsum(0) - number)
    return counts


with_options = pytest.mark.parametrize(
    ("skip", "occlusion"), [(s, o) for s in (True, False) for o in (0.0, 0.001, 0.3)]
)


@with_options
def test_samples_equal_the_loops_of_the_oracle(skip, occlusion):
    counts = as_the_oracle(rays_of(60), grid_of(), skip_empty=skip, occlusion=occlusion)
    assert (counts[1] > 0) == skip
    assert (counts[2] > 0) == (occlusion > 0)


def test_in_float32_only_samples_on_borders_differ():
    grid, rays = grid_of(17, 5, filled=1.1), rays_of(1000, torch.float32)
    near, found, places = near_of(rays), [take(rays, grid) for take in (loops, twin)], []
    for samples in found:
        assert samples.candidates == samples.empty + samples.occluded + len(samples)
        assert (samples.ray.diff() >= 0).all()
        assert samples.points.dtype == samples.distances.dtype == torch.float32
        steps = (samples.distances - near[samples.ray]) / STEP - rays[3][samples.ray]
        places.append(1000 * samples.ray + steps.round().long())
    shared = torch.isin(*places), torch.isin(*reversed(places))
    kept = list(zip(found, shared, strict=True))
    for samples, alike in kept:
        assert ((samples.points[~alike].abs().amax(dim=1) - 1).abs() < 1e-5).all()
    points, cells = [s.points[alike] for s, alike in kept], [s.cells[alike] for s, alike in kept]
    assert len(points[0]) > 15_000
    torch.testing.assert_close(*points, atol=2e-6, rtol=0)
    other = cells[0] != cells[1]
    place = (points[0][other] + 1) * (grid.resolution / 2)
    assert ((place - place.round()).abs().amin(dim=-1) < 1e-4).all()
    assert other.float().mean() < 1e-4


def near_of(rays):
    origins, directions = (ray.double().numpy() for ray in rays[:2])
    return torch.tensor([ray_box(o, d)[0] for o, d in zip(origins, directions, strict=True)])


@of_each
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.filterwarnings("ignore:(divide by zero|invalid value):RuntimeWarning")
def test_impossible_rays_have_no_samples(take, bad):
    rays = rays_of(4)
    rays[0][1, 2], rays[1][2, 0] = bad, bad
    found = take(rays, grid_of(filled=1.1))
    assert set(found.ray.tolist()) == {0, 3}
    assert found.points.isfinite().all()


@pytest.mark.parametrize("rays", [rays_of(0), (rays_of(3)[0] + 9, *rays_of(3)[1:])], ids=len)
@pytest.mark.parametrize("take", [loops, twin])
def test_no_rays_or_no_hits(take, rays):
    found = take(rays, grid_of())
    assert len(found) == found.candidates == found.empty == found.occluded == 0
    assert found.points.shape == (0, 3)
    assert found.starts.tolist() == [0] * len(rays[0])


@pytest.mark.parametrize("huge", [1e8, 1e20, 1e30, 3e38, math.inf])
def test_huge_densities_on_one_ray_do_not_disturb_the_next(huge):
    grid = grid_of(8, 1, filled=1.1, dense=3.0)
    grid.least[::7] = huge
    as_the_oracle(rays_of(150), grid, occlusion=0.2)


@settings(max_examples=40, deadline=None)
@given(
    resolution=st.integers(1, 9),
    bins=st.integers(1, 4),
    step=st.floats(0.02, 3.0),
    occlusion=st.sampled_from([0.0, 1e-3, 0.5, 1.0]),
    skip=st.booleans(),
    seed=st.integers(0, 99),
)
def test_any_grid_and_step(resolution, bins, step, occlusion, skip, seed):
    grid, rays = grid_of(resolution, bins, seed=seed), rays_of(12, seed=seed)
    as_the_oracle(rays, grid, step=step, skip_empty=skip, occlusion=occlusion)


@with_options
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_fixed_number_of_places_takes_the_same_samples(skip, occlusion, dtype):
    grid, rays = grid_of(), rays_of(60, dtype)
    expected = twin(rays, grid, skip_empty=skip, occlusion=occlusion)
    found = twin(rays, grid, len(expected) + 30, skip_empty=skip, occlusion=occlusion)
    live = found.live
    assert live.sum() == found.count == len(expected)
    assert not live[len(expected) :].any()
    for name in ("ray", "cells", "distances", "points"):
        assert torch.equal(getattr(found, name)[live], getattr(expected, name)), name
    assert torch.equal(found.starts, expected.starts)
    assert found.shown.all()
    for name in ("candidates", "empty", "occluded"):
        assert int(getattr(found, name)) == getattr(expected, name), name
    # The others lie where nothing is, behind all samples.
    assert (found.points[~live] > 1).all()
    assert (found.ray.diff() >= 0).all()


@pytest.mark.parametrize("share", [1.0, 0.999, 0.5])
def test_rays_without_room_are_left_out_whole(share):
    grid, rays = grid_of(), rays_of(60)
    whole = twin(rays, grid)
    room = int(share * len(whole))
    found = twin(rays, grid, room)
    shown = found.shown
    assert bool(shown.all()) == (room == len(whole))
    kept = shown[whole.ray]
    assert found.count == kept.sum() <= room
    # Those in front have room; the first without ends it.
    assert torch.equal(shown, shown.cummin(0).values)
    next_ones = whole.ray.bincount(minlength=60)[shown.sum() :][:1].sum()
    assert shown.all() or kept.sum() + next_ones > room
    assert torch.equal(found.distances[found.live], whole.distances[kept])
    assert torch.equal(found.ray[found.live], whole.ray[kept])
    assert found.occluded == whole.occluded


def same_places(found, expected):
    for name in ("starts", "live", "shown", "ray"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    for name in ("cells", "distances"):
        ours, theirs = (getattr(samples, name)[expected.live] for samples in (found, expected))
        torch.testing.assert_close(ours, theirs, msg=name)
    torch.testing.assert_close(found.points, expected.points)
    for name in ("candidates", "empty", "occluded", "count"):
        assert int(getattr(found, name)) == int(getattr(expected, name)), name


@needs_triton
@pytest.mark.parametrize(
    ("dtype", "share"), [(torch.float32, s) for s in (1.2, 0.5, 0)] + [(torch.float64, 1)]
)
def test_the_kernel_fills_a_fixed_number_of_places_as_the_twin_does(dtype, share):
    grid, rays = grid_of(7, 3), rays_of(12, dtype)
    number = len(twin(rays, grid, occlusion=0.001))
    assert number > 20
    found, expected = (
        take(rays, grid, room=int(share * number), occlusion=0.001) for take in (by_kernel, twin)
    )
    same_places(found, expected)


def same_cells(found, expected):
    assert torch.equal(found.cells, expected.cells)
    assert torch.equal(found.ray, expected.ray)


@needs_triton
def test_the_kernel_looks_as_far_as_a_ray_goes():
    """Through several blocks of places, and with cells that are denser than float32 holds."""
    grid, rays = grid_of(8, 1, filled=1.1, dense=0.5), rays_of(6)
    grid.least[::194], grid.least[97::194] = math.inf, 1e30
    found, expected = (take(rays, grid, step=0.011, occlusion=0.2) for take in (by_kernel, twin))
    same_cells(found, expected)
    assert found.occluded == expected.occluded > 0
    assert found.candidates > 3 * 64


@needs_triton
@pytest.mark.filterwarnings("ignore:(divide by zero|invalid value):RuntimeWarning")
def test_the_kernel_takes_the_twins_samples_along_faces_and_edges():
    places, along = torch.tensor([[1.0, 0, 3], [1, 1, 3], [0, 0, 3]]), torch.tensor([[0.0, 0, -1]])
    rays = (places, along.expand(3, 3), torch.zeros(3), torch.full((3,), 0.5))
    rays, grid = [tensor.double() for tensor in rays], grid_of(filled=1.1)
    same_cells(by_kernel(rays, grid), twin(rays, grid))
