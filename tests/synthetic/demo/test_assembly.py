"""Assemblies: joints, casting, colours, light and the named scenes."""

from dataclasses import replace
from functools import partial
from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.refusals import assert_refused
from tests.synthetic.rays import float_rays, rays
from xplanes.scenes.cameras import focal_length
from xplanes.synthetic.demo.assembly import Assembly, Joint, Part
from xplanes.synthetic.demo.geometry import (
    Box,
    Capsule,
    Checker,
    Cylinder,
    Ellipsoid,
    Plain,
    Sectors,
    Stripes,
    Torus,
    rgb,
)
from xplanes.synthetic.demo.motions import Bounce, Keys, Steady, Swing
from xplanes.synthetic.demo.render import CAMERA_ANGLE_X, camera_at, render_image
from xplanes.synthetic.demo.scenes import DEMO_SCENES, build_demo_scene
from xplanes.synthetic.demo.shading import Light

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def small_assembly(light=None):
    parts = (
        Part(Box((0.5, 0.4, 0.1)), Checker((RED, BLUE), (0.2, 0.2, 0.2))),
        Part(Torus(0.3, 0.1), Plain(RED), "arm", (0.2, 0.0, 0.3), (30, 40, 50)),
        Part(Capsule(0.1, 0.3), Plain(BLUE), "arm", (0.0, 0.1, 0.2), (80, 0, 10)),
        Part(Ellipsoid((0.1, 0.2, 0.3)), Plain(RED), "hand", (0.3, 0.0, 0.0)),
        Part(Cylinder(0.2, 0.1), Stripes((RED, BLUE), 2, 0.1), "hand"),
    )
    joints = (
        Joint("arm", "world", (0.0, 0.0, 0.2), (10, 0, 0), "hinge", (0, 1, 0), Swing(0, 40, 1)),
        Joint("hand", "arm", (0.4, 0.0, 0.0), kind="slide", axis=(1, 0, 0), motion=Steady(0, 0.3)),
    )
    return Assembly(parts, joints, light)


def test_cast_equals_the_nearest_of_all_parts():
    posed = small_assembly().pose(0.3)
    origins, directions = float_rays(4000)
    hits = posed.cast(origins, directions)
    each = torch.stack([part.hit(origins, directions) for part in posed.parts])
    distance, number = each.min(dim=0)
    assert torch.equal(hits.distance.isfinite(), distance.isfinite())
    found = distance.isfinite()
    assert torch.allclose(hits.distance[found], distance[found], atol=1e-5)
    assert torch.equal(hits.part[found], number[found])
    assert (hits.part[~found] == -1).all()
    assert (hits.colour[~found] == 0).all()
    assert torch.allclose(hits.normal[found].norm(dim=-1), torch.ones(int(found.sum())), atol=1e-5)
    inside = (hits.normal * directions).sum(dim=-1)[found]
    assert (inside < 1e-3).all()


def test_hits_bound_the_inside():
    posed = small_assembly().pose(0.6)
    origins, directions = float_rays(3000, seed=1)
    distance = posed.cast(origins, directions).distance
    found = distance.isfinite()
    beyond = origins + (distance + 1e-3)[:, None] * directions
    before = origins + (distance - 1e-3)[:, None] * directions
    assert not posed.inside(before[found]).any()
    assert posed.inside(beyond[found]).float().mean() > 0.97


@settings(max_examples=25, deadline=None)
@given(
    angles=st.tuples(*[st.floats(-180, 180)] * 3),
    shift=st.tuples(*[st.floats(-1, 1)] * 3),
    time=st.floats(0, 1),
)
def test_moving_scene_and_rays_together_changes_nothing(angles, shift, time):
    resting = small_assembly()
    moved = resting.placed(shift, angles)
    frame = Assembly((Part(Box((1, 1, 1)), Plain(RED)),)).placed(shift, angles)
    pose = frame.pose(0, torch.float64).parts[0]
    origins, directions = rays(200, seed=3)
    here = resting.pose(time, torch.float64).cast(origins, directions)
    there = moved.pose(time, torch.float64).cast(
        origins @ pose.rotation.T + pose.translation, directions @ pose.rotation.T
    )
    found = here.distance.isfinite()
    assert torch.equal(found, there.distance.isfinite())
    assert torch.allclose(here.distance[found], there.distance[found], atol=1e-9)
    assert torch.allclose(here.normal @ pose.rotation.T, there.normal, atol=1e-7)
    assert torch.equal(here.part, there.part)


def test_hinge_and_slide_move_as_named_and_angles_turn_about_x_then_y_then_z():
    parts = (Part(Box((0.1, 0.1, 0.1)), Plain(RED), "slide", (1.0, 0.0, 0.0)),)
    joints = (
        Joint("hinge", kind="hinge", axis=(0, 0, 2), motion=Steady(0, 90)),
        Joint("slide", "hinge", (0, 0, 1), kind="slide", axis=(0, 0, 1), motion=Steady(0, 0.5)),
    )
    place = Assembly(parts, joints).pose(1.0).parts[0].translation
    assert torch.allclose(place, torch.tensor([0.0, 1.0, 1.5]), atol=1e-6)
    part = Part(Box((1, 1, 1)), Plain(RED), rotation=(90, 0, 90))
    rotation = Assembly((part,)).pose(0).parts[0].rotation
    # About x the z axis goes to -y, then about z to +x.
    assert torch.allclose(rotation[:, 2], torch.tensor([1.0, 0.0, 0.0]), atol=1e-6)


def test_broken_trees_are_refused():
    for joints, on, message in (
        ((Joint("a", "b"),), "world", "no joint 'b'"),
        ((Joint("a"), Joint("a")), "world", "two joints"),
        ((Joint("a", kind="hinge"),), "world", "need a motion"),
        ((Joint("a", motion=Steady(0, 1)),), "world", "need a motion"),
        ((), "leg", "no joint 'leg'"),
    ):
        call = partial(Assembly, (Part(Box((1, 1, 1)), Plain(RED), on),), joints)
        assert_refused(ValueError, message, call, joints)


def test_keys_hold_their_ends_and_bounce_stays_above_ground():
    keys = Keys((0.2, 0.8), (1.0, 3.0))
    assert [keys.at(t) for t in (0, 0.2, 0.5, 0.8, 1)] == pytest.approx([1, 1, 2, 3, 3])
    heights = [Bounce(0.8, 3, 0.2).at(i / 500) for i in range(501)]
    assert min(heights) >= 0
    assert max(heights) == pytest.approx(0.8, rel=1e-3)


def test_surfaces_colour_as_described():
    points = torch.tensor([[0.05, 0.0, 0.0], [0.15, 0.0, 0.0], [-0.05, 0.0, 0.0]])
    assert Stripes((RED, BLUE), 0, 0.1).colour(points).tolist() == [[1, 0, 0], [0, 0, 1], [0, 0, 1]]
    around = torch.tensor([[1.0, 0.1, 0.0], [-0.1, 1.0, 0.0], [-1.0, -0.1, 0.0]])
    halves = Sectors((RED, BLUE), 2).colour(around)
    assert halves[0].tolist() == halves[1].tolist() != halves[2].tolist()
    assert rgb("#ff0080") == (1.0, 0.0, 128 / 255)


def test_light_is_lambert_with_shadows():
    light = Light(towards=(0, 0, 1), sun=0.5, sky=0.0, ambient=0.2, shadow=1.0)
    floor = Part(Box((1, 1, 0.1)), Plain((1, 1, 1)), position=(0, 0, -0.1))
    ball = Part(Ellipsoid((0.3, 0.3, 0.3)), Plain((1, 1, 1)), position=(0, 0, 0.5))
    # The first ray lands on the floor under the ball, the second far beside it.
    origins = torch.tensor([[-0.95, 0.0, 0.1], [0.9, 0.0, 1.0]])
    directions = torch.tensor([[0.95, 0.0, -0.1], [0.0, 0.0, -1.0]])
    directions = directions / directions.norm(dim=-1, keepdim=True)
    lit = Assembly((floor,), light=light).pose(0).cast(origins, directions)
    assert torch.allclose(lit.colour, torch.full((2, 3), 0.7), atol=1e-5)
    shaded = Assembly((floor, ball), light=light).pose(0).cast(origins, directions)
    assert shaded.part.tolist() == [0, 0]
    expected = torch.tensor([0.2, 0.7])[:, None].expand(2, 3)
    assert torch.allclose(shaded.colour, expected, atol=1e-5)


def test_a_point_lands_in_its_pixel():
    for azimuth, elevation in ((-60, 20), (35, 80), (180, 5)):
        point = torch.tensor([0.4, -0.3, 0.5], dtype=torch.float64)
        dot = Part(Ellipsoid((0.03, 0.03, 0.03)), Plain(RED), position=tuple(point.tolist()))
        camera = camera_at(azimuth, elevation)
        picture = render_image(Assembly((dot,)).pose(0), camera, 64)
        x, y, z = (camera.inverse() @ torch.cat([point, point.new_ones(1)]))[:3].tolist()
        focal = focal_length(CAMERA_ANGLE_X, 64)
        column, row = 32 + focal * x / -z, 32 - focal * y / -z
        alpha = torch.from_numpy(picture[..., 3]).double()
        grid = torch.arange(64, dtype=torch.float64) + 0.5
        centre = [(alpha.sum(dim=axis) @ grid / alpha.sum()).item() for axis in (0, 1)]
        assert centre == pytest.approx([column, row], abs=0.15), (azimuth, elevation)


def test_scenes_stay_in_their_box_and_ball():
    origins, directions = float_rays(600, seed=5)
    for name, seed in product(DEMO_SCENES, (0, 4)):
        assembly = replace(build_demo_scene(name, seed), light=None)
        for time in torch.linspace(0, 1, 9).tolist():
            case = f"{name}, seed {seed}, time {time}"
            posed = assembly.pose(time)
            low, high = posed.bounds()
            assert low.min() >= -1.3, case
            assert high.max() <= 1.3, case
            hits = posed.cast(origins, directions)
            found = hits.distance.isfinite()
            points = (origins + hits.distance[:, None] * directions)[found]
            assert points.norm(dim=-1).max() <= 1.3, case
            assert (points >= low - 1e-4).all(), case
            assert (points <= high + 1e-4).all(), case


def test_all_scenes_but_one_move_smoothly_and_colours_follow_the_seed():
    camera = camera_at(-50, 25)
    for name in DEMO_SCENES:
        assembly = build_demo_scene(name)
        first, later = (render_image(assembly.pose(time), camera, 32) for time in (0.0, 0.37))
        assert (first == later).all() == (name == "still_life"), name
        poses = [assembly.pose(i / 50) for i in range(51)]
        places = torch.stack([torch.stack([p.translation for p in pose.parts]) for pose in poses])
        assert places.diff(dim=0).norm(dim=-1).max() < 0.15, name
        assert build_demo_scene(name, 1) != assembly, name
        assert build_demo_scene(name, 1) == build_demo_scene(name, 1), name


def test_an_unknown_scene_is_named_with_its_neighbours():
    call = partial(build_demo_scene, "excavater")
    message = assert_refused(ValueError, r"Did you mean excavator\?", call, "excavater")
    assert all(name in message for name in DEMO_SCENES)
