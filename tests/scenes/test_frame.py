"""The field's frame: similarities, the point that cameras look at, and the scene's cube."""

import math
from dataclasses import replace

import pytest
import torch

from tests.balls import ball_views, inside_ball, swinging
from xplanes.errors import SceneError
from xplanes.scenes.cameras import look_at, orbit
from xplanes.scenes.frame import (
    CubeHints,
    Frame,
    _reach,
    cube_frame,
    optical_centre,
    pixels_across,
    scene_frame,
)
from xplanes.scenes.lenses import Lenses, LensModel
from xplanes.scenes.views import Intrinsics, Views


def turned(scale=0.4):
    """A frame turned about a slanted axis."""
    pose = look_at(torch.tensor([[1.0, 2.0, 0.5]]))[0]
    return Frame(scale, pose[:3, :3], torch.tensor([0.5, -1.0, 2.0]))


def views_of(poses, *, focal=50.0, size=10):
    """Opaque views."""
    images = torch.full((len(poses), size, size, 4), 255, dtype=torch.uint8)
    times = torch.linspace(0, 1, len(poses))
    return Views(images, poses, times, focal, tuple(map(str, range(len(poses)))))


def test_a_ray_and_its_points_move_together():
    frame, generator = turned(), torch.Generator().manual_seed(2)
    origins, directions = torch.randn(2, 6, 3, generator=generator)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    moved, turned_directions = frame.rays(origins, directions)
    torch.testing.assert_close(turned_directions.norm(dim=-1), torch.ones(6))
    point = frame.points(origins + 2.5 * directions)
    along = moved + 2.5 * frame.scale * turned_directions
    torch.testing.assert_close(along, point, atol=1e-5, rtol=1e-5)
    centre = torch.tensor([1.0, -2, 3])
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1])] * 3)
    torch.testing.assert_close(cube_frame(2.5, centre).points(centre + 2.5 * corners), corners)
    # A camera at the centre sees a finite number of pixels.
    within = pixels_across(views_of(torch.eye(4)[None]), cube_frame(5.0, torch.zeros(3)))
    assert 0 < within < 1000


def test_the_optical_centre_is_where_cameras_look():
    target, origin = torch.tensor([0.5, -1.5, 2.0]), torch.zeros(3)
    crossed = look_at(torch.tensor([[3.0, 0, 0], [0.0, 4, 0]]), target)
    around = [orbit(9, radius=3.0, elevation=e, target=target) for e in (-20.0, 0.0, 35.0)]
    alone = look_at(torch.tensor([[2.0, 1.0, 2.0]]))  # The point of its axis near the origin.
    for poses, expected in (*((each, target) for each in (crossed, *around)), (alone, origin)):
        torch.testing.assert_close(optical_centre(views_of(poses)), expected, atol=1e-4, rtol=0)


def test_the_cube_of_a_static_scene_is_tight():
    centre = torch.tensor([0.1, -0.2, 0.15])
    for radius in (0.2, 0.5, 1.0):
        views = ball_views(30, radius, centre=lambda _: centre, size=48, times=torch.zeros(30))
        frame = scene_frame(views)
        points = frame.points(inside_ball(3000, radius) + centre)
        assert points.abs().max() <= 1, radius
        assert 1 / frame.scale < radius + 0.35, radius


def test_the_cube_of_a_dynamic_scene_contains_it_at_all_times():
    for turns in (0.5, 1):
        path = swinging(0.7, turns)
        frame = scene_frame(ball_views(40, 0.3, centre=path, size=32))
        for time in torch.linspace(0, 1, 41).tolist():
            ball = inside_ball(200, 0.3) + path(time)
            assert frame.points(ball).abs().max() <= 1, (turns, time)


def test_without_alpha_the_cube_is_what_the_cameras_see():
    views = views_of(orbit(12, radius=3.0, elevation=10.0), focal=10.0, size=10)
    half = 1 / scene_frame(views).scale
    # Half the field of view's tangent is 0.5, at a distance of 3.
    assert 1.5 <= half < 1.5 * 1.05


def test_cameras_that_look_away_from_one_another_are_refused_with_a_way_out():
    poses = orbit(6, radius=2.0, elevation=0.0)
    poses[:, :3, 0] *= -1
    poses[:, :3, 2] *= -1  # turned about: they look outwards
    with pytest.raises(SceneError, match=r"data\.half_side and data\.centre"):
        scene_frame(views_of(poses))


def test_images_of_nothing_leave_the_cameras_cube():
    views = ball_views(12, 0.2, size=32, times=torch.zeros(12))
    empty = replace(views, images=torch.zeros_like(views.images))
    opaque = replace(views, images=torch.full_like(views.images, 255))
    assert scene_frame(empty).scale == pytest.approx(scene_frame(opaque).scale)


def all_rays_reach(views, centre):
    """The same of the rays through all pixels of the foreground."""
    found = []
    for index in range(len(views)):
        shown = views.image(index)[..., 3].flatten() > 0
        origins, directions = (part[shown].double() for part in views.image_rays(index))
        offset = centre - origins
        along = (offset * directions).sum(dim=-1, keepdim=True)
        found.append((offset - along * directions).norm(dim=-1))
    return float(torch.cat(found).max())


def test_rays_through_outlines_reach_as_far_as_all():
    ball = ball_views(8, 0.6, centre=swinging(0.5, 1), size=60)
    ring = ball.in_memory().clone()
    ring[:, 20:40, 25:35] = 0
    whole = torch.full_like(ring, 255)
    coefficients = torch.zeros(8, 12, dtype=torch.float64)
    for k1, model, tolerance in (
        (0.0, LensModel.PERSPECTIVE, 1e-6),
        (0.2, LensModel.PERSPECTIVE, 1e-3),
        (0.05, LensModel.FISHEYE, 1e-3),
    ):
        coefficients[:, 0] = k1
        kinds = torch.full((8,), int(model))
        lenses = Lenses(kinds, coefficients.clone(), torch.zeros(8, dtype=torch.float64))
        centres = torch.tensor([[27.0, 33.5]]).double().expand(8, 2)
        sizes = torch.tensor([[60, 60]] * 8)
        intrinsics = Intrinsics(torch.full((8, 2), 70.0).double(), centres, sizes, lenses)
        for images in (ball.in_memory(), ring, whole):
            views = replace(ball, images=images, intrinsics=intrinsics)
            centre = optical_centre(views)
            expected = all_rays_reach(views, centre)
            assert _reach(views, centre) == pytest.approx(expected, rel=tolerance)
            rays = [len(views.outline_rays(index)[0]) for index in range(8)]
            assert max(rays) <= 4 * 60 + 60
    # A camera that looks past the centre on both sides passes it at its own distance.
    beside = views_of(look_at(torch.tensor([[4.0, 0.0, 0.0]]), torch.tensor([4.0, 9.0, 0.0])))
    assert _reach(beside, torch.zeros(3)) == pytest.approx(4.0, rel=1e-5)


def test_a_small_thing_aside_widens_the_cube_and_a_stray_pixel_does_not():
    views = ball_views(12, 0.2, size=64, times=torch.zeros(12))
    images, usual = views.images.clone(), scene_frame(views).scale
    images[3, 4, 32, 3] = 255
    assert scene_frame(replace(views, images=images)).scale == usual
    images[3, 4:6, 32:34, 3] = 255
    assert scene_frame(replace(views, images=images)).scale < 0.4 * usual


CLUSTER = torch.tensor([0.2, -0.1, 0.3])


def points_of(count=400, half=(0.5, 0.3, 0.4), *, stray=200, seed=0):
    """Points spread over a box around `CLUSTER`, and stray ones on a far shell and nearby."""
    generator = torch.Generator().manual_seed(seed)
    box = CLUSTER + (2 * torch.rand(count, 3, generator=generator) - 1) * torch.tensor(half)
    far = torch.randn(stray, 3, generator=generator)
    return torch.cat([box, far / far.norm(dim=1, keepdim=True) * 7.0, torch.full((2, 3), math.nan)])


def ring(count=24, seed=0):
    """Opaque views from around, looking at `CLUSTER`."""
    angles = torch.arange(count) * (2 * math.pi / count)
    places = torch.stack([4 * angles.cos(), 4 * angles.sin(), 1 + 0.3 * angles.sin()], dim=1)
    poses = look_at(places + CLUSTER, CLUSTER)
    views = ball_views(count, 0.5, poses=poses, size=20)
    images = views.images.clone()
    images[..., 3] = 255
    return replace(views, images=images)


def share_inside(frame, points):
    return float((frame.points(points).abs().amax(dim=1) <= 1).float().mean())


def test_opaque_scenes_take_the_cube_of_the_points_in_the_middle():
    views, points = ring(), points_of()
    frame = scene_frame(views, CubeHints(points=points))
    assert frame.source == "points"
    # 96% of evenly spread points, with 15% of room.
    assert 1 / frame.scale == pytest.approx(1.15 * 0.96 * 0.5, rel=0.05)
    assert torch.allclose(frame.centre, CLUSTER, atol=0.04)
    assert share_inside(frame, points[:400]) > 0.95
    # Units and place of the world do not matter.
    shift = torch.tensor([50.0, -20.0, 5.0])
    poses = views.camera_to_world.clone()
    poses[:, :3, 3] = 10 * poses[:, :3, 3] + shift
    moved = scene_frame(
        replace(views, camera_to_world=poses), CubeHints(points=10 * points + shift)
    )
    assert moved.scale == pytest.approx(frame.scale / 10, rel=1e-3)
    # A half-side that is given keeps its size around the points.
    given = scene_frame(views, CubeHints(2.5, points=points))
    assert (given.scale, given.source) == (0.4, "data.half_side")
    assert torch.allclose(given.centre, CLUSTER, atol=0.04)


@pytest.mark.parametrize(
    ("source", "hints"),
    [
        ("data.centre and data.half_side", {"half_side": 2.5}),
        ("data.centre and points", {"points": points_of()}),
        ("data.centre and cameras", {}),
    ],
)
def test_a_centre_that_is_given_holds_for_every_size(source, hints):
    centre = [0.1, -0.2, 0.05]
    frame = scene_frame(ring(), CubeHints(centre=centre, **hints))
    assert frame.source == source
    assert frame.centre.tolist() == pytest.approx(centre)
    # Around another centre the cube must reach farther to hold the same points.
    if "points" in hints:
        assert share_inside(frame, points_of()[:400]) > 0.95


def test_silhouettes_come_before_points():
    views = ball_views(24, 0.5, poses=ring().camera_to_world, size=20)
    frame = scene_frame(views, CubeHints(points=points_of()))
    assert frame.source == "cameras and silhouettes"
    assert frame.scale == scene_frame(views).scale


@pytest.mark.parametrize(
    "points",
    [
        pytest.param(torch.zeros(0, 3), id="none"),
        pytest.param(torch.full((50, 3), math.nan), id="not finite"),
        pytest.param(points_of(20), id="too few"),
        pytest.param(CLUSTER.repeat(100, 1), id="all in one place"),
        pytest.param(points_of() + torch.tensor([0.0, 0.0, 40.0]), id="elsewhere"),
        pytest.param(0.1 * points_of(stray=0) + torch.tensor([0.5, 0.3, 0.2]), id="beside"),
    ],
)
def test_points_that_tell_nothing_leave_the_cameras_cube(points):
    frame = scene_frame(ring(), CubeHints(points=points))
    assert frame.source == "cameras"
    assert frame.scale == scene_frame(ring()).scale
