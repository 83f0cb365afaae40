"""Which cells of space training rays have seen."""

import math

import pytest
import torch

from tests.synthetic import ball_views
from xplanes.rendering.marching import march
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.visibility import Visibility, finest_cells
from xplanes.scenes.frame import cube_frame

TWINS = pytest.mark.parametrize("loops", ["0", "1"])


def emptied(resolution=4):
    visibility = Visibility(resolution)
    visibility.forget()
    return visibility


def places(*cells, resolution=4):
    """The middle of each cell (x, y, z)."""
    return (torch.tensor(cells) + 0.5) * (2 / resolution) - 1


def observe(visibility, rays):
    """Take in rays of (cell, weight) each."""
    samples = [(number, *sample) for number, ray in enumerate(rays) for sample in ray]
    ray = torch.tensor([number for number, _, _ in samples])
    starts = torch.searchsorted(ray, torch.arange(len(rays)))
    weights = torch.tensor([weight for _, _, weight in samples])
    visibility.observe(places(*(cell for _, cell, _ in samples)), weights, ray, starts)


def seen(visibility):
    """Cells (x, y, z) that are seen."""
    size = visibility.resolution
    return [(x, y, z) for z, y, x in visibility.last.view(size, size, size).nonzero().tolist()]


@TWINS
def test_a_cell_is_seen_if_enough_light_of_any_ray_reaches_it(loops, monkeypatch):
    monkeypatch.setenv("XPLANES_CPU_LOOPS", loops)
    visibility = Visibility(4)
    assert visibility.last.all()  # Before the first rays nothing counts as unseen.
    visibility.forget()
    assert not visibility.last.any()
    wall = [((0, 0, 0), 0.0), ((1, 0, 0), 0.95), ((2, 0, 0), 0.04), ((3, 0, 0), 0.01)]
    other = [((3, 2, 1), 0.995), ((2, 2, 1), 0.005)]
    observe(visibility, [wall, [], other])
    assert seen(visibility) == [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 2, 1)]
    observe(visibility, [[((3, 0, 0), 1.0)]])
    assert (3, 0, 0) in seen(visibility)


def test_what_was_seen_is_remembered_for_one_more_sweep():
    visibility = emptied()
    for again in (False, True):
        observe(visibility, [[((1, 2, 3), 0.5)]])
        if again:
            visibility.forget()
            observe(visibility, [[((1, 2, 3), 0.5)]])
        visibility.forget()
        assert seen(visibility) == [(1, 2, 3)]
        visibility.forget()
        assert not visibility.last.any()


@TWINS
def test_light_that_is_no_number_shows_nothing_more(loops, monkeypatch):
    monkeypatch.setenv("XPLANES_CPU_LOOPS", loops)
    visibility = emptied()
    observe(visibility, [[((0, 0, 0), 0.2), ((1, 0, 0), math.nan), ((2, 0, 0), 0.1)]])
    assert (2, 0, 0) not in seen(visibility)


def test_loops_and_twin_see_the_same(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    origins = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator), dim=1) * 3
    target = torch.rand(500, 3, generator=generator) - 0.5
    directions = torch.nn.functional.normalize(target - origins, dim=1)
    times = torch.rand(500, generator=generator)
    samples = march(origins, directions, times, times, OccupancyGrid(4, 2, step=0.1), step=0.1)
    weights = 0.2 * torch.rand(len(samples), generator=generator)
    found = []
    for loops in ("0", "1"):
        monkeypatch.setenv("XPLANES_CPU_LOOPS", loops)
        visibility = emptied(31)
        visibility.observe(samples.points, weights, samples.ray, samples.starts)
        found.append(visibility.last)
    assert torch.equal(*found)
    assert 0 < found[0].sum() < len(samples)


def test_samples_that_do_not_count_show_nothing():
    visibility, points = emptied(), places((0, 0, 0), (1, 0, 0))
    ray = torch.tensor([0, 0])
    live = torch.tensor([True, False])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XPLANES_CPU_LOOPS", "0")
        visibility.observe(points, torch.zeros(2), ray, torch.tensor([0]), live)
    assert seen(visibility) == [(0, 0, 0)]


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_cells_are_as_wide_as_pixels(scale):
    """Within bounds, and whatever the unit of the world."""
    for size, cells in ((60, 64), (100, 68), (200, 137), (800, 256)):
        views = ball_views(5, scale, size=size, distance=4 * scale)
        frame = cube_frame(scale, torch.zeros(3))
        assert finest_cells(views, frame, 64) == pytest.approx(cells, abs=1)
        assert finest_cells(views, frame, 300) == 300


def test_cells_are_the_finest_for_cameras_at_the_centre():
    views = ball_views(1, 1.0, poses=torch.eye(4)[None])
    assert finest_cells(views, cube_frame(1.0, torch.zeros(3)), 64) == 256


def test_a_state_brings_its_own_resolution():
    visibility = emptied(5)
    observe(visibility, [[((1, 2, 3), 0.5)]])
    other = Visibility(3)
    other.load_state_dict(visibility.state_dict())
    assert other.resolution == 5
    assert torch.equal(other.last, visibility.last)
