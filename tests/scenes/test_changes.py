"""What changes before fixed cameras, and the rays that see it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.balls import ball_views, inside_ball, surrounding, swinging
from tests.training.runs import changed
from xplanes.components import build
from xplanes.models.base import ModelSettings
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.pruning import keep_moving
from xplanes.rendering.sampler import time_rows
from xplanes.scenes.batches import STATIC_SHARE, RayBatches
from xplanes.scenes.frame import cube_frame, scene_frame
from xplanes.scenes.silhouettes import CHANGE, changing, moving

FRAMES, CAMERAS, SIZE = 7, 3, 30


def rig(**how):
    """A ball that swings before grey walls, seen by fixed cameras that take pictures together."""
    poses = surrounding(CAMERAS, 4.0).repeat(FRAMES, 1, 1)
    times = torch.linspace(0, 1, FRAMES).repeat_interleave(CAMERAS)
    views = ball_views(
        CAMERAS * FRAMES, 0.3, centre=swinging(0.8, 0.8), times=times, poses=poses, size=SIZE, **how
    )
    images = views.images.clone()
    images[images[..., 3] == 0] = torch.tensor([90, 140, 60, 255], dtype=torch.uint8)
    return replace(views, images=images), views.images[..., 3] > 0


def test_what_differs_from_the_cameras_median_changes():
    views, ball = rig()
    found = changing(views, [0] * len(views))
    assert found is not None
    images = views.images.view(FRAMES, CAMERAS, SIZE, SIZE, 4).numpy().astype(int)
    for camera in range(CAMERAS):
        taken = images[:, camera, ..., :3]
        expected = abs(taken - np.median(taken, axis=0)).max(axis=-1) >= CHANGE
        seen = found.view(FRAMES, CAMERAS, SIZE, SIZE)[:, camera]
        assert torch.equal(seen, torch.from_numpy(expected))
    assert (found & ball).sum() > 0.8 * ball.sum()
    wide = changing(views, [2] * len(views))
    assert wide is not None
    assert (wide | found).equal(wide)
    assert wide.sum() > found.sum()


def test_cameras_that_move_or_show_nothing_that_changes_are_left_alone():
    views, _ = rig()
    moved = views.camera_to_world + 1e-3 * torch.rand(len(views), 1, 1)
    assert changing(replace(views, camera_to_world=moved), [0] * len(views)) is None
    static = replace(views, images=views.images[:1].expand_as(views.images).contiguous())
    assert changing(static, [0] * len(views)) is None
    assert changing(views.subset(torch.arange(2 * CAMERAS)), [0] * 2 * CAMERAS) is None


def moving_in(views, points, **how):
    bins = (views.times * (FRAMES - 1)).round().long()
    return moving(views, points, **{"radius": 0.05, "bins": bins, "count": FRAMES, **how})


def in_ball(frame, count=500):
    """Points in the ball of a rig's frame, a little smaller than it."""
    return swinging(0.8, 0.8)(frame / (FRAMES - 1)) + inside_ball(count, 0.25)


def test_what_moves_lies_where_every_fixed_camera_sees_a_change():
    views, _ = rig()
    anywhere = 2.8 * torch.rand(20000, 3, generator=torch.Generator().manual_seed(0)) - 1.4
    everywhere = moving_in(views, anywhere)
    for frame in range(FRAMES):
        assert moving_in(views, in_ball(frame))[frame].float().mean() > 0.97
        centre = swinging(0.8, 0.8)(frame / (FRAMES - 1))
        away = (anywhere - centre).norm(dim=1) > 0.8
        assert everywhere[frame, away].float().mean() < 0.03
    # The images of a bin together show at least as much.
    together = moving_in(views, anywhere, bins=torch.zeros(len(views), dtype=torch.int64), count=1)
    assert together[0, everywhere.any(dim=0)].all()
    assert together[0].float().mean() < 0.3


def test_a_bin_without_images_shows_the_changes_of_those_beside_it():
    views, _ = rig()
    bins = 2 * (views.times * (FRAMES - 1)).round().long()
    for frame in range(FRAMES):
        found = moving_in(views, in_ball(frame), bins=bins, count=2 * FRAMES)
        assert torch.equal(found[1::2] | found[::2], found[1::2])
        assert found[2 * frame + 1].float().mean() > 0.97


def test_a_line_of_one_pixel_moves():
    views, _ = rig()
    images = torch.full_like(views.images, 90)
    images[..., 3] = 255
    for index in range(CAMERAS * 3, CAMERAS * 4):  # In one frame; on an odd row.
        images[index, 15, :, :3] = 250
    points = inside_ball(2000, 1.0)
    found = moving_in(replace(views, images=images), points, radius=0.2)
    assert found[3].any()
    assert not found[[0, 1, 2, 4, 5, 6]].any()


def test_only_cameras_that_stay_and_see_a_point_tell_whether_something_moves_there():
    views, _ = rig()
    points = in_ball(3)
    assert moving_in(views.subset(torch.arange(0, len(views), CAMERAS)), points) is None
    moved = views.camera_to_world + 1e-3 * torch.rand(len(views), 1, 1)
    assert moving_in(replace(views, camera_to_world=moved), points) is None
    whole = moving_in(views, points)
    assert whole[3].float().mean() > 0.97
    # The first camera looks past the scene, moves, or shows the scene in a few rows alone.
    past, wandering = views.camera_to_world.clone(), views.camera_to_world.clone()
    past[::CAMERAS, :3, 3] += 100
    wandering[::CAMERAS] += 1e-3 * torch.rand(FRAMES, 1, 1)
    images, ignored = views.images.clone(), torch.zeros(views.images.shape[:3], dtype=torch.bool)
    ignored[::CAMERAS, 4:] = True
    images[ignored] = 0
    images[..., 3] = 255
    for others in (
        replace(views, camera_to_world=past),
        replace(views, camera_to_world=wandering),
        replace(views, images=images, ignored=ignored),
    ):
        found = moving_in(others, points)
        assert torch.equal(found[3] | whole[3], found[3])


def test_cells_in_which_something_moves_stay_occupied():
    views, _ = rig()
    frame = cube_frame(1.4, torch.zeros(3))

    def kept(views):
        grid = OccupancyGrid(16, FRAMES, step=0.05)
        keep_moving(grid, views, frame)
        cells = torch.arange(len(grid.density))
        for _ in range(30):
            grid.observe(cells, torch.zeros(len(cells)))
        return grid

    grid = kept(views)
    assert 0.01 < grid.occupied_fraction < 0.15
    for number, time in enumerate(views.times.unique()):
        found = grid.occupied[grid.cells(frame.points(in_ball(number)), time.expand(500))]
        assert found.float().mean() > 0.97
    # Silhouettes, a scene that is declared static, and flickering light tell of no motion.
    transparent = ball_views(6, 0.5, poses=views.camera_to_world[:1].expand(6, 4, 4), size=SIZE)
    static = replace(views, times=torch.zeros(len(views)))
    images = views.images.clone()
    images[: 3 * CAMERAS, ..., :3] += 60
    for others in (transparent, static, replace(views, images=images)):
        assert kept(others).occupied_fraction == 0


def test_rays_see_more_of_what_changes_and_all_of_the_rest():
    views, _ = rig()
    settings = build(changed(())["model"], ModelSettings, "model").rays
    frame = scene_frame(views)
    drawn = RayBatches(views, frame, settings, seed=0)
    share = float(changing(views, [1] * len(views)).float().mean())
    assert 0.02 < share < 0.5
    assert drawn.far_share == STATIC_SHARE
    assert drawn.background_jitter == 0
    batch = drawn.draw(0)
    assert set(batch["times"].tolist()) <= set(views.times.tolist())
    uniform = RayBatches(views, frame, replace(settings, skip_background=False), seed=0)
    assert uniform.far_share == 0
    green = torch.tensor([90, 140, 60]) / 255

    def share_of_ball(drawn):
        return float((drawn["target"] - green).abs().sum(dim=1).gt(0.1).float().mean())

    assert share_of_ball(batch) > 1.5 * share_of_ball(uniform.draw(0))
    transparent = ball_views(6, 0.5, poses=views.camera_to_world[:1].expand(6, 4, 4), size=SIZE)
    assert RayBatches(transparent, frame, settings, seed=0).background_jitter > 0


@pytest.mark.parametrize(
    ("times", "views_each", "rows"),
    [(1, 5, 2), (2, 1, 2), (50, 1, 25), (50, 2, 25), (51, 2, 26), (12, 4, 12), (12, 8, 12)],
)
def test_rows_of_time_where_they_are_left_open(times, views_each, rows):
    assert time_rows(torch.linspace(0, 1, times).repeat(views_each)) == rows
