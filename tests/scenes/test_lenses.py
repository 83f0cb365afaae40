"""Lenses against formulas written a second time, and the bounds that stand on them."""

import math
from dataclasses import replace

import pytest
import torch

from tests.balls import inside_ball, surrounding
from tests.lens_oracle import pixel
from xplanes.scenes.batches import RayBatches
from xplanes.scenes.cameras import ball_extent, cast_rays, look_at, project
from xplanes.scenes.datamodule import UNIFORM
from xplanes.scenes.frame import cube_frame
from xplanes.scenes.lenses import COEFFICIENTS, WIDEST, Lenses, LensModel
from xplanes.scenes.silhouettes import may_hold
from xplanes.scenes.views import Intrinsics, Views

HEIGHT, WIDTH = 30, 44
FOCAL, CENTRE = (35.0, 37.0), (20.5, 16.25)
EYE = torch.eye(4, dtype=torch.float64)

LENSES = {
    "barrel": ("perspective", {"k1": -0.2, "k2": 0.03}),
    "pincushion": ("perspective", {"k1": 0.3, "k2": 0.1, "k3": 0.05}),
    "tangential": ("perspective", {"k1": -0.1, "p1": 0.02, "p2": -0.015}),
    "rational": ("perspective", {"k1": 0.9, "k2": 0.3, "k4": 1.0, "k5": 0.3, "k6": 0.02}),
    "polynomial": ("polynomial", {"k1": 0.1, "k2": -0.05, "k3": 0.04, "k4": 0.03, "p1": 0.01}),
    "prism": ("perspective", {"s1": 0.02, "s2": -0.01, "s3": -0.015, "s4": 0.01}),
    "equidistant": ("fisheye", {}),
    "fisheye": ("fisheye", {"k1": 0.05, "k2": -0.02, "k3": 0.004, "k4": -0.0005}),
    "thin prism fisheye": ("fisheye", {"k1": 0.03, "p1": 0.004, "p2": -0.003, "s1": 0.005}),
    "fov": ("fov", {"omega": 0.9}),
}


def lenses_of(*names, skew=0.0):
    """Lenses of the table above."""
    rows = [LENSES[name] for name in names]
    first = [dict(k) | ({"k1": k["omega"]} if "omega" in k else {}) for _, k in rows]
    return Lenses(
        torch.tensor([LensModel[model.upper()] for model, _ in rows]),
        torch.tensor(
            [[k.get(name, 0.0) for name in COEFFICIENTS] for k in first], dtype=torch.float64
        ),
        torch.full((len(rows),), skew, dtype=torch.float64),
    )


def intrinsics_of(*names, focal=FOCAL, skew=0.0, height=HEIGHT, width=WIDTH, centre=CENTRE):
    count = len(names)
    return Intrinsics(
        torch.tensor([focal] * count),
        torch.tensor([centre] * count),
        torch.tensor([[height, width]] * count),
        lenses_of(*names, skew=skew),
    )


def grid():
    rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return rows.flatten().double(), columns.flatten().double()


def cast(*names, rows, columns, pose=EYE, skew=0.0):
    count = len(names)
    return cast_rays(
        pose,
        rows,
        columns,
        focal=torch.tensor([FOCAL] * count, dtype=torch.float64).squeeze(0),
        centre=torch.tensor([CENTRE] * count, dtype=torch.float64).squeeze(0),
        lenses=lenses_of(*names, skew=skew),
    )


# Rays and pixels


@pytest.mark.parametrize("name", LENSES)
def test_points_on_rays_are_seen_at_their_pixels(name):
    model, k = LENSES[name]
    pose = look_at(torch.tensor([[1.0, -3.0, 2.0]], dtype=torch.float64))[0]
    rows, columns = grid()
    for skew in (0.0, 0.7):
        origins, directions = cast(name, rows=rows, columns=columns, pose=pose, skew=skew)
        assert directions.dtype == torch.float64
        torch.testing.assert_close(directions.norm(dim=1), torch.ones_like(rows))
        options = {"focal": torch.tensor(FOCAL), "centre": torch.tensor(CENTRE)}
        points = origins + torch.linspace(0.5, 9, len(rows))[:, None] * directions
        x, y, seen = project(pose, points, lenses=lenses_of(name, skew=skew), **options)
        assert seen.all()
        torch.testing.assert_close(x, columns + 0.5, atol=1e-9, rtol=0)
        torch.testing.assert_close(y, rows + 0.5, atol=1e-9, rtol=0)
        for point, *place in zip(points[::7], x[::7], y[::7], strict=True):
            local = (point - pose[:3, 3]) @ pose[:3, :3]
            expected = pixel(model, local.tolist(), k, FOCAL, CENTRE, skew)
            assert expected == pytest.approx(tuple(map(float, place)), abs=1e-9)


def test_lenses_of_one_batch_do_not_mix():
    names = [name for name in LENSES for _ in range(3)]
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(2, len(names), generator=generator, dtype=torch.float64)
    rows, columns = places[0] * HEIGHT, places[1] * WIDTH
    _, found = cast(*names, rows=rows, columns=columns)
    for index, name in enumerate(names):
        one = slice(index, index + 1)
        alone = cast(name, rows=rows[one], columns=columns[one])[1][0]
        torch.testing.assert_close(found[index], alone, atol=1e-12, rtol=0)


def test_intrinsics_keep_their_lenses():
    both = intrinsics_of("barrel", "fisheye")
    assert torch.equal(both.subset(torch.tensor([1])).lenses.model, torch.tensor([1]))
    assert not both.is_shared
    assert intrinsics_of("fov", "fov").is_shared
    three = Intrinsics.shared(30.0, HEIGHT, WIDTH, 1).joined(both)
    assert three.lenses.model.tolist() == [0, 0, 1]
    assert three.subset(torch.tensor([0])).lenses is None
    assert three.lenses.coefficients[1, 0] == -0.2
    with pytest.raises(ValueError, match=r"lenses\.coefficients"):
        Lenses(torch.zeros(2), torch.zeros(2, 8), torch.zeros(2))
    with pytest.raises(ValueError, match="2 images"):
        replace(both, lenses=lenses_of("fov"))


# What no ray belongs to


def test_limits_are_where_lenses_fold():
    barrel = Lenses(
        torch.zeros(1), torch.tensor([[-0.3] + [0.0] * 11], dtype=torch.float64), torch.zeros(1)
    )
    assert float(barrel.limit) == pytest.approx(math.sqrt(1 / 0.9), rel=1e-12)
    edge = float(barrel.limit) * 2 / 3
    x = torch.tensor([0.999 * edge, 1.001 * edge, 5.0])
    local, found = barrel.directions(x.double(), torch.zeros(3, dtype=torch.float64))
    assert found.tolist() == [True, False, False]
    assert local.isfinite().all()
    torch.testing.assert_close(local[1], local[2])  # the nearest there is
    assert float(-local[2, 0] / local[2, 2]) == pytest.approx(float(barrel.limit), rel=1e-6)


def test_fisheye_corners_have_no_rays_and_are_left_out():
    """An equidistant lens whose circle of 180 degrees all around is smaller than the image."""
    intrinsics = intrinsics_of("equidistant", "fov", focal=(6.0, 6.0), centre=(22.0, 15.0))
    rows, columns = grid()
    away = torch.hypot(columns + 0.5 - 22, rows + 0.5 - 15).view(HEIGHT, WIDTH) / 6
    assert torch.equal(intrinsics.has_ray(0), away <= math.pi)
    # Beyond pi / (2 omega) there is no direction; just before, it is aside by more than 89.9 deg.
    assert torch.equal(intrinsics.has_ray(1), away < math.pi / 2 / 0.9)
    images = torch.full((2, HEIGHT, WIDTH, 4), 255, dtype=torch.uint8)
    for index in (0, 1):
        images[index, ~intrinsics.has_ray(index)] = 0
    views = Views(images, surrounding(2, 3.0), torch.zeros(2), intrinsics, ("a", "b"))
    assert views.is_partial
    assert views.is_opaque
    assert torch.equal(views.valid()[0], intrinsics.has_ray(0))
    _, directions = views.image_rays(0)
    assert directions.norm(dim=1).sub(1).abs().max() < 1e-5
    batches = RayBatches(views, cube_frame(1.0, torch.zeros(3)), UNIFORM, seed=0)
    assert batches.near_pixels + batches.far_pixels == int(views.valid().sum())
    assert (batches.draw(0)["alpha"] == 1).all()
    # Whole images have all their rays.
    assert intrinsics_of("equidistant").has_ray(0) is None
    assert intrinsics_of("fisheye", focal=(20.0, 20.0)).has_ray(0) is None


# What assumed a pinhole


def seen_ball(names, poses, radius, **options):
    """Views of a ball through lenses, by their own rays."""
    intrinsics = intrinsics_of(*names, **options)
    height, width = intrinsics.size[0].tolist()
    blank = torch.zeros(len(names), height, width, 4, dtype=torch.uint8)
    files = tuple(f"{index}.png" for index in range(len(names)))
    views = Views(blank, poses, torch.zeros(len(names)), intrinsics, files)
    for index in range(len(names)):
        origins, directions = (part.double() for part in views.image_rays(index))
        along = -(origins * directions).sum(dim=1)
        hit = (origins + along[:, None] * directions).norm(dim=1) < radius
        views.images[index].view(-1, 4)[hit & (along > 0)] = 255
    return views


@pytest.mark.parametrize("name", LENSES)
def test_balls_reach_no_farther_than_said(name):
    intrinsics = intrinsics_of(name, skew=1.0, focal=(20.0, 22.0))
    focal, centre, lens = intrinsics.focal[0], intrinsics.centre[0], intrinsics.lens(0)
    sight = intrinsics.sights[0]
    generator = torch.Generator().manual_seed(1)
    middle = 2 * torch.randn(400, 3, generator=generator, dtype=torch.float64)
    middle[:40, :2] *= 0.05  # near the axis, before and behind the camera

    def seen_at(points):
        x, y, seen = project(EYE, points, focal=focal, centre=centre, lenses=lens)
        return x, y, seen & (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)

    x, y, inside = seen_at(middle)
    for radius in (0.02, 0.4):
        extent = ball_extent(EYE, middle, radius, focal=focal, lenses=lens, stretch=sight.stretch)
        seen = inside & extent.isfinite()
        assert seen.sum() > 20
        largest = torch.zeros(400, dtype=torch.float64)
        for _ in range(30):
            edge = torch.randn(400, 3, generator=generator, dtype=torch.float64)
            there_x, there_y, shown = seen_at(middle + radius * edge / edge.norm(dim=1)[:, None])
            moved = torch.maximum((there_x - x).abs(), (there_y - y).abs())
            largest = torch.where(shown, torch.maximum(largest, moved), largest)
        assert (largest[seen] <= extent[seen]).all()
        assert float((extent[seen] / largest[seen].clamp(min=1e-3)).median()) < 4


@pytest.mark.parametrize("name", LENSES)
def test_silhouettes_never_rule_out_what_is_there(name):
    views = seen_ball([name] * 6, surrounding(6, 3.0), 0.5)
    points = inside_ball(3000, 0.5)
    assert may_hold(views, points, radius=0.01).all()
    around = inside_ball(3000, 1.2, seed=1)
    around = around[around.norm(dim=1) > 0.75]
    assert may_hold(views, around, radius=0.01).all(dim=0).float().mean() < 0.01


def test_fisheye_lenses_see_beside_and_behind_themselves():
    """Cameras inside a scene, with the ball far from their axes."""
    place = torch.tensor([[0.0, -2.0, 0.0]])
    for target in ([2.0, -2.0, 0.0], [0.5, -5.0, 0.3]):  # 90 degrees aside; behind
        pose = look_at(place, torch.tensor([target]))
        views = seen_ball(
            ["equidistant"], pose, 0.5, focal=(9.0, 9.0), height=60, width=60, centre=(30.0, 30.0)
        )
        assert (views.images[..., 3] > 0).any()
        assert may_hold(views, inside_ball(2000, 0.5), radius=0.02).all()
        empty = inside_ball(2000, 0.3) + torch.tensor([0.0, 0.0, 1.5])
        assert not may_hold(views, empty, radius=0.02).any()


def test_pinholes_that_stand_for_lenses_see_as_wide():
    barrel, fisheye = (
        intrinsics_of(name, focal=(35.0, 35.0), centre=(22.0, 15.0))
        for name in ("barrel", "equidistant")
    )
    lens = {"focal": barrel.focal[0], "centre": barrel.centre[0], "lenses": barrel.lenses}
    ends = torch.tensor([-0.5, WIDTH - 0.5])
    _, (left, right) = cast_rays(EYE, torch.full((2,), HEIGHT / 2 - 0.5), ends, **lens)
    for intrinsics, angle in ((barrel, math.acos(float(left @ right))), (fisheye, 44 / 35)):
        focal = float(intrinsics.pinhole[0, 0])
        assert 2 * math.atan(22 / focal) == pytest.approx(angle, abs=1e-5)
    wide = intrinsics_of("equidistant", focal=(9.0, 9.0))
    assert wide.fov_y == pytest.approx(WIDEST)
