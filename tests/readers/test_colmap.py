"""The reader of COLMAP's captures.

tests/data/colmap holds a model that pycolmap 4.2.1 wrote, and rays that it cast, one image for each
camera model.
"""

import json
import math
import re
import shutil
import struct
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.captures import HEIGHT, WIDTH, picture, poses, save, settings, write_colmap
from tests.scenes.common import refused, told
from tests.training.runs import changed
from xplanes.components import build
from xplanes.errors import ConfigError, MissingSplitError
from xplanes.readers.colmap import ColmapSettings
from xplanes.readers.colmap_model import LENSES, read_model
from xplanes.readers.entries import origin_near
from xplanes.scenes.cameras import cast_rays
from xplanes.scenes.datamodule import SceneDataModule
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

    def write(self, cameras=CAMERA, camera=1, keep=None, text=False, model="sparse/0"):
        keep = range(len(self.names)) if keep is None else keep
        images = [(self.names[i], self.poses[i], camera, i % 3) for i in keep]
        write_colmap(self.path / model, cameras, images, POINTS, text=text)

    def move(self, poses):
        self.poses = poses
        self.write()

    def settings(self, **changes):
        return settings(ColmapSettings, "colmap", self.path, **{"orient": False, **changes})

    def read(self, *splits, **changes):
        return self.settings(**changes).load(splits or ("train", "val"))

    def views(self, **changes):
        """All views as one split, in the order of their names."""
        return self.read("train", eval_every=100, **changes).splits["train"]

    def refused(self, words, **changes):
        refused(partial(self.read, "train", **changes), words, case=changes)


@pytest.fixture
def capture(tmp_path):
    return Capture(tmp_path / "room")


# Models


def rays(model, index, rows, columns):
    """Rays of an image of a model, in double precision."""
    camera = model.calibrations[index]
    size = (int(camera.h), int(camera.w))
    focal, centre, skew = camera.scaled(size, size)
    row = [[camera.distortion.get(name, 0.0) for name in COEFFICIENTS]]
    row = torch.tensor(row, dtype=torch.float64)
    lens = Lenses(torch.tensor([int(camera.model)]), row, torch.tensor([skew]))
    pixels = (torch.tensor(places, dtype=torch.float64) for places in (rows, columns))
    pose = torch.from_numpy(model.camera_to_world[index])
    return cast_rays(pose, *pixels, focal=focal, centre=centre, lenses=lens)


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


def test_points_tell_how_well_the_cameras_fit(capture):
    scene = capture.read("train")
    assert scene.points.tolist() == torch.tensor(POINTS).tolist()
    assert scene.notes["points"] == "2, 0.50 px from where images show them on average"
    (capture.path / "sparse/0/points3D.bin").unlink()
    scene = capture.read("train")
    assert scene.points is None
    assert "points" not in scene.notes
    # Two points with errors of 1 and 2 pixels, and one whose error COLMAP does not know.
    capture.write(text=True)
    for path in (capture.path / "sparse/0").glob("*.bin"):
        path.unlink()
    path = capture.path / "sparse/0/points3D.txt"
    errors = (1, 2, -1)
    path.write_text("\n".join(f"{k} 0 0 {k} 255 0 0 {e} 7 0" for k, e in enumerate(errors, 1)))
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
        whole = poses(8)
        whole[:, :3] = turn @ whole[:, :3]
        capture.move(whole)
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
    capture.move(poses(8))
    found = capture.views(orient=True).camera_to_world[:, :3, 1].numpy()
    assert np.abs(found - capture.poses[:, :3, 1]).max() < 0.2


def test_cameras_that_agree_on_no_way_up(capture):
    capture.poses = np.tile(np.eye(4), (8, 1, 1))
    for index, pose in enumerate(capture.poses):
        angle = index * math.pi / 4
        pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        pose[0, 3] = index
    capture.write()
    with told("up vectors of the cameras cancel out"):
        views = capture.views(orient=True)
    assert np.abs(views.camera_to_world.numpy() - capture.poses).max() < 1e-6


def left_masked():
    """A mask that is black in the ten columns on the left."""
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :10] = 0
    return mask


def test_masks_are_used_when_they_are_named(capture):
    for index, name in enumerate(capture.names[:-1]):
        # COLMAP adds the suffix to the image's name; others keep the name, or change the suffix.
        save(capture.path / "masks" / (name if index % 2 else f"{name}.png"), left_masked())
    with told(r"room: masks is not read.*data\.masks=masks"):
        assert capture.views().image(0)[..., 3].min() == 255
    with told(r"no mask of 1 of 8 images.*shown whole: .*frame_007\.png"):
        views = capture.views(masks="masks", mask_use="alpha")
    for index in range(7):
        assert not views.image(index)[:, :10].any()
        assert np.array_equal(views.image(index)[:, 10:, :3], picture(index)[:, 10:])
    assert views.image(7)[..., 3].min() == 255
    words = r"data\.masks: .*none does not exist.*frame_000\.png.*data\.masks=null"
    capture.refused(words, masks="none")
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
    for image in capture.names:
        stem = Path(image).stem
        save(capture.path / name.format(stem, stem.upper()), left_masked())
    ignored = capture.views(masks="masks", mask_use="ignore").ignored
    assert ignored[:, :, :9].all()
    assert not ignored[:, :, 11:].any()


def test_a_model_or_images_that_are_not_where_they_are_said_to_be(capture):
    (capture.path / "sparse").rename(capture.path / "other")
    assert len(capture.views(model="other/0")) == 8
    (capture.path / "other/0").rename(capture.path / "sparse")
    for changes, words in (
        ({"model": "other"}, r"no cameras\.bin or cameras\.txt in other\. Set data\.model"),
        ({"root": "nowhere"}, r"does not exist\. Set data\.root"),
        ({"images": "pictures"}, r"pictures is not a folder\. Set data\.images"),
    ):
        capture.refused(words, **changes)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("place", ["sparse", "colmap/sparse"])
def test_the_largest_of_several_models_is_read(capture, text, place):
    shutil.rmtree(capture.path / "sparse")
    capture.write(text=text, model=f"{place}/1")
    capture.write(keep=range(3), model=f"{place}/0")
    assert ColmapSettings.recognises(capture.path)
    words = r"sparse holds 2 models.*/1 is read, .*most images \(0 has 3, 1 has 8\).*data\.model"
    with told(words):
        assert len(capture.views()) == 8
    with pytest.warns(UserWarning, match="could not join them all") as caught:
        SceneDataModule(capture.settings(), seed=0).setup("fit")
    assert len(caught) == 1
    for path in (capture.path / place / "1").glob("images.*"):
        path.write_bytes(b"7 damaged")
    assert len(capture.views()) == 3


def test_missing_and_unregistered_images(capture, caplog):
    capture.write(keep=range(5))
    capture.read("train")
    assert "3 of 8 images in" in caplog.text
    assert "frame_005.png, frame_006.png, frame_007.png" in caplog.text
    (capture.path / "images/frame_002.png").unlink()
    with told(r"1 of 5 images are left out:\n.*frame_002\.png"):
        assert len(capture.views()) == 4
    for path in (capture.path / "images").iterdir():
        path.rename(path.with_suffix(".JPG"))
    with told("left out"):
        assert capture.views().files[0] == "images/frame_000.JPG"
    shutil.rmtree(capture.path / "images")
    (capture.path / "images").mkdir()
    refused(capture.read, r"no image .*frame_000\.png.*", error=MissingSplitError)


@pytest.mark.parametrize(
    ("model", "images"),
    [
        ("sparse", "images"),
        ("colmap/sparse/0", "images"),
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


def test_names_may_begin_with_the_folder_of_images(tmp_path):
    capture = Capture(tmp_path / "room", [f"images/frame_{i:03d}.png" for i in range(8)])
    (capture.path / "images/images").rename(tmp_path / "room/moved")
    (capture.path / "images").rmdir()
    (tmp_path / "room/moved").rename(capture.path / "images")
    assert len(capture.views()) == 8


def test_images_may_lie_anywhere(capture, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for root in (".", str(tmp_path)):
        views = capture.views(root=root, images=str(tmp_path / "room/images"))
        assert views.files[0] == "images/frame_000.png"
    save(capture.path / "images/mask.png", picture(0))
    (capture.path / "images").rename(tmp_path / "photos")
    with told(r"photos/mask\.png is not read"):
        views = capture.views(images=str(tmp_path / "photos"))
    assert views.files[0] == "photos/frame_000.png"


def test_several_models_or_folders_of_images_are_told_of(capture):
    for name in ("a", "b"):
        shutil.copytree(capture.path / "sparse/0", capture.path / name / "sparse")
    shutil.rmtree(capture.path / "sparse")
    capture.refused(r"holds 2 COLMAP models: a/sparse, b/sparse\. Choose one with data\.model")
    assert len(capture.views(model="a/sparse")) == 8
    for name in ("a", "b"):
        shutil.copytree(capture.path / "images", capture.path / name / "shots")
    shutil.rmtree(capture.path / "images")
    words = r"Set data\.images.*: (a/shots or b/shots|b/shots or a/shots)"
    capture.refused(words, model="a/sparse")


def test_images_of_another_shape(capture):
    save(capture.path / "images/frame_003.png", picture(3, WIDTH, HEIGHT))
    capture.refused(r"frame_003\.png has 30x40 pixels.*calibrated for images of 40x30")
    save(capture.path / "images/frame_003.png", picture(3, 15, 21))
    assert capture.views(resolution=20).images.shape[2] == 20


# Times


def test_times_are_the_last_numbers_in_names(tmp_path, caplog):
    capture = Capture(tmp_path / "room", ["c2_010.png", "c1_020.png", "c1_060.png"])
    with caplog.at_level("INFO"):
        assert capture.views().times.tolist() == pytest.approx([0.2, 1, 0])
    assert "the numbers in their names, from 10 to 60" in caplog.text
    assert capture.read("train").notes["times"] == (
        "the numbers in their names, from 10 to 60: c1_020.png -> 20, c1_060.png -> 60, "
        "c2_010.png -> 10"
    )
    assert capture.views(time_pattern=r"c(\d)").times.tolist() == [0, 0, 1]
    for pattern in (r"f(\d+)", r"c(\D+)?"):
        words = rf"c1_020\.png has no number where data\.time_pattern={re.escape(pattern)}"
        capture.refused(words, time_pattern=pattern)
    bare = Capture(tmp_path / "bare", ["a.png", "b.png"])
    with told(r"2 of 2 images have no number, such as a\.png: all images are taken for one time"):
        assert bare.views().times.tolist() == [0, 0]
    with told(None):
        assert bare.views(static=True).times.tolist() == [0, 0]


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
    # Decimals with commas, other folders, and no endings.
    rows = [f"out/{name.removesuffix('.png')};{i * i / 10}" for i, name in enumerate(capture.names)]
    table.write_text("file;time\n" + "\n".join(rows).replace(".", ","))
    assert torch.equal(capture.views(times="times.csv").times, found)
    columns = r"times\.csv: line 2 is .*The first line must name the columns file and time"
    for text, words in (
        (
            "\n".join(["file,time", *lines[:6]]),
            r"no time for 2 of 8 images: frame_006\.png, frame_0",
        ),
        *((text, columns) for text in ("name,time\na,1", "file,time\na", "file,time\na,soon")),
        ("file,time\na,nan", columns),
        ("file,time\na.png,1\na.png,2", r"line 3 gives a\.png the time 2, an earlier one 1"),
        ("", r"no time for 8 of 8 images"),
    ):
        table.write_text(text)
        capture.refused(words, times="times.csv")
    table.write_bytes(b"file,time\n\xff\xfe")
    for name, words in (("times", r"times\.csv"), ("none", r"data\.times=.*none\.csv")):
        capture.refused(f"{words} cannot be read as CSV", times=f"{name}.csv")


def test_times_by_rank_count_what_was_not_registered(tmp_path, caplog):
    numbers = (2, 9, 10, 11, 100)
    names = [f"cam{camera}/{camera}_{number}.png" for camera in (1, 2) for number in numbers]
    capture = Capture(tmp_path / "rig", names)

    def times():
        views = capture.views(times="rank")
        files = [file.replace("PNG", "png") for file in views.files]
        return dict(zip(files, views.times.tolist(), strict=True))

    expected = {f"images/{name}": index % 5 / 4 for index, name in enumerate(names)}
    assert times() == expected
    capture.write(keep=[0, 2, 3, 4, 5, 6, 7, 8, 9])
    expected.pop("images/cam1/1_9.png")
    assert times() == expected
    assert "folders hold" not in caplog.text
    # Files may have other endings than the model's names, and their folder may be a link.
    outside = (capture.path / "images/cam1").rename(tmp_path / "cam1")
    (capture.path / "images/cam1").symlink_to(outside)
    for path in outside.iterdir():
        path.rename(path.with_suffix(".PNG"))
    assert times() == expected
    assert "folders hold" not in caplog.text
    (outside / "1_9.PNG").unlink()
    times()
    assert "folders hold 4 to 5 images" in caplog.text


def test_one_camera_and_time_twice(capture):
    capture.move(capture.poses[[0, 1, 2, 2, 4, 5, 6, 7]])
    assert len(capture.views()) == 8
    rows = [f"{name},{max(index, 3)}" for index, name in enumerate(capture.names)]
    (capture.path / "times.csv").write_text("\n".join(["file,time", *rows]))
    capture.refused("frame_003.png has the same camera and time as .*002", times="times.csv")


# Splits


def test_folders_of_cameras_may_be_numbers():
    plain = changed((), "data=colmap", "data.test_cameras=[1,2]")
    assert build(plain["data"], SceneSettings, "data").test_cameras == ["1", "2"]


def test_views_are_held_out_by_time_and_by_camera(tmp_path):
    capture = Capture(tmp_path / "rig", [f"cam{c}/{i}.png" for c in (1, 2, 11) for i in range(9)])
    splits = capture.read("train", "val", eval_every=4).splits
    assert [len(splits[name]) for name in ("train", "val")] == [20, 7]
    assert not set(splits["train"].files) & set(splits["val"].files)
    assert {0.0, 1.0} <= set(splits["train"].times.tolist())
    scene = capture.read("train", "val", "test", test_cameras=["cam1/"], views=5, eval_views=3)
    assert {file[:11] for file in scene.splits["test"].files} == {"images/cam1"}
    others = scene.splits["train"].files + scene.splits["val"].files
    assert not any("cam1/" in file for file in others)
    assert [len(scene.splits[name]) for name in ("train", "val", "test")] == [5, 2, 3]
    words = r"data\.test_cameras=cam3: .*no such folder.*cam1, cam11, cam2"
    capture.refused(words, test_cameras=["cam3"])
    for split, cameras, words in (
        ("test", [], r"has no test split.*data\.test_cameras"),
        ("train", ["cam1", "cam2", "cam11"], "has no train split"),
    ):
        read = partial(capture.read, split, test_cameras=cameras)
        refused(read, words, error=MissingSplitError)
    flat = Capture(tmp_path / "flat")
    flat.refused(r"has no folders, one for each camera", test_cameras=["cam3"])


def test_settings_that_cannot_work(capture):
    for words, changes in (
        (r"time_pattern=\(: is not a regular expression", {"time_pattern": "("}),
        (r"must have one group.*it has 0", {"time_pattern": "frame"}),
        (r"must have one group.*it has 2", {"time_pattern": r"(\d)(\d)"}),
        (r"not read from file names with times=rank", {"time_pattern": r"(\d)", "times": "rank"}),
        ("eval_every=0", {"eval_every": 0}),
    ):
        refused(partial(capture.settings, **changes), words, case=changes, error=ConfigError)


# Damaged files


def test_truncated_binary_files(tmp_path):
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        folder = tmp_path / name
        shutil.copytree(PYCOLMAP, folder)
        read, whole = partial(read_model, folder), (PYCOLMAP / name).read_bytes()
        for length in [*range(0, len(whole), 11), len(whole) - 1]:
            (folder / name).write_bytes(whole[:length])
            words = f"{name} is truncated or damaged: its {length} bytes end within .*model_convert"
            refused(read, words, case=length)
        for count, words in ((1, "bytes follow the 1"), (2**62, f"of {2**62}")):
            (folder / name).write_bytes(struct.pack("<Q", count) + whole[8:])
            refused(read, words, str(folder / name), case=count)


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("cameras", "(?s).*", "", "camera 1, which cameras.txt does not list"),
        ("cameras", "0.03", "x", "line 2 is .* must be CAMERA_ID MODEL"),
        ("cameras", " -0.003", "", "has 7 parameters.*OPENCV.*has 8"),
        ("cameras", r"\Z", "1 PINHOLE 9 9 1 1 1 1", "camera 1.*is listed twice"),
        ("cameras", "OPENCV", "EUCM", "camera model EUCM.*undistorter"),
        ("cameras", "OPENCV", "EQUIRECTANGULAR", "camera model EQUI.*cut perspective images"),
        ("cameras", "36.0", "-36.0", "fx=-36.0; it must be .*above 0"),
        ("cameras", "20.5", "nan", "cx=nan; it must be a finite"),
        ("cameras", " 40 ", " 0 ", "width=0; it must be .*above 0"),
        ("cameras", "0.004", "1e999", "p1=inf; it must be a finite"),
        ("images", "(?s).*", "# nothing", "lists no images"),
        ("images", " a.png", "", "lists no images"),
        ("images", r"\A", "# Number of images: 2\n", "lists 2 .* ends after 1"),
        ("images", " 1.5", "", "line 4 is .* must be IMAGE_ID QW QX"),
        ("images", r"(?s)(7 .*)\Z", r"\1\1", "lists a.png twice"),
        ("images", "(?s).*", "\xff\xfe\x00", "cannot be read as text"),
        ("points3D", "0.5", "?", "must be POINT3D_ID X Y Z"),
        ("points3D", "-0.4", "nan", "point 2 of 2 lies at .nan"),
    ],
)
def test_damaged_text_files(tmp_path, file, old, new, words):
    write_colmap(tmp_path, CAMERA, [("a.png", poses(1)[0], 1, 2)], POINTS, text=True)
    path = tmp_path / f"{file}.txt"
    path.write_text(re.sub(old, new, path.read_text(), count=1), encoding="latin-1")
    refused(partial(read_model, tmp_path), words, f"{file}.txt")


def test_lines_of_points_may_be_missing(tmp_path):
    images = [(f"{i} a.png", pose, 1, 2) for i, pose in enumerate(poses(4))]
    write_colmap(tmp_path, CAMERA, images, text=True)
    whole, path = read_model(tmp_path), tmp_path / "images.txt"
    path.write_text("\n".join(path.read_text().split("\n")[2::2]))
    found = read_model(tmp_path)
    assert found.names == whole.names
    assert np.array_equal(found.camera_to_world, whole.camera_to_world)
    path.unlink()
    refused(partial(read_model, tmp_path), "neither images.bin nor images")


@pytest.mark.parametrize(
    ("camera", "lens", "words"),
    [
        (5, CAMERA[1], "frame_000.png was taken by camera 5, which cameras.bin does not list"),
        (1, (11, 4, 3, (1.0,) * 16), r"cameras\.bin: .*model RAD_TAN_.*These are: SIMPLE_PINHOLE"),
        (1, (17, 4, 3, (1.0, 1.0)), "model EQUIRECTANGULAR.*cut perspective images"),
        (1, (99, 4, 3, (1.0,) * 16), "model number 99"),
        (1, ("FOV", 40, 30, (9.0, 9.0, 1.0, 1.0, 4.0)), "omega=4.0; it must lie between 0 and pi"),
    ],
    ids=["unknown camera", "unread", "panorama", "unknown model", "lens that cannot be"],
)
def test_cameras_that_cannot_be(capture, camera, lens, words):
    capture.write({1: lens}, camera)
    capture.refused(words)


def test_poses_that_cannot_be(capture):
    whole = capture.poses.copy()

    def move(place, index=slice(None)):
        moved = whole.copy()
        moved[index, :3, 3] += place
        capture.move(moved)

    for value in (math.nan, math.inf):
        move(value, 4)
        with told(r"1 of 8 images are left out:\n.*frame_004\.p"):
            assert len(capture.views()) == 7
    move(4e6)
    with told(r"read relative to \(40000"):
        far = capture.views().camera_to_world[:, :3, 3].double().numpy()
    shift = far - whole[:, :3, 3]
    assert np.abs(shift - shift[0]).max() < 1e-5
    move(1e30, 0)
    capture.refused("cameras lie up to .*single precision.*model_transformer")
    generator = np.random.default_rng(0)
    trembling = 4 + 4e-5 * generator.random((5, 3))
    assert not origin_near(Path("video"), trembling, movable=False).any()
    capture.move(whole)
    path = capture.path / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    data[12:20] = struct.pack("<d", 7.0)
    path.write_bytes(data)
    capture.refused(r"frame_000\.png: the pose is \[7\.0,.*must be a unit quaternion")


def test_names_that_leave_the_folder(capture):
    save(capture.path.parent / "secret.png", picture(0))
    for name in ("../../secret.png", str(capture.path.parent / "secret.png")):
        capture.names[0] = name
        capture.write(keep=[0])
        capture.refused(r"images\.bin: .*secret\.png: (NAME leaves the scene's|no image)")
