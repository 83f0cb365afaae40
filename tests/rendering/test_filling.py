"""The occupancy grid filled from a field: which cells stay and which are pruned."""

import math

import pytest
import torch

from tests.balls import ball_views, inside_ball, swinging
from tests.rendering.test_carving import allowed_at
from xplanes.rendering import pruning
from xplanes.rendering.marching import march
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.pruning import fill
from xplanes.scenes.frame import cube_frame

FRAME = cube_frame(1.4, torch.zeros(3))
STEP = 0.04


def ball_field(radius, centre, shown=lambda times: torch.ones_like(times, dtype=torch.bool)):
    """A dense ball, in world units, at those times at which it is shown."""

    def field(points, times):
        world = FRAME.to_world(points)
        place = torch.stack([centre(time) for time in times.tolist()])
        inside = ((world - place).norm(dim=-1) < radius) & shown(times)
        return torch.zeros_like(points), inside.float() * 1000

    return field


def filled(views, field, *, resolution=20, bins=4):
    grid = OccupancyGrid(resolution, bins, step=STEP)
    generator = torch.Generator().manual_seed(0)
    fill(grid, field, views, FRAME, step=STEP, generator=generator)
    return grid


def occupied_at(grid, points, time):
    return allowed_at(grid, points, time, grid.occupied)


def static(_):
    return torch.zeros(3)


def test_a_field_that_shows_all_leaves_its_own_cells_and_few_around():
    views = ball_views(12, 0.5, size=32)
    grid = filled(views, ball_field(0.5, static))
    points = FRAME.points(inside_ball(500, 0.45))
    for time in (0.1, 0.4, 0.6, 0.9):
        assert occupied_at(grid, points, time).all()
    assert grid.occupied_fraction < 0.15


def test_rays_may_march_in_groups(monkeypatch):
    views = ball_views(6, 0.5, size=24)
    whole = filled(views, ball_field(0.3, static))
    monkeypatch.setattr(pruning, "RAYS", 50)
    grouped = filled(views, ball_field(0.3, static))
    assert torch.equal(grouped.occupied, whole.occupied)
    assert torch.equal(grouped.density, whole.density)


@pytest.mark.parametrize("shown", [0.42, 0.0])
def test_few_rays_find_the_cells_that_rays_through_all_pixels_find(monkeypatch, shown):
    """Of a ball whose rim or whole is missing: thin in the images, or as wide as these."""
    views = ball_views(8, 0.5, size=160)
    rays = []

    def counted(given, *rest, **named):
        rays.append(len(given.origins))
        return march(given, *rest, **named)

    monkeypatch.setattr(pruning, "march", counted)
    few = filled(views, ball_field(shown, static), resolution=12)
    spent, rays[:] = sum(rays), []
    monkeypatch.setattr(pruning, "pixels_of_a_cell", lambda *_: 1)
    every = filled(views, ball_field(shown, static), resolution=12)
    assert (few.occupied != every.occupied).sum() <= 0.001 * every.occupied.sum()
    assert spent < 0.5 * sum(rays)


def test_a_cell_is_as_wide_as_it_looks_at_the_far_end_of_the_cube():
    views = ball_views(1, 0.5, size=400, distance=4.0)
    corner = 4.0 + 1.4 * math.sqrt(3)
    wide = float(views.intrinsics.focal[0, 0]) * 2.8 / 20 / corner
    assert pruning.pixels_of_a_cell(views, 0, FRAME, 20) == math.floor(wide) > 5
    assert pruning.pixels_of_a_cell(views, 0, FRAME, 2000) == 1


@pytest.mark.parametrize("side", [1, 3, 4])
def test_each_square_of_a_mask_has_one_pixel(side):
    mask = torch.rand(10, 13, generator=torch.Generator().manual_seed(0)) < 0.2
    pixels = pruning.one_of_each_square(mask, side)
    assert mask[tuple(pixels.T)].all()
    squares = {tuple(square) for square in (pixels // side).tolist()}
    assert len(squares) == len(pixels)
    assert squares == {tuple(square) for square in (mask.nonzero() // side).tolist()}


def test_a_field_that_shows_nothing_leaves_every_foreground_ray_open():
    views = ball_views(12, 0.5, size=32)

    def nothing(points, times):
        return torch.zeros_like(points), torch.zeros_like(times)

    grid = filled(views, nothing)
    points = FRAME.points(inside_ball(500, 0.45))
    for time in views.times.tolist():
        assert occupied_at(grid, points, time).all()
    assert not grid.occupied.all()


def test_what_a_field_misses_for_a_while_stays_possible():
    path = swinging(0.6, 0.5)
    views = ball_views(24, 0.4, centre=path, size=32)
    late = ball_field(0.4, path, shown=lambda times: times > 0.5)
    grid = filled(views, late)
    for time in views.times.tolist():
        points = FRAME.points(inside_ball(200, 0.35) + path(time))
        assert occupied_at(grid, points, time).float().mean() > 0.97


def test_cells_that_are_ruled_out_stay_so():
    views = ball_views(6, 0.5, size=24)
    grid = OccupancyGrid(12, 4, step=STEP)
    allowed = torch.rand(4, 12, 12, 12, generator=torch.Generator().manual_seed(1)) < 0.5
    grid.allow(allowed)
    generator = torch.Generator().manual_seed(0)
    fill(grid, ball_field(0.5, static), views, FRAME, step=STEP, generator=generator)
    assert not (grid.occupied & ~allowed.flatten()).any()
    assert torch.equal(grid.occupied, grid.density > grid.empty_density)
