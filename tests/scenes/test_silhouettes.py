"""The visual hull over short spans of time."""

from dataclasses import replace

import numpy as np
import torch

from tests.balls import ball_views, inside_ball, swinging
from tests.oracles import visual_hull
from xplanes.scenes.silhouettes import MOST_VIEWS, WINDOW, foreground, join_in_time, may_hold


def projected_hull(views, points):
    """Independent reference: points that no view shows outside of its silhouette."""
    alpha, poses = views.images[..., 3].numpy(), views.camera_to_world.double().numpy()
    return visual_hull(alpha, poses, float(views.intrinsics.focal[0, 0]), points)


def silhouette_hull(views, points, *, radius):
    return join_in_time(may_hold(views, points, radius=radius), views.times)


def test_foreground_widens_by_whole_pixels():
    views = ball_views(2, 0.4, size=20)
    images = views.images.clone()
    images[..., 3] = 0
    images[0, 5, 7, 3] = 255
    for margin in (0, 1, 3):
        found = foreground(replace(views, images=images), [margin] * 2)
        rows, columns = found[0].nonzero(as_tuple=True)
        assert (rows.min(), rows.max()) == (5 - margin, 5 + margin)
        assert (columns.min(), columns.max()) == (7 - margin, 7 + margin)
        assert found[0].sum() == (2 * margin + 1) ** 2
        assert not found[1].any()


def grid_points(half=1.3, cells=9):
    """A grid off the middle, so that no point projects onto a border between pixels."""
    line = torch.linspace(-half, half, cells)
    grid = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), dim=-1).view(-1, 3)
    return grid + torch.tensor([0.0123, -0.0217, 0.0171])


def test_without_a_radius_the_hull_is_that_of_projected_points():
    views = ball_views(10, 0.6, size=32, times=torch.zeros(10))
    points = grid_points()
    found, expected = silhouette_hull(views, points, radius=0.0), projected_hull(views, points)
    assert 0.01 < expected.mean() < 0.9
    assert (found == found[0]).all()
    assert np.array_equal(found[0].numpy(), expected)


def test_a_moving_hull_asks_every_view_of_some_span_around():
    points = grid_points(cells=4)
    for count in (12, 100):  # Of the latter, the most views that a span has.
        views = ball_views(count, 0.5, centre=swinging(0.5, 1), size=24)
        single = [projected_hull(views.subset(torch.tensor([i])), points) for i in range(count)]
        span = max(1, min(MOST_VIEWS, round(WINDOW * count)))
        expected = np.zeros((count, len(points)), dtype=bool)
        for first in range(count - span + 1):
            expected[first : first + span] |= np.all(single[first : first + span], axis=0)
        found = silhouette_hull(views, points, radius=0.0)
        assert np.array_equal(found.numpy(), expected), count


def test_the_radius_keeps_whatever_a_ball_around_the_point_could_hold():
    views = ball_views(12, 0.5, size=32, times=torch.zeros(12))
    points = grid_points()
    distance = points.norm(dim=-1)
    alone = silhouette_hull(views, points, radius=0.0)[0]
    for radius in (0.01, 0.1, 0.4):
        found = silhouette_hull(views, points, radius=radius)[0]
        touches = (distance - radius) < 0.5 - 0.05  # by more than a pixel
        assert found[touches].all(), radius
        assert (found | ~alone).all(), radius
        beyond = (distance > 0.6 + 1.6 * radius) & (distance < 1.4)
        assert not found[beyond].any(), radius  # all in sight


def test_points_at_and_behind_the_camera_are_not_ruled_out():
    views = ball_views(1, 0.3, size=24)
    place, back = views.camera_to_world[0, :3, 3], views.camera_to_world[0, :3, 2]
    points = torch.stack([place, place + back, place - 1e-4 * back])
    assert silhouette_hull(views, points, radius=0.01).all()


def test_images_of_nothing_rule_out_what_they_see():
    views = ball_views(5, 0.3, times=torch.zeros(5))
    empty = replace(views, images=torch.zeros_like(views.images))
    assert not silhouette_hull(empty, inside_ball(50, 0.3), radius=0.02).any()
    full = replace(views, images=torch.full_like(views.images, 255))
    assert silhouette_hull(full, inside_ball(50, 0.3), radius=0.02).all()
