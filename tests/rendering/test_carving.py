"""Carving by silhouettes: content is never ruled out, clearly empty space is."""

import math
from dataclasses import replace

import pytest
import torch

from tests.balls import ball_views, inside_ball, surrounding, swinging
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.pruning import carve
from xplanes.scenes.frame import Frame, cube_frame

ORIGIN = torch.zeros(3)


def carved(views, *, resolution=24, bins=4, frame=None):
    grid = OccupancyGrid(resolution, bins, step=0.05)
    carve(grid, views, frame or cube_frame(1.4, ORIGIN))
    return grid


def allowed_at(grid, points, time, among=None):
    """Whether the cells of points in the field's frame are ``among`` others at a time."""
    x, y, z = ((points + 1) / 2 * grid.resolution).floor().long().unbind(dim=-1)
    shape = (grid.time_bins, *[grid.resolution] * 3)
    among = grid.allowed if among is None else among
    return among.view(shape)[int(grid.bins(torch.tensor([time]))), z, y, x]


@pytest.mark.parametrize("size", [24, 64])
def test_a_static_ball_is_kept_and_the_corners_are_not(size):
    views = ball_views(24, 0.5, size=size, times=torch.zeros(24))
    inside = cube_frame(1.4, ORIGIN).points(inside_ball(4000, 0.5))
    corners = torch.tensor([[0.95, 0.95, 0.95], [-0.95, 0.9, -0.95]])
    for resolution in [6, 24]:
        grid = carved(views, resolution=resolution, bins=1)
        assert allowed_at(grid, inside, 0.0).all()
        ball = 4 / 3 * math.pi * (0.5 / 1.4) ** 3 / 8
        around = 4 / 3 * math.pi * (0.5 / 1.4 + 4 / resolution + 8 / size) ** 3 / 8
        assert ball < grid.allowed.float().mean() < around
        assert not allowed_at(grid, corners, 0.0).any()


@pytest.mark.parametrize("distance", [1.9, 4.0])
def test_content_close_to_wide_cameras_is_kept(distance):
    centre = torch.tensor([0.6, 0.6, 0.6])
    static = {"size": 160, "angle": 1.5, "centre": lambda _: centre, "times": torch.zeros(40)}
    views = ball_views(40, 0.3, poses=surrounding(40, distance), **static)
    for resolution in [8, 32]:
        grid = carved(views, resolution=resolution, bins=1, frame=cube_frame(1.0, ORIGIN))
        assert allowed_at(grid, inside_ball(5000, 0.3) + centre, 0.0).all()
        assert grid.allowed.float().mean() < 0.5


@pytest.mark.parametrize(
    ("count", "radius", "turns", "share"),
    [(50, 0.4, 0.25, 0.0), (50, 0.3, 1, 0.0005), (200, 0.15, 2, 0.001)],
)
def test_a_moving_ball_is_never_ruled_out_and_most_else_is_empty(count, radius, turns, share):
    # In the span over which content counts as static, with 50 views, the slow ball moves by
    # at most a fifth of its radius, the fast one by its whole radius. More views do not rule out
    # what moves: the small ball moves twice as fast.
    path = swinging(0.8, turns)
    grid = carved(ball_views(count, radius, centre=path, size=48), resolution=32, bins=8)
    frame, lost = cube_frame(1.4, ORIGIN), 0
    for number in range(40):
        time = (number + 0.5) / 40
        points = frame.points(inside_ball(300, radius, seed=number) + path(time))
        lost += int((~allowed_at(grid, points, time)).sum())
    assert lost <= share * 40 * 300
    assert grid.occupied_fraction < 0.4


def test_what_only_joined_views_rule_out_fills_again():
    views = ball_views(50, 0.3, centre=swinging(0.8, 1), size=48)
    grid = carved(views, resolution=16, bins=8)
    presumed = grid.allowed & ~grid.occupied
    assert presumed.float().mean() > 0.05
    cells = presumed.nonzero()[:3, 0]
    grid.observe(cells, torch.full((3,), 100.0))
    assert grid.occupied[cells].all()


def test_a_rotated_and_translated_frame_carves_the_same_world():
    views = ball_views(
        24, 0.4, centre=lambda _: torch.tensor([0.3, -0.2, 0.1]), times=torch.zeros(24)
    )
    turn = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    frame = Frame(0.6, turn, torch.tensor([0.2, 0.1, 0.0]))
    grid = carved(views, resolution=24, bins=1, frame=frame)
    points = inside_ball(3000, 0.4) + torch.tensor([0.3, -0.2, 0.1])
    assert allowed_at(grid, frame.points(points), 0.0).all()
    assert grid.allowed.float().mean() < 0.1


def test_images_without_alpha_rule_out_nothing():
    views = ball_views(6, 0.4)
    images = views.images.clone()
    images[..., 3] = 255
    assert carved(replace(views, images=images)).allowed.all()


def test_a_time_bin_without_views_takes_its_neighbours():
    times = torch.tensor([0.0, 0.02, 0.04, 0.06, 0.94, 0.96, 0.98, 1.0])
    views = ball_views(8, 0.5, times=times)
    grid = carved(views, bins=10)
    points = cube_frame(1.4, ORIGIN).points(inside_ball(500, 0.5))
    for time in (0.05, 0.35, 0.55, 0.95):
        assert allowed_at(grid, points, time).all()
    bins = grid.allowed.view(10, -1)
    assert all(torch.equal(bins[5], other) for other in bins[2:9])
    assert not torch.equal(bins[5], bins[9])


def test_one_view_and_views_out_of_order_work():
    assert allowed_at(carved(ball_views(1, 0.5)), ORIGIN[None], 0.3).all()
    views = ball_views(20, 0.4, centre=swinging(0.6, 1))
    shuffled = views.subset(torch.randperm(20, generator=torch.Generator().manual_seed(0)))
    assert torch.equal(carved(views).allowed, carved(shuffled).allowed)
    assert torch.equal(carved(views).occupied, carved(shuffled).occupied)


def test_silhouettes_from_wrong_poses_rule_nothing_out_for_good():
    views = ball_views(12, 0.5)
    exact, wrong = (OccupancyGrid(16, 1, step=0.02) for _ in range(2))
    for grid, known in ((exact, True), (wrong, False)):
        carve(grid, views, cube_frame(1.4, ORIGIN), exact=known)
    assert torch.equal(exact.occupied, wrong.occupied)
    assert not exact.allowed.all()
    assert wrong.allowed.all()
