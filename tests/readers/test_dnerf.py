"""Scenes as Blender and D-NeRF's tools write them."""

import json
import math
import re
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

from tests.captures import save, settings
from tests.scenes.common import ANGLE, SceneFolder, pose, refused, rgba, told
from tests.training.runs import changed
from xplanes.components import build
from xplanes.errors import MissingSplitError
from xplanes.readers.dnerf import BlenderSettings
from xplanes.readers.images import load_images, load_premultiplied
from xplanes.scenes.cameras import focal_length
from xplanes.scenes.lenses import COEFFICIENTS
from xplanes.scenes.source import SceneSettings


@pytest.fixture
def scene(tmp_path):
    return SceneFolder(tmp_path / "ball").add("train", 5)


def box_average(straight, factor):
    """Independent reference: premultiplied float64 block means, from 0 to 255. [H, W, 4]"""
    pixels = straight.astype(np.float64)
    pixels[..., :3] *= pixels[..., 3:] / 255
    height, width = pixels.shape[:2]
    return pixels.reshape(height // factor, factor, width // factor, factor, 4).mean(axis=(1, 3))


# What a sound scene becomes


def test_splits_are_read_in_the_order_asked_for_without_a_warning(scene):
    scene.add("val", 2)
    with told(None):
        result = scene.read(["train", "val", "train"])
        scene.read(resolution=6)
    assert result.name == "ball"
    assert list(result.splits) == ["train", "val"]
    assert result.video is None
    views = result.splits["train"]
    assert views.files == tuple(f"train/r_{i}.png" for i in range(5))
    torch.testing.assert_close(views.camera_to_world[3], torch.tensor(pose(3)))


def test_reduced_images_average_the_premultiplied_area_that_a_pixel_covers(scene):
    for resolution in (1, 4, 5, 8, 11):
        views = scene.train(resolution=resolution)
        assert views.images.shape == (5, resolution, resolution, 4)
        assert views.intrinsics.focal == pytest.approx(focal_length(ANGLE, resolution))
        for i in range(5):
            # Enlarged by whole pixels, the picture divides into blocks again.
            enlarged = rgba(i).repeat(resolution, axis=0).repeat(resolution, axis=1)
            found = views.images[i].numpy()
            assert np.abs(found - box_average(enlarged, 12)).max() <= 1, resolution
            assert (found[..., :3] <= found[..., 3:]).all(), resolution


def test_other_kinds_of_pixels_are_converted(tmp_path):
    path = tmp_path / "image.png"
    for mode in ("L", "LA", "P", "1", "RGB", "RGBA"):
        original = Image.fromarray(rgba(0)).convert(mode)
        original.save(path)
        straight = np.asarray(original.convert("RGBA"))
        found = load_images([path], None)[0].numpy()
        assert np.abs(found - box_average(straight, 1)).max() <= 0.5 + 1e-4, mode
    # Entries of a palette may be transparent.
    palette = Image.new("P", (2, 1))
    palette.putpalette([255, 0, 0, 0, 0, 255])
    palette.putdata([0, 1])
    palette.save(path, transparency=0)
    assert load_images([path], None)[0, 0].tolist() == [[0] * 4, [0, 0, 255, 255]]
    # Grey of 16 bits keeps its range.
    save(path, np.array([[0, 257, 32768, 65535]], np.uint16))
    channels = load_premultiplied(path)
    assert channels[0, 0].tolist() == pytest.approx([0, 1, 127.502, 255], abs=1e-3)
    assert (channels[3] == 255).all()


def test_cmyk_is_read_and_lab_refused(scene):
    Image.new("CMYK", (12, 12), (0, 255, 255, 0)).save(scene.path / "train" / "r_1.jpg")
    scene.change(1, file_path="train/r_1.jpg")
    assert scene.train().image(1)[0, 0].tolist() == pytest.approx([255, 0, 0, 255], abs=2)
    Image.new("LAB", (12, 12)).save(scene.path / "train" / "r_1.tif")
    scene.change(1, file_path="train/r_1.tif")
    scene.refused("r_1.tif", "LAB", "RGBA")


@pytest.mark.parametrize(("split", "splits"), [("test", ["train", "test"]), ("video", ["train"])])
def test_frames_without_times_do_not_pass_for_those_of_time_zero(scene, split, splits):
    scene.add(split, 3, fixed=split == "video").change_each(split, time=...)
    scene.refused(f"transforms_{split}.json", "Give every frame its time", splits=splits)
    scene.change_each(time=...)
    scene.change(1, transform_matrix=scene.frames()[0]["transform_matrix"])
    assert scene.train(splits=splits).times.tolist() == [0] * 5


@pytest.mark.parametrize(
    ("write", "found"),
    [
        (lambda time: {"time": round(40 * time)}, lambda time: time),
        (lambda time: {"time": 2 * time - 1}, lambda time: time),
        (lambda time: {"timestamp": 1000 + 3 * time}, lambda time: time),
        (lambda time: {"time": 1.25 * time}, lambda time: time),
        (lambda time: {"time": 0.5 * time}, lambda time: 0.5 * time),
    ],
    ids=["numbers", "from -1 to 1", "a clock", "beyond 1", "half of the span"],
)
def test_times_of_all_splits_are_mapped_together(tmp_path, write, found):
    scene = SceneFolder(tmp_path / "ball")
    expected = {"train": [0, 0.2, 0.4, 0.6, 0.8], "val": [0.1, 0.5, 0.7], "test": [0, 1]}
    for split, times in expected.items():
        scene.add(split, len(times))
        for index, time in enumerate(times):
            scene.change(index, split, **{"time": ..., **write(time)})
    is_mapped = scene.frames("test")[-1].get("time") != 0.5
    with told("is mapped to times from 0 to 1" if is_mapped else None):
        parts = scene.read(("train", "val")).splits | scene.read(("test",)).splits
    for split, views in parts.items():
        assert views.times.tolist() == pytest.approx([found(time) for time in expected[split]])


def test_numbers_in_names_are_the_times_of_an_animation_without_others(tmp_path):
    scene = SceneFolder(tmp_path / "ball")
    for split, count in (("train", 5), ("test", 3)):
        scene.add(split, count)
        for index in range(count):
            scene.change(index, split, time=...)
    assert scene.train().times.tolist() == [0] * 5
    parts = scene.read(("train", "test"), static=False)
    assert parts.splits["train"].times.tolist() == pytest.approx([0, 0.25, 0.5, 0.75, 1])
    assert parts.splits["test"].times.tolist() == pytest.approx([0, 0.25, 0.5])
    assert "numbers in their names" in parts.notes["times"]
    # BlenderNeRF lists cameras that it does not render.
    first = scene.frames("test")[0]
    names = [f"./test/r_{9 + index}" for index in range(9)]
    scene.contents["test"]["frames"] += [{**first, "file_path": name} for name in names]
    with told("9 of 12 frames are left out"):
        parts = scene.read(("train", "test"), static=False)
    assert parts.splits["train"].times.tolist() == pytest.approx([0, 0.25, 0.5, 0.75, 1])


@pytest.mark.parametrize("time", [..., None])
def test_a_frame_without_a_time_is_left_out(scene, time):
    scene.change(1, time=time)
    with told('1 of 5 frames are left out:(.|\n)*frame 1 .*has no "time", but 4 of 5'):
        assert len(scene.train()) == 4


def test_a_video_is_read_and_can_be_trained_on(scene):
    how = settings(BlenderSettings, "blender", scene.path)
    train_on_video = replace(how, train_on_video=True)
    refused(train_on_video.read, "no video of a fixed camera.*set it to false")
    scene.add("test", 3).add("video", 3, fixed=True)
    video = scene.read(resolution=6).video
    assert video.images.shape == (3, 6, 6, 4)
    assert video.times.tolist() == [0, 0.5, 1]
    for used, count in ((how, 5), (train_on_video, 5 + 3)):
        splits = used.read().splits
        assert [len(splits[name]) for name in ("train", "test")] == [count, 3]
    assert len(train_on_video.read().video) == 3
    scene.change(1, "video", transform_matrix=pose(1))
    scene.refused("transforms_video.json", "moves")


def test_few_views_spread_over_time(scene):
    scene.add("val", 3)
    for count, expected in ((1, [0]), (2, [0, 4]), (3, [0, 2, 4]), (4, [0, 1, 3, 4])):
        result = scene.read(["train", "val"], views=count)
        files = tuple(f"train/r_{i}.png" for i in expected)
        assert result.splits["train"].files == files, count
        assert len(result.splits["val"]) == 3, count
    assert len(scene.train(views=5)) == 5
    scene.refused("data.views=6, but the train split", "1 to 5", views=6)
    # Scored views may be fewer than asked for, as splits differ in how many they have.
    for most, files in ((6, [0, 1, 2]), (2, [0, 2])):
        val = scene.read(["train", "val"], eval_views=most).splits["val"]
        assert val.files == tuple(f"val/r_{i}.png" for i in files)
    # Times decide, not the order of the files.
    for index, time in enumerate([0.5, 1, 0, 0.75, 0.25]):
        scene.change(index, time=time)
    assert sorted(scene.train(views=3).times.tolist()) == [0, 0.5, 1]


# What is refused, left out or told


def test_missing_folder_names_its_neighbours_and_the_ways_out(scene):
    root = scene.path.parent
    for path, *words in (
        ("bal", f"{root}/bal does not exist", "ball", "xplanes download dnerf", "data=demo"),
        ("ball/transforms_train.json", "is not a folder", "xplanes inspect FOLDER"),
        (".", f"holds no transforms_train.json. Such scenes in {root}: ball."),
        ("ball/train", r"holds no transforms_train.json\. Set data\.root and data\.scene"),
    ):
        scene.path = root / path
        refused(scene.load, *words)


def test_missing_split(scene):
    words = ("transforms_test.json", "Splits of this scene: train. Move some of its frames")
    assert "data.eval_split" not in scene.refused(*words, splits=["test"])
    scene.add("val", 2)
    words = ("transforms_test.json", "train, val", "Leave data.eval_split out")
    scene.refused(*words, splits=["train", "test"])


@pytest.mark.parametrize(
    ("words", "texts"),
    [
        ("JSON", ["{", "", "\x80", "[" * 100000]),
        ("frames", ["[]", "3", '{"camera_angle_x": 1}', '{"frames": []}', '{"frames": 3}']),
    ],
)
def test_files_that_are_no_json_or_hold_no_frames(scene, words, texts):
    for text in texts:
        (scene.path / "transforms_train.json").write_bytes(text.encode("latin-1"))
        refused(scene.load, "transforms_train.json", words, case=text[:10])


def test_damaged_images_are_refused_and_empty_ones_told_of(scene):
    whole = scene.image(2).read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    for content in (whole[: len(whole) // 2], bytes(flipped), b"no image"):
        scene.image(2).write_bytes(content)
        scene.refused("r_2.png", "cannot be decoded", case=content[:8])
    save(scene.image(2), 0 * rgba(2))
    with told(r"1 of 5 images show nothing.*r_2\.png"):
        scene.read()


def test_frames_that_cannot_be_used_are_left_out_and_named(scene):
    scene.image(2).unlink()
    scene.image(4).write_bytes(b"")
    scene.frames()[1]["transform_matrix"][0][3] = float("inf")
    scene.change(3, transform_matrix=...)
    words = r"(?s)4 of 5 .* left out:.*frame 1 .*infinity.*r_2\): no image.*has no transform_mat"
    with told(words + ".*r_4.png holds 0 bytes"):
        assert scene.train().files == ("train/r_0.png",)
    for path in (scene.path / "train").iterdir():
        path.unlink()
    message = scene.refused("no image")
    assert len(re.findall("no image|infinity|has no transform_matrix", message)) == 5


def test_all_that_is_wrong_is_said_at_once(scene):
    scene.change(1, transform_matrix=3)
    scene.change(2, file_path=3)
    scene.refused("frame 1", "frame 2")


@pytest.mark.parametrize("kind", ["no frames", "no images"])
def test_a_split_that_was_not_rendered_is_left_out(scene, kind):
    for split in ("test", "val"):
        scene.add(split, 0 if kind == "no frames" else 5)
        shutil.rmtree(scene.path / split, ignore_errors=True)
    config = changed((), "data=blender", f"data.root={scene.path.parent}")
    given = {**config["data"], "scene": scene.path.name, "resolution": None}
    with pytest.warns(UserWarning, match="The (test|val) split is left out"):
        splits = build(given, SceneSettings, "data").read().splits
    assert splits.keys() == {"train", "val"}


def test_resolutions_that_images_do_not_have(scene):
    count = len(scene.frames())
    with told(f"data.resolution=13 is more than .* {count} of {count} .* at most 12"):
        assert scene.train(resolution=13).size(0) == (12, 12)
    save(scene.image(3), rgba(0, 8)[:6])
    assert scene.train(resolution=4).size(3) == (3, 4)
    with told(f"data.resolution=9 .* 1 of {count} .*r_3.png is 8 pixels wide. Set at most 8"):
        views = scene.train(resolution=9)
    assert [views.size(2), views.size(3)] == [(9, 9), (6, 8)]
    # A video needs frames of equal size.
    read = partial(load_images, [scene.image(0), scene.image(3)], None)
    refused(read, "r_3.png has 8x6", "r_0.png has 12x12")


@pytest.mark.parametrize(
    "name",
    [
        *("{}/train/r_1.png", "/elsewhere/ball/train/r_1", "C:\\ball\\train\\r_1.png"),
        *("train/R_1.JPG", "train/r_1", ".\\train\\r_1", "./train/../train/r_1.png"),
    ],
)
def test_other_names_of_an_image_find_it(scene, name):
    expected = scene.train()
    scene.change(1, file_path=name.format(scene.path))
    views = scene.train()
    assert views.files == expected.files
    assert torch.equal(views.image(1), expected.image(1))


def test_images_of_another_split_are_not_found_for_those_that_are_missing(scene):
    scene.add("test", 2)
    (scene.path / "train").rename(scene.path / "images")
    shutil.rmtree(scene.path / "test")
    scene.change_each(file_path=lambda name: name.replace("train/", "images/"))
    with told(r"test split is left out.*test/r_0\): no image"):
        scene.refused("no image", splits=["train", "test"], error=MissingSplitError)
    scene.change_each("test", file_path=lambda name: f"C:\\ball\\{name}".replace("test", "images"))
    with told(
        r"2 of 2 images of the test split, such as C:/ball/images/r_0, are files of training"
    ):
        scene.read(["train", "test"])


def test_links_are_followed(scene):
    outside, elsewhere = (scene.path.parent / name for name in ("outside.png", "elsewhere"))
    scene.image(1).rename(outside)
    try:
        scene.image(1).symlink_to(outside)
    except OSError:
        pytest.skip("this system does not let the test make links")
    assert scene.train().files[1] == "train/r_1.png"
    (scene.path / "train").rename(elsewhere)
    (scene.path / "train").symlink_to(elsewhere)
    assert len(scene.train()) == 5


def test_lenses_are_read_from_the_file_and_its_frames(scene):
    scene.change(fl_x=30, k1=-0.1, p1=0.01, camera_model="OPENCV")
    scene.change(1, k1=0.05)
    scene.change(2, camera_model="OPENCV_FISHEYE", k1=0.02, k4=0.001, p1=0)
    scene.change(3, is_fisheye=True, sx1=0.003, sy1=0.004)
    scene.change(4, camera_model="FOV", omega=0.8)
    lenses = scene.train(resolution=6).intrinsics.lenses
    assert lenses.model.tolist() == [0, 0, 1, 1, 2]
    named = [
        {name: value for name, value in zip(COEFFICIENTS, row, strict=True) if value}
        for row in lenses.coefficients.tolist()
    ]
    assert named == [
        {"k1": -0.1, "p1": 0.01},
        {"k1": 0.05, "p1": 0.01},
        {"k1": 0.02, "k4": 0.001},
        {"k1": -0.1, "p1": 0.01, "s1": 0.003, "s3": 0.004},
        {"k1": 0.8},
    ]
    scene.change(camera_model="FULL_OPENCV", k4=0.3)
    assert scene.train().intrinsics.lenses.coefficients[0, 3] == 0.3


def test_a_lens_that_folds_inside_its_images(scene):
    scene.change(fl_x=6, k1=-0.4)
    scene.refused("r_0.png", "perspective lens with k1=-0.4", "row 0", "undistort")
    # Barely outside the corners it does no harm; half a fisheye's circle is dark, which it may be.
    scene.change(fl_x=16)
    scene.read()
    scene.change(fl_x=1.5, k1=0, is_fisheye=True)
    views = scene.train()
    assert not views.image(0)[:2, :2].any()
    assert views.image(4)[8, 5:7, 3].min() == 255
    assert not views.valid()[0, 0, 0]


# Masks


def test_images_without_a_mask_among_others_are_told_of(scene):
    save(scene.path / "mask.png", np.tri(12, dtype=np.uint8) * 255)
    for index in range(4):
        scene.change(index, mask_path="mask.png")
    with told(r"no mask of 1 of 5 images, which are shown whole: train/r_4\.png"):
        scene.read(mask_use="ignore")


def test_masks_become_alpha(scene):
    grey = np.full((12, 12), 255, np.uint8)
    grey[:, :3], grey[:, 6:9] = 0, 51
    straight = rgba(0)
    straight[..., 3] = 255
    save(scene.image(1), straight)
    whole = scene.train().image(0)
    expected = straight * (grey[..., None] / 255)
    for values in (np.stack([grey] * 3, axis=2), grey):
        save(scene.path / "mask.png", values)
        scene.change(1, mask_path="mask.png")
        views = scene.train(mask_use="alpha")
        assert np.abs(views.image(1).numpy() - expected).max() <= 0.5 + 1e-4
        assert torch.equal(views.image(0), whole)
    # A mask is averaged with its image.
    expected = expected.reshape(4, 3, 4, 3, 4).mean(axis=(1, 3))
    for key in ("mask_path", "fg_mask_path"):
        scene.change(1, mask_path=...)
        scene.change(1, **{key: "mask.png"})
        found = scene.train(resolution=4, mask_use="alpha").image(1).numpy()
        assert np.abs(found - expected).max() <= 0.5 + 1e-3


def test_masks_mean_the_same_whichever_parts_are_read(scene):
    """A file that is the mask of several images is no silhouette, not even that of a lone one."""
    scene.add("test", 1)
    bars = np.zeros((12, 12), np.uint8)
    bars[4:8] = 255
    save(scene.path / "mask.png", bars)
    for split in ("train", "test"):
        scene.change(split=split, mask_path="mask.png")
    for splits in (["train", "test"], ["test"], ["train"]):
        shown = scene.read(splits, views=1).splits[splits[-1]].shown(0)
        assert torch.equal(shown, torch.from_numpy(bars > 0)), splits
    scene.change(split="test", mask_path=...)
    assert scene.read(["test"], mask_use="lrm").splits["test"].ignored is None
    scene.change(mask_path=...)
    scene.refused("no training image has a mask file", mask_use="lrm")


def test_masks_of_the_video_mean_what_those_of_other_images_do(scene):
    scene.add("video", 3, fixed=True)
    bars = np.zeros((12, 12), np.uint8)
    bars[4:8] = 255
    for split in ("train", "video"):
        for index in range(len(scene.frames(split))):
            save(scene.path / split / f"dynamic_mask_r_{index}.png", bars)
    found = scene.read()
    for views in (found.splits["train"], found.video):
        assert torch.equal(views.shown(0), torch.from_numpy(bars == 0))
        assert views.image(0)[bars == 0][:, 3].any()


MATRIX = np.array(pose(1))
REFUSED_FRAMES = [
    ("file_path", ..., '"file_path"'),
    *(("file_path", name, "file_path") for name in (3, "train/r_1\0")),
    *(("file_path", name, "leaves the scene's folder") for name in ("../outside", "a/../../b")),
    *(
        ("transform_matrix", matrix, "4 rows of 4 numbers")
        for matrix in ([[1, 0], [0, 1]], "identity", [[1, 2, 3, 4]] * 2, [[[]]])
    ),
    ("transform_matrix", MATRIX.T.tolist(), "last row"),
    ("transform_matrix", (MATRIX @ np.diag([1.01, 1, 1, 1])).tolist(), "not orthonormal"),
    ("transform_matrix", (MATRIX * [-1, 1, 1, 1]).tolist(), "determinant -1"),
    *(("time", time, "must be a number") for time in (math.nan, math.inf, "soon", [0.5], True)),
    ("mask_path", "../low.png", "mask_path leaves the scene's folder"),
    ("mask_path", 3, "it must be text"),
]
"""Key of a frame, a value that it cannot have, and what is said of it."""

REFUSED_FILES = [
    *(
        ({"camera_angle_x": angle}, "between 0 and pi")
        for angle in (0, -1, math.pi, math.nan, "wide", None, True)
    ),
    *(
        ({"camera_angle_x": ..., **other}, 'no "camera_angle_x".*fl_x and w')
        for other in ({}, {"w": 12}, {"fl_x": 0, "w": 12}, {"fl_x": None}, {"fl_y": 30})
    ),
    *(
        ({"fl_x": 30, key: value}, f"{key} is .*in pixels, or be left out")
        for key, value in {"fl_x": "30 mm", "fl_y": math.inf, "cx": [], "w": "a"}.items()
    ),
    ({"fl_x": -3}, "fl_x is .*in pixels, or be left out"),
]
"""Keys of a file, and what is said of them."""

REFUSED_LENSES = [
    ({"p2": "a"}, "p2 is 'a'; a distortion coefficient must be a number"),
    ({"ftheta_p0": 0.0, "ftheta_p1": 1e-3}, "ftheta_p0=0.0 is not a lens"),
    ({"camera_model": "EQUIRECTANGULAR"}, "camera_model=EQUIRECTANGULAR.*undistort"),
    ({"camera_model": "FISHEYE624", "fl_x": 9}, "camera_model=FISHEYE624"),
    ({"latlong": True}, "latlong=True"),
    ({"camera_model": "OPENCV_FISHEYE"}, 'fisheye lens needs "fl_x"'),
    ({"camera_model": "FOV", "fl_x": 9}, 'FOV needs "omega"'),
    ({"camera_model": "FOV", "fl_x": 9, "omega": 4}, "not 4"),
]
"""Keys of a file or of a frame, and what is said of them."""


def test_values_that_keys_cannot_have_are_refused_by_their_key(scene):
    whole = json.dumps(scene.contents["train"])
    for index, changes, words in [
        *((1, {key: value}, words) for key, value, words in REFUSED_FRAMES),
        *((None, changes, words) for changes, words in REFUSED_FILES + REFUSED_LENSES),
        *((1, changes, words) for changes, words in REFUSED_LENSES),
    ]:
        scene.contents["train"] = json.loads(whole)
        scene.change(index, **changes)
        scene.refused(words, "frame 1" if index else "", case=changes)


def test_a_world_on_its_side_is_told_of(scene):
    lying = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    scene.change_each(transform_matrix=lambda matrix: (lying @ matrix).tolist())
    with told("mean up vector is .* degrees off. If the scene lies on"):
        scene.read()


def test_the_same_view_twice_or_a_mask_of_another_size(scene):
    third, first = dict(scene.frames()[3]), scene.frames()[1]
    for changes, words in (
        ({"file_path": "train/r_1.png"}, "same file"),
        ({"time": 0.25, "transform_matrix": first["transform_matrix"]}, "same camera and time"),
    ):
        scene.change(3, **(third | changes))
        scene.refused(f"frame 3.*{words}.*frame 1")
    scene.change(3, **first)
    with told(r"frame 3 \(.*r_1\) is listed before, as frame 1"):
        assert len(scene.train()) == 4
    scene.change(3, **third)
    whole = json.dumps(scene.contents)
    scene.change(3, transform_matrix=first["transform_matrix"])
    scene.change_each(time=0.0)  # A turntable may end where it began.
    assert len(scene.train()) == 5
    scene.contents = json.loads(whole)
    save(scene.path / "low.png", np.full((9, 12), 255, np.uint8))
    scene.change(1, mask_path="low.png")
    scene.refused("12x9 pixels.*r_1.png, whose mask it is, has 12x12")
