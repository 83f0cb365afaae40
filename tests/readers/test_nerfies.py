"""The reader of captures of Nerfies, HyperNeRF and DyCheck."""

import json
import math
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.captures import HEIGHT, WIDTH, NerfiesFolder, picture, save, settings
from tests.lens_oracle import direction
from tests.scenes.common import refused as refused_by
from tests.scenes.common import told
from xplanes.errors import MissingSplitError
from xplanes.readers.nerfies import NerfiesSettings
from xplanes.scenes.cameras import project

CENTRE, SCALE = np.array([0.5, -1, 2]), 0.25


def read(capture, *splits, **changes):
    made = settings(NerfiesSettings, "nerfies", capture.path, **{"orient": False, **changes})
    return made.load(splits or ("train", "val"))


def refused(capture, *words, **changes):
    refused_by(partial(read, capture, **changes), *words, case=changes)


@pytest.fixture
def capture(tmp_path):
    return NerfiesFolder(tmp_path / "broom")


def oracle(capture, index, row, column):
    """Direction of a pixel of a full image, by the formulas of the format, in the world."""
    lens = capture.lens
    distortion = (*lens["radial_distortion"], *lens["tangential"])
    names = dict(zip(("k1", "k2", "k3", "p1", "p2"), distortion, strict=True))
    focal = (lens["focal_length"], lens["focal_length"] * lens["pixel_aspect_ratio"])
    target = (column + 0.5, row + 0.5)
    local = direction("perspective", target, names, focal, lens["principal_point"], lens["skew"])
    return capture.poses[index][:3, :3] @ local


def test_rays_pixels_times_and_cameras(capture):
    scene = read(capture)
    for name, first in (("train", 0), ("val", 1)):
        views = scene.splits[name]
        assert views.files == tuple(f"rgb/1x/00000{i}.png" for i in range(first, 6, 2))
        assert views.times.tolist() == pytest.approx([i / 5 for i in range(first, 6, 2)])
        for place, index in enumerate(range(first, 6, 2)):
            assert np.array_equal(views.image(place)[..., :3].numpy(), picture(index))
            origins, directions = (ray.numpy() for ray in views.image_rays(place))
            position = (capture.poses[index][:3, 3] - CENTRE) * SCALE
            assert np.abs(origins - position).max() < 1e-6
            for row, column in ((0, 0), (29, 39), (12, 30)):
                expected = oracle(capture, index, row, column)
                assert np.abs(directions[row * WIDTH + column] - expected).max() < 1e-5


def test_the_smallest_images_that_are_large_enough(capture):
    for resolution, folder in ((None, "1x"), (40, "1x"), (21, "1x"), (20, "2x"), (10, "2x")):
        views = read(capture, "train", resolution=resolution).splits["train"]
        assert views.files[0] == f"rgb/{folder}/000000.png", resolution
        assert views.width == (resolution or WIDTH)
    full, half = (read(capture, "train", resolution=n).splits["train"] for n in (None, 20))
    for name in ("focal", "centre"):
        whole = getattr(full.intrinsics, name)
        torch.testing.assert_close(getattr(half.intrinsics, name), whole / 2)
    torch.testing.assert_close(half.intrinsics.lenses.skew, full.intrinsics.lenses.skew / 2)
    # Rays through the corners of four pixels are those through the middle of one.
    corners = full.image_rays(0)[1].view(HEIGHT, WIDTH, 3)
    middle = corners.view(15, 2, 20, 2, 3).mean(dim=(1, 3))
    found = half.image_rays(0)[1].view(15, 20, 3)
    assert (middle / middle.norm(dim=-1, keepdim=True) - found).abs().max() < 2e-4
    for resolution, width in ((41, WIDTH), (40, WIDTH // 2)):
        with told(f"data.resolution={resolution} is more .* Set at most {width}"):
            assert read(capture, "train", resolution=resolution).splits["train"].width == width
        shutil.rmtree(capture.path / "rgb/1x", ignore_errors=True)


def test_both_names_of_tangential_distortion(capture):
    first = read(capture, "train").splits["train"].image_rays(0)[1]
    for name in capture.ids:
        shift = capture.lens["tangential"]
        capture.change(f"camera/{name}.json", tangential=..., tangential_distortion=shift)
    assert torch.equal(read(capture, "train").splits["train"].image_rays(0)[1], first)
    for name in capture.ids:
        capture.change(f"camera/{name}.json", tangential_distortion=...)
    assert not torch.equal(read(capture, "train").splits["train"].image_rays(0)[1], first)


def test_which_key_counts_time(capture):
    def times():
        return read(capture, "train").splits["train"].times.tolist()

    warped = times()
    for place, entry in enumerate(capture.metadata.values()):
        entry["time_id"] = place**2
    for key, expected in (
        ("time_id", [0, 4 / 25, 16 / 25]),
        ("warp_id", warped),
        ("appearance_id", [0, 0.4, 0.8]),
    ):
        capture.write("metadata.json", capture.metadata)
        assert times() == pytest.approx(expected)
        capture.metadata["000003"].pop(key)
    capture.write("metadata.json", capture.metadata)
    refused(capture, r"metadata\.json: not all images have one of .*data\.static=true")
    assert read(capture, static=True).splits["train"].times.tolist() == [0, 0, 0]
    (capture.path / "metadata.json").unlink()
    refused(capture, r"metadata\.json cannot be read as JSON")
    assert read(capture, static=True).splits["train"].times.tolist() == [0, 0, 0]


def test_splits(capture):
    ids = capture.ids
    for kind, train, val in (("mono", ids[:3], ids[3:]), ("intl", ids[1:3], ids[:1])):
        capture.write(f"splits/train_{kind}.json", {"frame_names": train})
        capture.write(f"splits/val_{kind}.json", {"frame_names": val})
        splits = read(capture, protocol=kind).splits
        for name, names in (("train", train), ("val", val)):
            assert splits[name].files == tuple(f"rgb/1x/{each}.png" for each in names)
    refused(capture, r"data\.protocol=all: .*train_all\.json.*intl or mono", protocol="all")
    assert len(read(capture, "train").splits["train"]) == 3
    capture.write("splits/train.json", {"frame_names": ids[:4]})
    capture.write("splits/val.json", {"frame_names": ids[4:]})
    assert len(read(capture, "train").splits["train"]) == 4
    shutil.rmtree(capture.path / "splits")
    capture.change("dataset.json", train_ids=...)
    assert read(capture).splits["train"].files[1] == "rgb/1x/000002.png"
    capture.change("dataset.json", val_ids=[])
    splits = read(capture, eval_every=3).splits
    assert [len(splits[name]) for name in ("train", "val")] == [4, 2]
    with pytest.raises(MissingSplitError, match=r"has no test split.*train, val"):
        read(capture, "test")


def test_captures_that_are_not_whole(capture):
    (capture.path / "rgb/1x/000004.png").unlink()
    with told(r"1 of 6 images are not in .*rgb/1x: 000004. Those of"):
        assert read(capture).splits["train"].width < WIDTH
    assert len(read(capture, resolution=20).splits["train"]) == 3
    (capture.path / "camera/000005.json").unlink()
    capture.change("metadata.json", **{"000001": ...})
    with told(r"(?s)2 of 6 images are left out.*for 000001.*000005\.js"):
        parts = read(capture, resolution=20).splits
    assert [len(views) for views in parts.values()] == [3, 1]
    capture.change("camera/000003.json", position=[0, math.nan, 0])
    with told(r"3 of 6 images are left out|000004|position is \[0, nan, 0\]"):
        assert len(read(capture, "train").splits["train"]) == 3
    for scale in (capture.path / "rgb").iterdir():
        scale.rename(capture.path / scale.name)
    (capture.path / "rgb").rmdir()
    (capture.path / "1x").rename(capture.path / "rgb")
    with told("images are left out|000004"):
        assert read(capture, "train").splits["train"].width == WIDTH
    shutil.rmtree(capture.path / "rgb")
    shutil.copy(capture.path / "camera/000004.json", capture.path / "camera/000005.json")
    refused(capture, r"rgb has no folder, such as 1x or 4x, with an image of 000000")
    (capture.path / "dataset.json").unlink()
    refused(capture, r"broom holds no dataset\.json.*Set data\.root")
    refused(capture, "nowhere/broom does not exist", root="nowhere")


def test_cameras_that_cannot_be(capture):
    whole = json.loads((capture.path / "camera/000002.json").read_text())
    rows = np.array(whole["orientation"])
    for change, words in (
        ({"orientation": (rows * [1, 1, -1]).tolist()}, "mirrors .*right, down, forward"),
        ({"orientation": (rows * [[2], [1], [1]]).tolist()}, "orientation is not orthonormal"),
        ({"orientation": rows[:2].tolist()}, "orientation is .*must be 3 rows"),
        ({"orientation": [[1, 0, 0], [0, 1], [0, 0, 1]]}, r"row 1 of orientation is \[0, 1\]"),
        ({"position": [0, None, 1]}, r"position is \[0, None, 1\]; it must be 3 numbers"),
        ({"position": ...}, "position is None; it must be 3 numbers"),
        ({"focal_length": 0}, "focal_length is 0; it must be a number above 0"),
        ({"focal_length": ...}, "focal_length is None"),
        ({"pixel_aspect_ratio": -1}, "pixel_aspect_ratio is -1; it must be a number above 0"),
        ({"skew": "no"}, "skew is 'no'; it must be a number"),
        ({"principal_point": [10**400, 1]}, "principal_point is .*; it must be 2 numbers"),
        ({"image_size": [0, 30]}, "image_size is 0 x 30"),
        ({"image_size": [30, 40]}, "calibrated for images of 30x40"),
        ({"radial_distortion": [1, 2]}, r"radial_distortion is \[1, 2\]; it must be 3 numbers"),
        ({"tangential": 1}, "tangential is 1; it must be 2 numbers"),
        ({"radial_distortion": [-3, 0, 0]}, "folds back inside the image"),
    ):
        capture.change("camera/000002.json", **(whole | change))
        refused(capture, words, "000002")
    for text in ("[1", "[1, 2]", '{"orientation": '):
        capture.write("camera/000002.json", text)
        refused(capture, r"000002\.json (cannot be read as JSON|must hold a JSON object)")


def test_other_files_that_cannot_be(capture):
    for file, changes, words in (
        ("scene", {"scale": 0}, "scale is 0; it must be a number above 0"),
        ("scene", {"center": [1, 2]}, r"center is \[1, 2\]; it must be 3 numbers"),
        ("dataset", {"train_ids": "all"}, "train_ids is 'all'; it must be a list"),
        ("dataset", {"train_ids": ["000001"] * 2}, "train_ids lists 000001 twice"),
        ("dataset", {"val_ids": ["000000"]}, "1 images are listed both for training"),
        ("dataset", dict.fromkeys(("ids", "train_ids", "val_ids"), ...), "ids is None; it must be"),
        ("metadata", {"000003": {"warp_id": "x"}}, "warp_id of 000003 is 'x'; it must be"),
    ):
        before = (capture.path / f"{file}.json").read_text()
        capture.change(f"{file}.json", **changes)
        refused(capture, words, f"{file}.json")
        capture.write(f"{file}.json", before)
    save(capture.path.parent / "secret.png", picture(0))
    capture.write("../secret.json", (capture.path / "camera/000000.json").read_text())
    capture.change("dataset.json", train_ids=["../../secret"])
    refused(capture, "ids leaves the scene's folder")


def test_points_that_cannot_be(capture):
    path = capture.path / "points.npy"
    np.save(path, np.zeros((4, 3)))
    whole = path.read_bytes()
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    unreadable = [whole[:-8], whole[:20], b"", whole.replace(b"(4, 3)", b"(9**9, 3)")]
    for data in (*unreadable, path.read_bytes()):
        path.write_bytes(data)
        refused(capture, r"points\.npy cannot be read")
    for array, words in (
        (np.zeros((3, 4)), r"\[3, 4\]; it must be .*\[N, 3\]"),
        (np.full((2, 3), np.nan), r"\[2, 3\]; it must be finite"),
    ):
        np.save(path, array)
        refused(capture, rf"points\.npy holds an array {words}")


def test_real_cameras_see_what_their_capture_says_they_look_at(tmp_path):
    """The conventions are those of real files: tests/data/dycheck."""
    real = Path(__file__).parents[1] / "data" / "dycheck" / "paper-windmill"
    folder = tmp_path / real.name
    shutil.copytree(real, folder)
    names = sorted(path.stem for path in (real / "camera").iterdir())
    assert len(names) == 3
    metadata = {name: {"warp_id": int(name[2:]), "camera_id": 0} for name in names}
    (folder / "dataset.json").write_text(json.dumps({"ids": names, "train_ids": names}))
    (folder / "metadata.json").write_text(json.dumps(metadata))
    for index, name in enumerate(names):
        save(folder / "rgb" / "4x" / f"{name}.png", picture(index, 240, 180))
    made = settings(NerfiesSettings, "nerfies", folder, orient=False, resolution=180)
    views = made.load(["train"]).splits["train"]
    scene, extra = (json.loads((real / f"{name}.json").read_text()) for name in ("scene", "extra"))
    target, up = torch.tensor(extra["lookat"]), torch.tensor(extra["up"])
    lenses = views.intrinsics
    for pose, focal, centre in zip(views.camera_to_world, lenses.focal, lenses.centre, strict=True):
        column, row, seen = project(pose, target[None], focal=focal, centre=centre)
        assert seen.all()
        assert 0.3 * 180 < float(column) < 0.7 * 180
        assert 0.3 * 240 < float(row) < 0.7 * 240
        assert scene["near"] < float((pose[:3, 3] - target).norm()) < scene["far"]
        assert float(pose[:3, 1] @ up) > 0.95
    assert lenses.focal[0].tolist() == pytest.approx([719.9471435546875 / 4] * 2)
    centre = [358.8895263671875 / 4, 484.92236328125 / 4]
    assert lenses.centre[0].tolist() == pytest.approx(centre)
