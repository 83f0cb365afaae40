"""The reader of COLMAP's captures.

tests/data/colmap holds a model that pycolmap 4.2.1 wrote, and rays that it cast, one image for each
camera model.
"""

import json
import logging
import math
import shutil
import struct
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.captures import HEIGHT, WIDTH, picture, poses, save, settings, write_colmap
from tests.lens_oracle import direction
from tests.refusals import assert_refused
from xplanes.components import build
from xplanes.config import compose_plain
from xplanes.errors import ConfigError, MissingSplitError, SceneError
from xplanes.scenes.cameras import cast_rays
from xplanes.scenes.colmap import ColmapSettings
from xplanes.scenes.colmap_model import LENSES, read_model
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.entries import require_precision
from xplanes.scenes.lenses import COEFFICIENTS, Lenses
from xplanes.scenes.source import SceneSettings

PYCOLMAP = Path(__file__).parents[1] / "data" / "colmap"
OPENCV = (36.0, 34.0, 20.5, 14.25, -0.11, 0.03, 0.004, -0.003)
CAMERA = {1: ("OPENCV", WIDTH, HEIGHT, OPENCV)}
POINTS = [[0.1, 0.2, 0.3], [-0.4, 0.5, 0.6]]


class Capture:
    """A capture of eight images that can be changed before it is read."""

    def __init__(self, path, names=None):
        self.path = path
        self.names = names or [f"frame_{i:03d}.png" for i in range(8)]
        self.poses = poses(len(self.names))
        for index, name in enumerate(self.names):
            save(path / "images" / name, picture(index))
        self.write()

    def write(self, cameras=CAMERA, camera=1, keep=None, text=False):
        images = [
            (name, pose, camera, index % 3)
            for index, (name, pose) in enumerate(zip(self.names, self.poses, strict=True))
            if keep is None or index in keep
        ]
        write_colmap(self.path / "sparse" / "0", cameras, images, POINTS, text=text)

    def settings(self, **changes):
        return settings(ColmapSettings, "colmap", self.path, **{"orient": False, **changes})

    def read(self, *splits, **changes):
        return self.settings(**changes).load(splits or ("train", "val"))

    def views(self, **changes):
        """All views as one split, in the order of their names."""
        return self.read("train", eval_every=100, **changes).splits["train"]

    def refused(self, words, **changes):
        call = partial(self.read, "train", **changes)
        return assert_refused(SceneError, words, call, (words, changes))


@pytest.fixture
def capture(tmp_path):
    return Capture(tmp_path / "room")


# Models


def rays(model, index, rows, columns):
    """Rays of an image of a model, in double precision."""
    camera = model.calibrations[index]
    size = (int(camera.h), int(camera.w))
    focal, centre, skew = camera.scaled(size, size)
    row = torch.zeros(1, len(COEFFICIENTS), dtype=torch.float64)
    row[0, : len(camera.distortion)] = torch.tensor(camera.distortion, dtype=torch.float64)
    lens = Lenses(torch.tensor([int(camera.model)]), row, torch.tensor([skew]))
    return cast_rays(
        torch.from_numpy(model.camera_to_world[index]),
        torch.tensor(rows, dtype=torch.float64),
        torch.tensor(columns, dtype=torch.float64),
        focal=focal,
        centre=centre,
        lenses=lens,
    )


def test_pycolmaps_rays_through_every_camera_model():
    model = read_model(PYCOLMAP)
    expected = json.loads((PYCOLMAP / "expected.json").read_text())
    assert model.names == tuple(expected["images"])
    assert {image["model"] for image in expected["images"].values()} == set(LENSES)
    assert model.points is not None
    assert np.abs(model.points - expected["points"]).max() == 0
    for index, image in enumerate(expected["images"].values()):
        rows, columns, *wanted = np.array(image["rays"]).T
        origins, directions = rays(model, index, rows, columns)
        assert np.abs(origins.numpy() - image["origin"]).max() < 1e-12, image["model"]
        assert np.abs(directions.numpy() - np.stack(wanted, axis=1)).max() < 1e-8, image["model"]


def test_text_and_binary_models_are_the_same(tmp_path):
    names = ["b c/ d.png", "a.png", "é.png"]
    cameras = {4: CAMERA[1], 9: ("FOV", 20, 10, (9.0, 8.0, 7.0, 6.0, 0.5))}
    images = [
        (name, pose, 4 + 5 * (i % 2), i)
        for i, (name, pose) in enumerate(zip(names, poses(3), strict=True))
    ]
    found = []
    for text in (False, True):
        write_colmap(tmp_path / str(text), cameras, images, POINTS, text=text)
        found.append(read_model(tmp_path / str(text)))
    for encoding in ("utf-8-sig", "utf-16"):  # As editors and shells of Windows write it.
        for path in (tmp_path / "True").iterdir():
            (tmp_path / encoding).mkdir(exist_ok=True)
            text = path.read_text(encoding="utf-8").replace("\n", "\r\n")
            (tmp_path / encoding / path.name).write_text(text, encoding=encoding, newline="")
        found.append(read_model(tmp_path / encoding))
    for model in found:
        assert model.names == ("a.png", "b c/ d.png", "é.png")
        assert np.abs(model.camera_to_world - poses(3)[[1, 0, 2]]).max() < 1e-14
        assert [camera.w for camera in model.calibrations] == [20, 40, 40]
        assert model.points.tolist() == POINTS
        assert model.error == 0.5
    assert all(model.calibrations == found[0].calibrations for model in found)


# Views


def test_rays_pixels_and_points(capture):
    views = capture.views()
    assert views.files == tuple(f"images/{name}" for name in capture.names)
    names = ("k1", "k2", "p1", "p2")
    for index in (0, 5):
        assert np.array_equal(views.image(index)[..., :3].numpy(), picture(index))
        origins, directions = (ray.numpy() for ray in views.image_rays(index))
        for row, column in ((0, 0), (29, 39), (12, 30)):
            local = direction(
                *("perspective", (column + 0.5, row + 0.5)),
                *(dict(zip(names, OPENCV[4:], strict=True)), OPENCV[:2], OPENCV[2:4]),
            )
            expected = capture.poses[index][:3, :3] @ local
            place = row * WIDTH + column
            assert np.abs(directions[place] - expected).max() < 1e-5
            assert np.abs(origins[place] - capture.poses[index][:3, 3]).max() < 1e-6
    half = capture.views(resolution=WIDTH // 2)
    assert half.images.shape[1:3] == (HEIGHT // 2, WIDTH // 2)
    torch.testing.assert_close(half.intrinsics.focal, views.intrinsics.focal / 2)
    torch.testing.assert_close(half.intrinsics.centre, views.intrinsics.centre / 2)
    scene = capture.read("train")
    assert scene.points.tolist() == torch.tensor(POINTS).tolist()
    words = "2, 0.50 px from where images show them on average"
    assert scene.notes["points"] == words
    (capture.path / "sparse/0/points3D.bin").unlink()
    scene = capture.read("train")
    assert scene.points is None
    assert "points" not in scene.notes


def test_cameras_that_fit_badly_are_worth_refining(capture):
    """Two points with errors of 1 and 2 pixels, and one whose error COLMAP does not know."""
    capture.write(text=True)
    for path in (capture.path / "sparse/0").glob("*.bin"):
        path.unlink()
    path = capture.path / "sparse/0/points3D.txt"
    errors = ("1", "2", "-1")
    lines = [f"{k} 0 0 {k} 255 0 0 {error} 7 0" for k, error in enumerate(errors, start=1)]
    path.write_text("\n".join(lines))
    assert capture.read("train").notes["points"] == (
        "3, 1.50 px from where images show them on average; data.refine_cameras=true corrects the "
        "cameras in training"
    )
    path.write_text("1 0 0 1\n")
    assert "points" not in capture.read("train").notes


def test_the_world_is_turned_upright_as_a_whole(capture):
    tilt = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    tilt *= np.linalg.det(tilt)
    for turn in (tilt, np.diag([1.0, -1.0, -1.0]), np.eye(3)[[0, 2, 1]] * [1, 1, -1]):
        capture.poses = poses(8)
        capture.poses[:, :3] = turn @ capture.poses[:, :3]
        capture.write()
        scene = capture.read("train", orient=True, eval_every=100)
        found = scene.splits["train"].camera_to_world.double().numpy()
        up = found[:, :3, 1].mean(axis=0)
        assert np.abs(up[:2]).max() < 1e-6
        assert up[2] > 0.5
        # Poses in one another's axes, and points in those of cameras, are the same.
        before = np.linalg.inv(capture.poses[0]) @ capture.poses
        assert np.abs(np.linalg.inv(found[0]) @ found - before).max() < 1e-5
        points = np.hstack([scene.points.double().numpy(), np.ones((2, 1))])
        places = np.linalg.inv(capture.poses[2]) @ np.hstack([POINTS, np.ones((2, 1))]).T
        assert np.abs(np.linalg.inv(found[2]) @ points.T - places).max() < 1e-5
    upright = poses(8)
    capture.poses = upright
    capture.write()
    assert (
        np.abs(
            capture.views(orient=True).camera_to_world[:, :3, 1].numpy() - upright[:, :3, 1]
        ).max()
        < 0.2
    )


def test_cameras_that_agree_on_no_way_up(capture):
    capture.poses = np.tile(np.eye(4), (8, 1, 1))
    for index, pose in enumerate(capture.poses):
        angle = index * math.pi / 4
        pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        pose[0, 3] = index
    capture.write()
    with pytest.warns(UserWarning, match="up vectors of the cameras cancel out"):
        views = capture.views(orient=True)
    assert np.abs(views.camera_to_world.numpy() - capture.poses).max() < 1e-6


def test_masks_are_used_when_they_are_named(capture):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :10] = 0
    for index, name in enumerate(capture.names[:-1]):
        # COLMAP adds the suffix to the image's name; others keep the name, or change the suffix.
        save(capture.path / "masks" / (name if index % 2 else f"{name}.png"), mask)
    with pytest.warns(UserWarning, match=r"room: masks is not read.*data\.masks=masks"):
        assert capture.views().image(0)[..., 3].min() == 255
    with pytest.warns(UserWarning, match=r"no mask of 1 of 8 images.*frame_007\.png"):
        views = capture.views(masks="masks", mask_use="alpha")
    for index in range(7):
        assert not views.image(index)[:, :10].any()
        assert np.array_equal(views.image(index)[:, 10:, :3], picture(index)[:, 10:])
    assert views.image(7)[..., 3].min() == 255
    capture.refused(
        r"data\.masks: .*none does not exist.*frame_000\.png.*data\.masks=null", masks="none"
    )
    (capture.path / "none").mkdir()
    capture.refused(r"none holds no mask of any image", masks="none")


@pytest.mark.parametrize(
    "name",
    [
        *("masks/{0}.jpg", "masks/{1}.PNG", "masks/{0}_mask.png", "masks/{0}.mask.png"),
        *("Masks/{0}.png.png", "masks/inside/{0}.webp"),
    ],
)
def test_masks_of_other_names_are_found(capture, name):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :10] = 0
    for image in capture.names:
        stem = Path(image).stem
        save(capture.path / name.format(stem, stem.upper()), mask)
    ignored = capture.views(masks="masks", mask_use="ignore").ignored
    assert ignored[:, :, :9].all()
    assert not ignored[:, :, 11:].any()


def test_where_the_model_is(capture):
    for place in ("sparse", "colmap/sparse/0", "mine"):
        other = capture.path.parent / place.replace("/", "_")
        save(other / "images" / "frame_000.png", picture(0))
        save(other / "images" / "frame_001.png", picture(1))
        images = [(f"frame_00{i}.png", capture.poses[i], 1, 0) for i in range(2)]
        write_colmap(other / place, CAMERA, images)
        model = {"model": "mine"} if place == "mine" else {}
        read = settings(ColmapSettings, "colmap", other, **model).load(["train"])
        assert len(read.splits["train"]) == 2
    capture.refused(r"no cameras\.bin or cameras\.txt in other\. Set data\.model", model="other")
    capture.refused(r"does not exist\. Set data\.root", root="nowhere")
    capture.refused(r"pictures is not a folder\. Set data\.images", images="pictures")


@pytest.mark.parametrize("text", [False, True])
def test_the_largest_of_several_models_is_read(capture, caplog, text):
    images = [(f"frame_00{i}.png", capture.poses[i], 1, 2) for i in range(8)]
    write_colmap(capture.path / "sparse/1", CAMERA, images, text=text)
    write_colmap(capture.path / "sparse/0", CAMERA, images[:3])
    assert len(capture.views()) == 8
    assert "sparse/1 is read, which has the most images (0 has 3, 1 has 8)" in caplog.text
    caplog.clear()
    SceneDataModule(capture.settings(), seed=0).setup("fit")
    assert caplog.text.count("could not join them all") == 1
    for path in (capture.path / "sparse/1").glob("images.*"):
        path.write_bytes(b"7 damaged")
    assert len(capture.views()) == 3


def test_missing_and_unregistered_images(capture, caplog):
    capture.write(keep=range(5))
    capture.read("train")
    assert "3 of 8 images in" in caplog.text
    assert "frame_005.png, frame_006.png, frame_007.png" in caplog.text
    (capture.path / "images/frame_002.png").unlink()
    with pytest.warns(UserWarning, match=r"1 of 5 images are left out:\n.*frame_002\.png"):
        assert len(capture.views()) == 4
    for path in (capture.path / "images").iterdir():
        path.rename(path.with_suffix(".JPG"))
    with pytest.warns(UserWarning, match="left out"):
        assert capture.views().files[0] == "images/frame_000.JPG"
    shutil.rmtree(capture.path / "images")
    (capture.path / "images").mkdir()
    assert_refused(MissingSplitError, r"no image .*frame_000\.png.*", capture.read, "none")


@pytest.mark.parametrize(
    ("model", "images"),
    [
        ("dense/0/sparse", "dense/0/images"),
        ("distorted/sparse/0", "input"),
        (".", "images"),
        ("colmap", "images"),
        ("sparse/0", "."),
        ("colmap_text", "rgb/4x"),
    ],
)
def test_models_and_images_are_found_where_programs_leave_them(capture, model, images):
    shutil.copytree(capture.path / "images", capture.path / "kept" / images)
    shutil.copytree(capture.path / "sparse/0", capture.path / "kept" / model, dirs_exist_ok=True)
    found = Capture.__new__(Capture)
    found.path = capture.path / "kept"
    assert ColmapSettings.recognises(found.path)
    assert len(found.views()) == 8
    assert found.views().files[0] == f"{images}/frame_000.png".removeprefix("./")


def test_several_models_or_folders_of_images_are_told_of(capture):
    for name in ("a", "b"):
        shutil.copytree(capture.path / "sparse/0", capture.path / name / "sparse")
    shutil.rmtree(capture.path / "sparse")
    capture.refused(r"holds 2 COLMAP models: a/sparse, b/sparse\. Choose one with data\.model")
    assert len(capture.views(model="a/sparse")) == 8
    for name in ("a", "b"):
        shutil.copytree(capture.path / "images", capture.path / name / "shots")
    shutil.rmtree(capture.path / "images")
    capture.refused(
        r"Set data\.images.*: (a/shots or b/shots|b/shots or a/shots)", model="a/sparse"
    )


def test_images_of_another_shape(capture):
    save(capture.path / "images/frame_003.png", picture(3, WIDTH, HEIGHT))
    capture.refused(r"frame_003\.png has 30x40 pixels.*calibrated for images of 40x30")
    save(capture.path / "images/frame_003.png", picture(3, 15, 21))
    assert capture.views(resolution=20).images.shape[2] == 20


# Times


def test_times_are_the_last_numbers_in_names(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    capture = Capture(tmp_path / "room", ["c2_010.png", "c1_020.png", "c1_060.png"])
    assert capture.views().times.tolist() == pytest.approx([0.2, 1, 0])
    assert "the numbers in their names, from 10 to 60" in caplog.text
    assert capture.read("train").notes["times"] == (
        "the numbers in their names, from 10 to 60: c1_020.png -> 20, c1_060.png -> 60, "
        "c2_010.png -> 10"
    )
    assert capture.views(time_pattern=r"c(\d)").times.tolist() == [0, 0, 1]
    capture.refused(
        r"c1_020\.png has no number where data\.time_pattern=f\(", time_pattern=r"f(\d+)"
    )
    stamps = ["1305031102.175304.png", "1305031102.975304.png", "1305031103.175304.png"]
    assert Capture(tmp_path / "stamps", stamps).views().times.tolist() == pytest.approx([0, 0.8, 1])
    ends = ["034_cam0.png", "036cam1.png", "044-Camera_2.png"]
    assert Capture(tmp_path / "ends", ends).views().times.tolist() == pytest.approx([0, 0.2, 1])
    bare = Capture(tmp_path / "bare", ["a.png", "b.png"])
    words = r"2 of 2 images have no number, such as a\.png: all images are taken for one timestep"
    with pytest.warns(UserWarning, match=words):
        assert bare.views().times.tolist() == [0, 0]
    assert bare.views(static=True).times.tolist() == [0, 0]
    same = Capture(tmp_path / "same", ["a_1.png", "b_1.png"])
    with pytest.warns(UserWarning, match=r"all 2 images, such as a_1.png, give one number"):
        assert same.views().times.tolist() == [0, 0]
    hashes = [
        f"{hash_}.png" for hash_ in ("3f2a9c", "b07d1e", "9e4410", "c5a8f2", "77e0b3", "0d1f6a")
    ]
    with pytest.warns(UserWarning, match=r"differ in more than their numbers.*data\.static=true"):
        assert not Capture(tmp_path / "hashes", hashes).views().times.any()
    scales = Capture(tmp_path / "scales", ["a_1_4k.png", "a_2_4k.png", "a_5_4k.png"])
    assert scales.views(time_pattern=r"_(\d)_").times.tolist() == [0, 0.25, 1]
    assert scales.views().times.tolist() == [0, 0.25, 1]


def test_times_from_a_table(capture):
    table = capture.path / "times.csv"
    # Nanoseconds of a clock are subtracted before they become floats.
    lines = [f"{name},{1_600_000_000_000_000_000 + i * i}" for i, name in enumerate(capture.names)]
    table.write_text("\ufefffile,time\n" + "\n".join([*lines, "unknown.png,3"]), encoding="utf-8")
    found = capture.views(times="times.csv").times
    assert found.tolist() == pytest.approx([i * i / 49 for i in range(8)])
    # A spreadsheet of a country whose decimals have commas.
    table.write_text("File; Time\n" + "\n".join(line.replace(",", "; ") for line in lines))
    assert torch.equal(capture.views(times="times.csv").times, found)
    for text, words in (
        (
            "file,time\n" + "\n".join(lines[:6]),
            r"no time for 2 of 8 images: frame_006\.png, frame_0",
        ),
        *(
            (text, r"times\.csv: line 2 is .*The first line must name the columns file and time")
            for text in ("name,time\na,1", "file,time\na", "file,time\na,soon", "file,time\na,nan")
        ),
        ("file,time\na.png,1\na.png,2", r"line 3 gives a\.png the time 2, an earlier one 1"),
        ("", r"no time for 8 of 8 images"),
    ):
        table.write_text(text)
        capture.refused(words, times="times.csv")
    table.write_bytes(b"file,time\n\xff\xfe")
    capture.refused(r"times\.csv cannot be read as CSV", times="times.csv")
    capture.refused(r"data\.times=.*none\.csv cannot be read as CSV", times="none.csv")


def test_times_by_rank_count_what_was_not_registered(tmp_path, caplog):
    numbers = (2, 9, 10, 11, 100)
    capture = Capture(tmp_path / "rig", [f"cam{c}/{c}_{i}.png" for c in (1, 2) for i in numbers])

    def times():
        views = capture.views(times="rank")
        return dict(zip(views.files, views.times.tolist(), strict=True))

    expected = {
        f"images/cam{c}/{c}_{number}.png": rank / 4
        for c in (1, 2)
        for rank, number in enumerate(numbers)
    }
    assert times() == expected
    capture.write(keep=[0, 2, 3, 4, 5, 6, 7, 8, 9])
    expected.pop("images/cam1/1_9.png")
    assert times() == expected
    assert "folders hold" not in caplog.text
    (capture.path / "images/cam1/1_9.png").unlink()
    times()
    assert "folders hold 4 to 5 images" in caplog.text


def test_one_camera_and_time_twice(capture):
    capture.poses[3] = capture.poses[2]
    capture.write()
    assert len(capture.views()) == 8
    rows = [f"{name},{max(index, 3)}" for index, name in enumerate(capture.names)]
    (capture.path / "times.csv").write_text("\n".join(["file,time", *rows]))
    capture.refused("frame_003.png has the same camera and time as .*002", times="times.csv")


# Splits


def test_folders_of_cameras_may_be_numbers():
    plain = compose_plain("train", ["data=colmap", "data.test_cameras=[1,2]"])
    assert build(plain["data"], SceneSettings, "data").test_cameras == ["1", "2"]


def test_views_are_held_out_by_time_and_by_camera(tmp_path):
    capture = Capture(tmp_path / "rig", [f"cam{c}/{i}.png" for c in (1, 2, 11) for i in range(9)])
    splits = capture.read("train", "val", eval_every=4).splits
    assert [len(splits[name]) for name in ("train", "val")] == [20, 7]
    assert not set(splits["train"].files) & set(splits["val"].files)
    assert {0.0, 1.0} <= set(splits["train"].times.tolist())
    scene = capture.read("train", "val", "test", test_cameras=["cam1/"], views=5, eval_views=3)
    assert {file[:11] for file in scene.splits["test"].files} == {"images/cam1"}
    assert not any(
        "cam1/" in file for name in ("train", "val") for file in scene.splits[name].files
    )
    assert [len(scene.splits[name]) for name in ("train", "val", "test")] == [5, 2, 3]
    capture.refused(
        r"data\.test_cameras=cam3: .*no such folder.*cam1, cam11, cam2", test_cameras=["cam3"]
    )
    with pytest.raises(MissingSplitError, match=r"has no test split.*data\.test_cameras"):
        capture.read("test")
    with pytest.raises(MissingSplitError, match="has no train split"):
        capture.read("train", test_cameras=["cam1", "cam2", "cam11"])


def test_captures_without_folders_have_no_cameras(capture):
    capture.refused(r"has no folders, one for each camera", test_cameras=["cam3"])


def test_settings_that_cannot_work(capture):
    for words, changes in (
        (r"time_pattern=\(: is not a regular expression", {"time_pattern": "("}),
        (r"must have one group.*it has 0", {"time_pattern": "frame"}),
        (r"must have one group.*it has 2", {"time_pattern": r"(\d)(\d)"}),
        (r"not read from file names with times=rank", {"time_pattern": r"(\d)", "times": "rank"}),
        ("eval_every=0", {"eval_every": 0}),
    ):
        assert_refused(ConfigError, words, partial(capture.settings, **changes), changes)


# Damaged files


def test_truncated_binary_files(tmp_path):
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        folder = tmp_path / name
        shutil.copytree(PYCOLMAP, folder)
        whole = (PYCOLMAP / name).read_bytes()
        for length in [*range(0, len(whole), 11), len(whole) - 1]:
            (folder / name).write_bytes(whole[:length])
            assert_refused(
                SceneError,
                rf"{name} is truncated or damaged: its {length} bytes end within .*model_converter",
                partial(read_model, folder),
                length,
            )
        for count in (1, 2**62):
            (folder / name).write_bytes(struct.pack("<Q", count) + whole[8:])
            words = "bytes follow the 1" if count == 1 else f"of {count}"
            message = assert_refused(SceneError, words, partial(read_model, folder), count)
            assert str(folder / name) in message


def test_damaged_text_files(tmp_path):
    folder = tmp_path / "room"

    def refused(file, change, words):
        write_colmap(folder, CAMERA, [("a.png", poses(1)[0], 1, 2)], POINTS, text=True)
        path = folder / file
        path.write_text(change(path.read_text()))
        message = assert_refused(SceneError, words, partial(read_model, folder), (file, words))
        assert file in message

    refused("cameras.txt", lambda t: "", "camera 1, which cameras.txt does not list")
    refused("cameras.txt", lambda t: t.replace("0.03", "x"), "line 2 is .* must be CAMERA_ID MODEL")
    refused("cameras.txt", lambda t: t.replace(" -0.003", ""), "has 7 parameters.*OPENCV.*has 8")
    refused("cameras.txt", lambda t: t + "1 PINHOLE 9 9 1 1 1 1", "camera 1.*is listed twice")
    refused("cameras.txt", lambda t: t.replace("OPENCV", "EUCM"), "camera model EUCM.*undistorter")
    refused("cameras.txt", lambda t: t.replace("36.0", "-36.0"), "fx=-36.0; it must be .*above 0")
    refused("cameras.txt", lambda t: t.replace("20.5", "nan"), "cx=nan; it must be a finite")
    refused("cameras.txt", lambda t: t.replace(" 40 ", " 0 "), "width=0; it must be .*above 0")
    refused("cameras.txt", lambda t: t.replace("0.004", "1e999"), "p1=inf; it must be a finite")
    refused("images.txt", lambda t: "# nothing\n\n", "lists no images")
    refused("images.txt", lambda t: t.replace(" a.png", ""), "lists no images")
    refused("images.txt", lambda t: "# Number of images: 2\n" + t, "lists 2 .* ends after 1")
    refused("images.txt", lambda t: t.replace(" 1.5", ""), "line 4 is .* must be IMAGE_ID QW QX")
    refused("images.txt", lambda t: "\n".join(t.split("\n")[2:] * 2), "lists a.png twice")
    refused("points3D.txt", lambda t: t.replace("0.5", "?"), "must be POINT3D_ID X Y Z")
    refused("points3D.txt", lambda t: t.replace("-0.4", "nan"), "point 2 of 2 lies at .nan")
    write_colmap(folder, CAMERA, [("a.png", poses(1)[0], 1, 2)], text=True)
    (folder / "images.txt").write_bytes(b"\xff\xfe\x00")
    assert_refused(SceneError, "cannot be read as text", partial(read_model, folder), "bytes")
    (folder / "images.txt").unlink()
    assert_refused(SceneError, "neither images.bin nor images", partial(read_model, folder), "none")


def test_lines_of_points_may_be_missing(tmp_path):
    images = [(f"{i} a.png", pose, 1, 2) for i, pose in enumerate(poses(4))]
    write_colmap(tmp_path, CAMERA, images, text=True)
    whole, path = read_model(tmp_path), tmp_path / "images.txt"
    path.write_text("\n".join(path.read_text().split("\n")[2::2]))
    found = read_model(tmp_path)
    assert found.names == whole.names
    assert np.array_equal(found.camera_to_world, whole.camera_to_world)


def test_models_that_lie(capture):
    whole = capture.poses
    capture.write(camera=5)
    capture.refused("frame_000.png was taken by camera 5, which cameras.bin does not list")
    capture.write(cameras={1: (11, 4, 3, (1.0,) * 16)})
    capture.refused(
        r"cameras\.bin: camera 1 has the camera model number 11.*These are: SIMPLE_PINH"
    )
    capture.write(cameras={1: ("FOV", 40, 30, (9.0, 9.0, 1.0, 1.0, 4.0))})
    capture.refused("omega=4.0; it must lie between 0 and pi")
    for value in (math.nan, math.inf):
        capture.poses = whole.copy()
        capture.poses[4, 0, 3] = value
        capture.write()
        with pytest.warns(UserWarning, match=r"1 of 8 images are left out:\n.*frame_004\.p"):
            assert len(capture.views()) == 7
    capture.poses = whole.copy()
    capture.write()
    near = capture.views()
    capture.poses[:, :3, 3] += 4e6
    capture.write()
    with pytest.warns(UserWarning, match=r"read relative to \(40000"):
        far = capture.views()
    shift = (far.camera_to_world - near.camera_to_world)[:, :3, 3]
    torch.testing.assert_close(shift, shift[:1].expand_as(shift), atol=1e-5, rtol=0)
    capture.poses[0, :3, 3] += 1e30
    capture.write()
    capture.refused("cameras lie up to .*single precision.*model_transformer")
    capture.poses = whole
    capture.write()
    generator = np.random.default_rng(0)
    require_precision(Path("video"), 4 + 4e-5 * generator.random((5, 3)))  # A camera that trembles.
    path = capture.path / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    data[12:20] = struct.pack("<d", 7.0)
    path.write_bytes(data)
    capture.refused(r"frame_000\.png: the pose is \[7\.0,.*must be a unit quaternion")


def test_names_that_leave_the_folder(capture):
    save(capture.path.parent / "secret.png", picture(0))
    for name in ("../../secret.png", str(capture.path.parent / "secret.png")):
        write_colmap(capture.path / "sparse/0", CAMERA, [(name, capture.poses[0], 1, 0)])
        capture.refused(r"images\.bin: .*secret\.png: (NAME leaves the scene's|no image)")
