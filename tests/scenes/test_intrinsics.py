"""Images of different cameras and sizes: rays, padding, and files that tell of them."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from tests.balls import RAYS as WHITE
from tests.balls import ball_views, inside_ball, surrounding
from tests.lens_oracle import pixel
from tests.scenes.common import (
    ANGLE,
    SceneFolder,
    assert_same_rays,
    refused,
    rgba,
    same,
    told,
)
from xplanes.baselines.tineuvox.model import frusta_box
from xplanes.preparation.fixed_view import check_camera
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.pruning import carve, fill
from xplanes.scenes.batches import RayBatches
from xplanes.scenes.cameras import focal_length
from xplanes.scenes.frame import cube_frame, scene_frame
from xplanes.scenes.lenses import Lenses
from xplanes.scenes.silhouettes import foreground, may_hold
from xplanes.scenes.source import frames_are_equal
from xplanes.scenes.views import Intrinsics, Views, joined

RADIUS = 0.5
# Height, width, focal lengths along x and y, principal point from the left and from the top.
WIDE = (30, 44, 41.0, 36.5, 25.25, 13.5)
UPRIGHT = (38, 26, 55.0, 58.0, 12.0, 21.75)


def rays_of(pose, height, width, focal_x, focal_y, centre_x, centre_y):
    """Independent reference: one ray per pixel, row by row. float64 [h w, 3], [h w, 3]"""
    pose = np.asarray(pose, dtype=np.float64)
    row, column = np.mgrid[:height, :width].reshape(2, -1, 1) + 0.5
    right, down = (column - centre_x) / focal_x, (row - centre_y) / focal_y
    world = right * pose[:3, 0] - down * pose[:3, 1] - pose[:3, 2]
    return np.tile(pose[:3, 3], (height * width, 1)), world / np.linalg.norm(world, axis=1)[:, None]


def rendered(cameras, poses, times=None):
    """A ball before cameras of which each has its own size and intrinsics."""
    images = []
    for (height, width, *lens), pose in zip(cameras, poses, strict=True):
        origins, directions = rays_of(pose, height, width, *lens)
        along = (origins * directions).sum(axis=1)
        image = np.zeros((height * width, 4), np.uint8)
        image[(origins**2).sum(axis=1) - along**2 < RADIUS**2] = [200, 100, 50, 255]
        images.append(torch.from_numpy(image.reshape(height, width, 4)))
    known = torch.tensor(cameras, dtype=torch.float64)
    whole = torch.zeros(len(poses), *known[:, :2].long().amax(dim=0), 4, dtype=torch.uint8)
    for place, image in zip(whole, images, strict=True):
        place[: image.shape[0], : image.shape[1]] = image
    return Views(
        whole,
        poses,
        torch.linspace(0, 1, len(poses)) if times is None else times,
        Intrinsics(known[:, 2:4], known[:, 4:], known[:, :2].long()),
        tuple(f"{number:03d}.png" for number in range(len(poses))),
    )


def mixed(count=8, **options):
    """Views of two cameras in turn."""
    return rendered(
        [(WIDE, UPRIGHT)[i % 2] for i in range(count)], surrounding(count, 4.0), **options
    )


RAYS = replace(WHITE, per_batch=500, background="random")
FRAME = cube_frame(1.4, torch.zeros(3))


# What views are


def test_a_number_stands_for_centred_images_of_one_camera():
    views = ball_views(3, RADIUS, size=20, angle=0.7)
    focal = focal_length(0.7, 20)
    assert views.intrinsics.focal.tolist() == [[focal, focal]] * 3
    assert views.intrinsics.centre.tolist() == [[10, 10]] * 3
    assert views.intrinsics.size.tolist() == [[20, 20]] * 3
    assert views.intrinsics.is_shared
    assert not views.is_padded
    assert views.outline == "20x20 px"
    cut = replace(views, images=views.images[:, 5:12], intrinsics=focal)
    assert cut.intrinsics.centre.tolist() == [[10, 3.5]] * 3
    assert cut.size(1) == (7, 20)


def test_sizes_that_are_not_those_of_the_images_are_refused():
    views = mixed(4)
    for images in (views.images[:, 1:], views.images[:3], torch.zeros(4, 40, 60, 4)):
        with pytest.raises(ValueError, match="does not fit"):
            replace(views, images=images)
    with pytest.raises(ValueError, match=r"intrinsics\.focal"):
        Intrinsics(torch.ones(3, 2), torch.ones(4, 2), torch.ones(4, 2))


def test_an_image_has_its_own_size():
    views = mixed(4)
    assert views.images.shape == (4, 38, 44, 4)
    assert (views.height, views.width) == (38, 44)
    assert [views.size(i) for i in range(4)] == [(30, 44), (38, 26)] * 2
    assert views.pixels == 2 * 30 * 44 + 2 * 38 * 26 == int(views.valid().sum())
    assert views.outline == "up to 44x38 px"
    assert not views.intrinsics.is_shared
    for index, (height, width, *_) in enumerate([WIDE, UPRIGHT] * 2):
        assert views.image(index).shape == (height, width, 4)
        assert views.composite(index, torch.ones(3)).shape == (height, width, 3)
        assert len(views.image_rays(index)[0]) == height * width
        assert views.valid()[index, :height, :width].all()
    # Views that are taken out lose the padding that they need no more.
    upright = views.subset(torch.tensor([3, 1]))
    assert upright.images.shape == (2, 38, 26, 4)
    assert not upright.is_padded
    assert upright.intrinsics.is_shared
    assert torch.equal(upright.images[1], views.image(1))
    both = views.subset(torch.tensor([1, 2]))
    assert both.images.shape == (2, 38, 44, 4)
    assert torch.equal(both.image(1), views.image(2))


def test_views_of_different_cameras_are_joined():
    views, square = mixed(4), ball_views(3, RADIUS, size=40, angle=0.9, seed=1)
    both = joined(views, square)
    assert both.images.shape == (7, 40, 44, 4)
    assert both.files == views.files + square.files
    for index in range(7):
        part, own = (views, index) if index < 4 else (square, index - 4)
        assert torch.equal(both.image(index), part.image(own)), index
        assert both.times[index] == part.times[own]
        assert_same_rays(both, index, part, own, atol=0)
    assert not both.images[~both.valid()].any()
    assert both.foreground is None
    shown = torch.full(square.images.shape[:3], 255, dtype=torch.uint8)
    both = joined(views, replace(square, foreground=shown))
    assert torch.equal(both.foreground != 0, both.valid() & (torch.arange(7) >= 4)[:, None, None])


def test_one_camera_is_one_within_rounding():
    shared = Intrinsics.shared(30.0, 20, 40, 3)
    assert replace(shared, focal=shared.focal * torch.tensor([[1], [1 + 1e-6], [1]])).is_shared
    for name, change in (("focal", 0.5), ("centre", 0.5), ("size", 1)):
        for column in (0, 1):
            value = getattr(shared, name).clone()
            value[1, column] += change
            assert not replace(shared, **{name: value}).is_shared, (name, column)


# Rays


def test_rays_are_those_of_the_formula():
    views = mixed(4)
    for index, camera in enumerate([WIDE, UPRIGHT] * 2):
        origins, directions = rays_of(views.camera_to_world[index], *camera)
        found = views.image_rays(index)
        assert [part.dtype for part in found] == [torch.float32] * 2
        assert np.abs(found[0].numpy() - origins).max() < 1e-6
        assert np.abs(found[1].numpy() - directions).max() < 1e-6, index


def test_images_of_nothing_but_padding_and_content_have_no_background():
    views = mixed(6)
    images = views.images.clone()
    images[views.valid()] = 255
    assert RayBatches(replace(views, images=images), FRAME, RAYS, seed=0).far_pixels == 0


# What is seen in them


def test_padding_is_nothing_whatever_it_holds():
    views = mixed(8, times=torch.zeros(8))
    images = views.images.clone()
    images[~views.valid()] = 255
    dirty = replace(views, images=images)
    points = inside_ball(2000, 2.0)
    assert torch.equal(may_hold(dirty, points, radius=0.05), may_hold(views, points, radius=0.05))
    near = foreground(dirty, [3] * 8)
    assert torch.equal(near, foreground(views, [3] * 8))
    assert not near[~views.valid()].any()
    assert scene_frame(dirty).scale == scene_frame(views).scale
    assert torch.equal(frusta_box(dirty, 2, 6, 1.0), frusta_box(views, 2, 6, 1.0))
    grids = [OccupancyGrid(8, 1, step=0.05) for _ in range(2)]
    for grid, those in zip(grids, (views, dirty), strict=True):
        carve(grid, those, FRAME)
        options = {"step": 0.05, "generator": torch.Generator().manual_seed(0)}
        fill(grid, lambda points, _: (points, 0 * points[:, 0]), those, FRAME, **options)
    assert 0 < grids[0].occupied.float().mean() < 1
    assert torch.equal(grids[0].occupied, grids[1].occupied)
    assert same(*(RayBatches(those, FRAME, RAYS, seed=0).draw(3) for those in (views, dirty)))


def test_cameras_together_see_what_each_sees():
    views = mixed(6)
    points = inside_ball(500, 2.5)
    alone = [may_hold(views.subset(torch.tensor([i])), points, radius=0.03) for i in range(6)]
    assert torch.equal(may_hold(views, points, radius=0.03), torch.cat(alone))
    held = may_hold(views, points, radius=0.0)
    for index, (height, width, *lens) in enumerate([WIDE, UPRIGHT] * 3):
        pose = views.camera_to_world[index].double()
        local = ((points - pose[:3, 3]) @ pose[:3, :3]).tolist()
        for point, there in zip(local, held[index].tolist(), strict=True):
            column, row = pixel("perspective", point, {}, lens[:2], lens[2:])
            if min(abs(row - round(row)), abs(column - round(column))) < 1e-3:
                continue
            seen = 0 <= row < height and 0 <= column < width
            shown = seen and bool(views.image(index)[int(row), int(column), 3])
            assert there == (shown or not seen), (index, point)


def test_frames_with_different_intrinsics_are_not_static():
    views = rendered([WIDE] * 3, surrounding(1, 4.0).repeat(3, 1, 1))
    assert frames_are_equal(views)
    focal = views.intrinsics.focal.clone()
    focal[2] *= 1.02
    assert not frames_are_equal(replace(views, intrinsics=replace(views.intrinsics, focal=focal)))


# Pictures of them


def test_a_video_that_models_cannot_take_is_refused():
    square = Intrinsics.shared(30.0, 20, 40, 3)
    poses = surrounding(1, 4.0).repeat(3, 1, 1)
    video = rendered([(20, 40, 30.0, 30.0, 20.0, 10.0)] * 3, poses)
    check_camera(video)

    def changed(name, column, change, index=slice(None)):
        value = getattr(square, name).clone()
        value[index, column] += change
        return replace(video, intrinsics=replace(square, **{name: value}))

    for name, column, change, words in (
        ("focal", 0, 0.33, r"30\.33 and 30 pixels along x and y.*expect square pixels"),
        ("focal", 1, -0.33, r"30 and 29\.67 pixels"),
        ("centre", 0, 0.88, r"principal point is at 20\.88, 10 of 40x20 pixels.*at the centre"),
        ("centre", 1, -0.88, r"principal point is at 20, 9\.12"),
    ):
        check_camera(changed(name, column, 0.82 * change))
        check = partial(check_camera, changed(name, column, change))
        refused(check, rf"(?s){words}.*preparation\.fixed_view=train")
    refused(partial(check_camera, changed("focal", 0, 1, 1)), "differ in focal length")
    for strength, words in ((-0.2, r"distorts.*preparation\.fixed_view=train"), (-0.004, None)):
        k1 = torch.tensor([[strength] + [0.0] * 11] * 3, dtype=torch.float64)
        lenses = Lenses(torch.zeros(3), k1, torch.zeros(3))
        check = partial(check_camera, replace(video, intrinsics=replace(square, lenses=lenses)))
        refused(check, words) if words else check()


# Files


def test_a_scene_that_tells_every_frames_camera_equals_one_that_tells_an_angle(tmp_path):
    focal = focal_length(ANGLE, 12)
    keys = {"fl_x": focal, "fl_y": focal, "cx": 6.0, "cy": 6.0, "w": 12, "h": 12}
    folders = {
        "frames": {"shared": {}, "frames": [keys] * 4},
        "file": {"shared": keys},
        "both": {"frames": [keys] * 4},
        "focal length": {"shared": {"fl_x": focal}},
        "other size": {"shared": {key: 10 * value for key, value in keys.items()}},
        "one side": {"shared": {"fl_x": 5 * focal, "h": 60, "cx": 30}},
    }
    plain = SceneFolder(tmp_path / "plain").add("train", 4)
    told = {
        name: SceneFolder(tmp_path / name).add("train", 4, **how) for name, how in folders.items()
    }
    for resolution in (None, 5):
        expected = plain.train(resolution=resolution)
        for name, folder in told.items():
            found = folder.train(resolution=resolution)
            assert torch.equal(found.images, expected.images), name
            for part in ("focal", "centre", "size"):
                mine, theirs = (getattr(v.intrinsics, part) for v in (found, expected))
                assert torch.allclose(mine.double(), theirs.double(), rtol=1e-12, atol=0), name
            for index in range(4):
                assert_same_rays(found, index, expected, index, atol=1e-6)


WHOLE = {"camera_angle_x": ANGLE, "fl_x": 30.0, "fl_y": 33.0, "cx": 6.5}
BOTH = {"fl_x": 30.0, "fl_y": 33.0}
FLAT = focal_length(0.5, 18)


@pytest.mark.parametrize(
    ("shared", "frame", "focal", "centre", "words"),
    [
        (WHOLE, {}, [30, 33], [6.5, 9], "fl_x=30 is used"),
        # As in instant-ngp, whose pixels are then square.
        (WHOLE, {"fl_x": 20.0}, [20, 20], [6.5, 9], None),
        (WHOLE, {"fl_x": 20.0, "fl_y": 22.0, "cx": 5.0, "cy": 7.5}, [20, 22], [5, 7.5], None),
        (WHOLE, {"camera_angle_x": 0.5}, [focal_length(0.5, 12)] * 2, [6.5, 9], None),
        (WHOLE, {"w": 24, "h": 36}, [15, 16.5], [3.25, 9], "fl_x=30 is used"),
        ({"fl_y": 33.0}, {"fl_x": 20.0}, [20, 33], [6, 9], None),
        ({"fl_x": 30.0, "camera_angle_y": 0.5}, {"fl_x": 20.0}, [20, 20], [6, 9], None),
        ({**BOTH, "camera_angle_y": 0.5}, {"fl_x": 20.0}, [20, 20], [6, 9], None),
        (BOTH, {"fl_x": 20.0, "camera_angle_y": 0.5}, [20, FLAT], [6, 9], "are not square"),
    ],
)
def test_a_frames_own_keys_go_before_the_files(tmp_path, shared, frame, focal, centre, words):
    shared = {"w": 12, "h": 18, **shared}
    scene = SceneFolder(tmp_path).add("train", [(12, 18)], shared=shared, frames=[frame])
    with told(words):
        found = scene.train().intrinsics
    assert found.focal[0].tolist() == pytest.approx(focal)
    assert found.centre[0].tolist() == centre


def test_images_of_different_sizes_are_read(tmp_path):
    sizes = [(12, 12), (8, 8), (12, 12), (20, 20)]
    scene = SceneFolder(tmp_path).add("train", sizes)
    views = scene.train()
    assert views.images.shape == (4, 20, 20, 4)
    assert [views.size(i) for i in range(4)] == sizes
    assert not views.images[~views.valid()].any()
    for index, (width, _) in enumerate(sizes):
        focal = focal_length(ANGLE, width)
        assert views.intrinsics.focal[index].tolist() == pytest.approx([focal] * 2)
        assert np.array_equal(views.image(index)[..., 3], rgba(index, width)[..., 3]), index
    assert scene.train(resolution=4).intrinsics.is_shared


def test_intrinsics_shrink_with_images_of_different_sizes(tmp_path):
    frames = [
        {"fl_x": 15.0, "fl_y": 14.0, "cx": 5.0, "cy": 7.0, "w": 12, "h": 12},
        {"fl_x": 30.0, "cx": 8.0, "w": 16, "h": 16},  # of a file half that size
        {"fl_x": 25.0, "fl_y": 20.0, "cy": 11.0},
    ]
    sizes = [(12, 12), (8, 8), (20, 20)]
    scene = SceneFolder(tmp_path).add("train", sizes, shared={}, frames=frames)
    found = scene.train(resolution=4).intrinsics
    focal, centre = [[5, 14 / 3], [7.5, 7.5], [5, 4]], [[5 / 3, 7 / 3], [2, 2], [2, 2.2]]
    torch.testing.assert_close(found.focal, torch.tensor(focal).double())
    torch.testing.assert_close(found.centre, torch.tensor(centre).double())
