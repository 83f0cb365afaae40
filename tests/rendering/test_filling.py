"""The occupancy grid filled from a field: which cells stay and which are pruned."""

import torch

from tests.rendering.test_carving import allowed_at
from tests.synthetic import ball_views, inside_ball, swinging
from xplanes.rendering import filling
from xplanes.rendering.filling import fill
from xplanes.rendering.occupancy import OccupancyGrid
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
    grid.allowed, allowed = grid.occupied, grid.allowed
    found = allowed_at(grid, points, time)
    grid.allowed = allowed
    return found


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
    monkeypatch.setattr(filling, "RAYS", 50)
    grouped = filled(views, ball_field(0.3, static))
    assert torch.equal(grouped.occupied, whole.occupied)
    assert torch.equal(grouped.density, whole.density)


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
