import json
import math
import re
import warnings
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

from tests.captures import settings
from tests.refusals import assert_refused
from xplanes.components import build
from xplanes.config import compose_plain
from xplanes.errors import SceneError
from xplanes.scenes.cameras import focal_length, look_at
from xplanes.scenes.dnerf import BlenderSettings
from xplanes.scenes.images import load_images, load_premultiplied
from xplanes.scenes.lenses import COEFFICIENTS
from xplanes.scenes.source import SceneSettings

ANGLE = 0.7


def picture(seed, size=12):
    """Straight RGBA with soft and fully transparent parts. uint8 [size, size, 4]"""
    values = np.random.default_rng(seed).integers(0, 256, (size, size, 4), dtype=np.uint8)
    values[: size // 3, :, 3] = 0
    values[-size // 3 :, :, 3] = 255
    return values


def pose(index):
    angle = 0.3 + index
    place = torch.tensor([[4 * math.cos(angle), 4 * math.sin(angle), 1.0]], dtype=torch.float64)
    return look_at(place)[0].tolist()


def read_scene(folder, splits, **changes):
    return settings(BlenderSettings, "blender", folder, **changes).load(splits)


class SceneFolder:
    """A small scene on disk whose transforms can be changed before it is read."""

    def __init__(self, path):
        self.path = path
        self.contents = {}

    def add(self, split, count, *, size=12, fixed=False):
        (self.path / split).mkdir(parents=True)
        frames = []
        for i in range(count):
            Image.fromarray(picture(i, size)).save(self.path / split / f"r_{i}.png")
            time = i / max(count - 1, 1)
            matrix = pose(0 if fixed else i)
            frames.append(
                {"file_path": f"./{split}/r_{i}", "time": time, "transform_matrix": matrix}
            )
        self.contents[split] = {"camera_angle_x": ANGLE, "frames": frames}
        self.write(split)
        return self

    def frame(self, index, split="train"):
        return self.contents[split]["frames"][index]

    def write(self, split="train"):
        text = json.dumps(self.contents[split])
        (self.path / f"transforms_{split}.json").write_text(text)

    def read(self, resolution=None, splits=("train",), **counts):
        return read_scene(self.path, splits, resolution=resolution, **counts)

    def error(self, case=None, **arguments):
        return assert_refused(SceneError, "", partial(self.read, **arguments), case)


@pytest.fixture
def scene(tmp_path):
    return SceneFolder(tmp_path / "ball").add("train", 5)


def box_average(straight, factor):
    """Independent reference: premultiplied float64 block means, from 0 to 255. [H, W, 4]"""
    pixels = straight.astype(np.float64)
    pixels[..., :3] *= pixels[..., 3:] / 255
    rows, columns = pixels.shape[0] // factor, pixels.shape[1] // factor
    result = np.zeros((rows, columns, 4))
    for row in range(rows):
        for column in range(columns):
            block = pixels[row * factor : (row + 1) * factor]
            result[row, column] = block[:, column * factor : (column + 1) * factor].mean((0, 1))
    return result


# What a sound scene becomes


def test_reads_images_cameras_and_times(scene):
    scene.add("val", 2)
    result = scene.read(splits=["train", "val", "train"])
    views = result.splits["train"]
    assert result.name == "ball"
    assert list(result.splits) == ["train", "val"]
    assert result.video is None
    assert views.files == tuple(f"train/r_{i}.png" for i in range(5))
    assert views.times.tolist() == [0, 0.25, 0.5, 0.75, 1]
    assert views.intrinsics.focal == pytest.approx(focal_length(ANGLE, 12))
    assert views.images.dtype == torch.uint8
    for i in range(5):
        torch.testing.assert_close(views.camera_to_world[i], torch.tensor(pose(i)))
        error = np.abs(views.images[i].numpy() - box_average(picture(i), 1)).max()
        assert error <= 0.5 + 1e-4


def test_reduced_images_average_the_premultiplied_area_that_a_pixel_covers(scene):
    for resolution in (1, 4, 5, 6, 7, 8, 11):
        views = scene.read(resolution=resolution).splits["train"]
        assert views.images.shape == (5, resolution, resolution, 4)
        assert views.intrinsics.focal == pytest.approx(focal_length(ANGLE, resolution))
        for i in range(5):
            # Enlarged by whole pixels, the picture divides into blocks again.
            enlarged = picture(i).repeat(resolution, axis=0).repeat(resolution, axis=1)
            found = views.images[i].numpy()
            assert np.abs(found - box_average(enlarged, 12)).max() <= 1, resolution
            assert (found[..., :3] <= found[..., 3:]).all(), resolution


def test_hidden_colour_does_not_bleed(tmp_path):
    straight = np.zeros((4, 4, 4), np.uint8)
    straight[..., 0] = 255  # red everywhere, though only the left column is visible
    straight[:, 0, 3] = 255
    Image.fromarray(straight).save(tmp_path / "red.png")
    pixels = load_images([tmp_path / "red.png"], 2)[0]
    assert pixels[0, 0].tolist() == [128, 0, 0, 128]
    assert pixels[0, 1].tolist() == [0, 0, 0, 0]


def test_other_kinds_of_pixels_are_converted(tmp_path):
    for mode in ("L", "LA", "P", "1", "RGB", "RGBA"):
        original = Image.fromarray(picture(0)).convert(mode)
        original.save(tmp_path / "image.png")
        straight = np.asarray(original.convert("RGBA"))
        found = load_images([tmp_path / "image.png"], None)[0].numpy()
        assert np.abs(found - box_average(straight, 1)).max() <= 0.5 + 1e-4, mode


def test_transparent_palette_entries_stay_transparent(tmp_path):
    palette = Image.new("P", (2, 1))
    palette.putpalette([255, 0, 0, 0, 0, 255])
    palette.putdata([0, 1])
    palette.save(tmp_path / "image.png", transparency=0)
    assert load_images([tmp_path / "image.png"], None)[0, 0].tolist() == [[0] * 4, [0, 0, 255, 255]]


def test_sixteen_bit_grey_keeps_its_range(tmp_path):
    values = np.array([[0, 257, 32768, 65535]], np.uint16)
    Image.fromarray(values).save(tmp_path / "image.png")
    channels = load_premultiplied(tmp_path / "image.png")
    assert channels[0, 0].tolist() == pytest.approx([0, 1, 127.502, 255], abs=1e-3)
    assert (channels[3] == 255).all()


def test_cmyk_is_refused_with_a_message(scene):
    Image.new("CMYK", (12, 12)).save(scene.path / "train" / "r_1.jpg")
    scene.frame(1)["file_path"] = "train/r_1.jpg"
    scene.write()
    message = scene.error()
    assert "r_1.jpg" in message
    assert "CMYK" in message
    assert "RGBA" in message


def test_no_times_at_all_is_a_static_scene(scene):
    for frame in scene.contents["train"]["frames"]:
        del frame["time"]
    scene.frame(1)["transform_matrix"] = scene.frame(0)["transform_matrix"]
    scene.write()
    assert scene.read().splits["train"].times.tolist() == [0] * 5


def test_frames_without_times_do_not_pass_for_those_of_time_zero(tmp_path):
    for split, splits in (("test", ["train", "test"]), ("video", ["train"])):
        scene = SceneFolder(tmp_path / split).add("train", 5).add(split, 3, fixed=split == "video")
        for frame in scene.contents[split]["frames"]:
            del frame["time"]
        scene.write(split)
        message = scene.error(split, splits=splits)
        assert f"transforms_{split}.json" in message
        assert "Give every frame its time" in message, split
        for frame in scene.contents["train"]["frames"]:
            del frame["time"]
        scene.write()
        assert scene.read(splits=splits).splits["train"].is_static, split


@pytest.mark.parametrize(
    ("write", "found"),
    [
        (lambda time: {"time": round(40 * time)}, lambda time: time),
        (lambda time: {"time": 2 * time - 1}, lambda time: time),
        (lambda time: {"timestamp": 1000 + 3 * time}, lambda time: time),
        (lambda time: {"time": 1.25 * time}, lambda time: time),
        (lambda time: {"time": 0.5 * time}, lambda time: 0.5 * time),
    ],
)
def test_times_of_all_splits_are_mapped_together(tmp_path, write, found):
    scene = SceneFolder(tmp_path / "ball").add("train", 5).add("val", 3).add("test", 2)
    for split, times in (("train", [0, 0.2, 0.4, 0.6, 0.8]), ("val", [0.1, 0.5, 0.7])):
        for frame, time in zip(scene.contents[split]["frames"], times, strict=True):
            frame["time"] = time
    expected = {}
    for split, content in scene.contents.items():
        expected[split] = [found(frame["time"]) for frame in content["frames"]]
        for frame in content["frames"]:
            frame |= write(frame.pop("time"))
        scene.write(split)
    is_mapped = scene.frame(-1, "test").get("time") != 0.5
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        parts = [scene.read(splits=("train", "val")).splits, scene.read(splits=("test",)).splits]
    assert all("is mapped to times from 0 to 1" in str(each.message) for each in said)
    assert bool(said) is is_mapped
    for split, views in {**parts[0], **parts[1]}.items():
        assert views.times.tolist() == pytest.approx(expected[split]), split


@pytest.mark.parametrize("time", [..., None])
def test_a_frame_without_a_time_is_left_out(scene, time):
    scene.frame(1)["time"] = time
    if time is ...:
        del scene.frame(1)["time"]
    scene.write()
    words = '1 of 5 frames are left out:(.|\n)*frame 1 .*has no "time", but 4 of 5'
    with pytest.warns(UserWarning, match=words):
        assert len(scene.read().splits["train"]) == 4


def test_video_is_read_when_there_is_one(scene):
    scene.add("video", 3, fixed=True)
    video = scene.read(resolution=6).video
    assert video is not None
    assert video.images.shape == (3, 6, 6, 4)
    assert video.times.tolist() == [0, 0.5, 1]


def test_an_empty_image_is_only_a_warning(scene):
    Image.new("RGBA", (12, 12)).save(scene.path / "train" / "r_3.png")
    with pytest.warns(UserWarning, match=r"1 of 5 images show nothing.*r_3\.png"):
        scene.read()


def test_a_sound_scene_gives_no_warning(scene):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene.read(resolution=6)


def test_few_views_spread_over_time(scene):
    scene.add("val", 3)
    for count, expected in (
        (1, [0]),
        (2, [0, 4]),
        (3, [0, 2, 4]),
        (4, [0, 1, 3, 4]),
        (5, range(5)),
    ):
        result = scene.read(splits=["train", "val"], views=count)
        files = tuple(f"train/r_{i}.png" for i in expected)
        assert result.splits["train"].files == files, count
        assert len(result.splits["val"]) == 3, count
    # Times decide, not the order of the files.
    for index, time in enumerate([0.5, 1, 0, 0.75, 0.25]):
        scene.frame(index)["time"] = time
    scene.write()
    assert sorted(scene.read(views=3).splits["train"].times.tolist()) == [0, 0.5, 1]


def test_more_views_than_there_are(scene):
    message = scene.error(views=6)
    assert "data.views=6, but the train split" in message
    assert "1 to 5" in message
    # Of scored views that is the most: splits differ in how many they have.
    scene.add("val", 3)
    assert len(scene.read(splits=["train", "val"], eval_views=6).splits["val"]) == 3
    val = scene.read(splits=["train", "val"], eval_views=2).splits["val"]
    assert val.files == ("val/r_0.png", "val/r_2.png")


# What is refused


def test_missing_folder_names_its_neighbours_and_the_ways_out(scene):
    root = scene.path.parent
    scene.path = root / "bal"
    message = scene.error()
    assert str(scene.path) in message
    assert "does not exist" in message
    assert "ball" in message
    assert "xplanes download dnerf" in message
    assert "data=demo" in message
    scene.path = root / "ball" / "transforms_train.json"
    assert "is not a folder" in scene.error()
    scene.path = root
    assert f"holds no transforms_train.json. Such scenes in {root}: ball." in scene.error()


def test_missing_split(scene):
    message = scene.error(splits=["test"])
    assert "transforms_test.json" in message
    assert "Splits of this scene: train. Move some of its frames" in message
    assert "data.eval_split" not in message
    scene.add("val", 2)
    message = scene.error(splits=["train", "test"])
    assert "transforms_test.json" in message
    assert "train, val" in message
    assert "Leave data.eval_split out" in message


def test_broken_json(scene):
    for text in ("{", "", "\x80", "[" * 100000):
        (scene.path / "transforms_train.json").write_bytes(text.encode("latin-1"))
        message = scene.error(text[:10])
        assert "transforms_train.json" in message, text[:10]
        assert "JSON" in message, text[:10]


def test_no_frames(scene):
    for text in ("[]", "3", '{"camera_angle_x": 1}', '{"frames": []}', '{"frames": 3}'):
        (scene.path / "transforms_train.json").write_text(text)
        message = scene.error(text)
        assert "transforms_train.json" in message, text
        assert "frames" in message, text


def test_damaged_or_missing_image(scene):
    path = scene.path / "train" / "r_2.png"
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    for content in (whole[: len(whole) // 2], bytes(flipped), b"no image"):
        path.write_bytes(content)
        message = scene.error(content[:8])
        assert "r_2.png" in message, content
        assert "cannot be decoded" in message, content


def test_frames_that_cannot_be_used_are_left_out_and_named(scene):
    total = len(scene.contents["train"]["frames"])
    (scene.path / "train" / "r_2.png").unlink()
    scene.frame(1)["transform_matrix"][0][3] = float("inf")
    del scene.frame(3)["transform_matrix"]
    (scene.path / "train" / "r_4.png").write_bytes(b"")
    scene.write()
    words = r"(?s)4 of \d+ .* left out:.*frame 1 .*infinity.*r_2\): no image.*has no transform_mat"
    with pytest.warns(UserWarning, match=words + ".*r_4.png holds 0 bytes"):
        views = scene.read().splits["train"]
    assert len(views) == total - 4
    assert not {"train/r_1.png", "train/r_2.png", "train/r_4.png"} & {*views.files}
    for path in (scene.path / "train").iterdir():
        path.unlink()
    message = scene.error()
    assert "no image" in message
    assert len(re.findall("no image|infinity|has no transform_matrix", message)) == min(total, 5)


def test_all_that_is_wrong_is_said_at_once(scene):
    scene.frame(1)["transform_matrix"] = 3
    scene.frame(2)["file_path"] = None
    scene.write()
    message = scene.error()
    assert "frame 1" in message
    assert "frame 2" in message


@pytest.mark.parametrize("kind", ["no frames", "no images"])
def test_a_split_that_was_not_rendered_is_left_out(scene, kind):
    content = json.loads(json.dumps(scene.contents["train"]))
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("train", "never")
    content["frames"] = content["frames"][: 0 if kind == "no frames" else None]
    for split in ("test", "val"):
        (scene.path / f"transforms_{split}.json").write_text(json.dumps(content))
    config = compose_plain("train", ["data=blender", f"data.root={scene.path.parent}"])
    given = {**config["data"], "scene": scene.path.name, "resolution": None}
    settings = build(given, SceneSettings, "data")
    with pytest.warns(UserWarning, match="The (test|val) split is left out"):
        splits = settings.read().splits
    few = len(splits["train"]) < 16
    assert splits.keys() == ({"train", "val"} if few else {"train"})


def test_an_image_narrower_than_the_resolution(scene):
    Image.fromarray(picture(0, 8)[:6]).save(scene.path / "train" / "r_3.png")
    assert scene.read(resolution=4).splits["train"].size(3) == (3, 4)
    message = scene.error(resolution=9)
    assert "data.resolution=9 is more than the 8 pixels" in message
    assert "r_3.png" in message


def test_a_video_needs_frames_of_equal_size(scene):
    Image.fromarray(picture(0, 8)).save(scene.path / "train" / "r_3.png")
    paths = [scene.path / "train" / f"r_{i}.png" for i in (0, 3)]
    message = assert_refused(SceneError, "", partial(load_images, paths, None), None)
    assert "r_3.png has 8x8" in message
    assert "r_0.png has 12x12" in message


def test_impossible_resolution(scene):
    message = scene.error(resolution=13)
    assert "data.resolution=13" in message
    assert "at most 12" in message


@pytest.mark.parametrize(
    "name",
    [
        *("{}/train/r_1.png", "/elsewhere/ball/train/r_1", "C:\\ball\\train\\r_1.png"),
        *("train/R_1.JPG", "train/r_1", ".\\train\\r_1", "./train/../train/r_1.png"),
    ],
)
def test_other_names_of_an_image_find_it(scene, name):
    expected = scene.read().splits["train"]
    scene.frame(1)["file_path"] = name.format(scene.path)
    scene.write()
    views = scene.read().splits["train"]
    assert views.files == expected.files
    assert torch.equal(views.image(1), expected.image(1))


def test_links_are_followed(scene):
    Image.fromarray(picture(0)).save(scene.path.parent / "outside.png")
    path = scene.path / "train" / "r_1.png"
    path.unlink()
    try:
        path.symlink_to(scene.path.parent / "outside.png")
    except OSError:
        pytest.skip("this system does not let the test make links")
    assert scene.read().splits["train"].files[1] == "train/r_1.png"
    (scene.path / "train").rename(scene.path.parent / "elsewhere")
    (scene.path / "train").symlink_to(scene.path.parent / "elsewhere")
    assert len(scene.read().splits["train"]) == len(scene.contents["train"]["frames"])


def test_lenses_that_are_not_read(scene):
    whole, frame = scene.contents["train"], dict(scene.frame(1))
    for other, words in (
        ({"p2": "a"}, "p2 is 'a'; a distortion coefficient must be a number"),
        ({"ftheta_p0": 0.0, "ftheta_p1": 1e-3}, "ftheta_p0=0.0 is not a lens"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model=EQUIRECTANGULAR.*undistort"),
        ({"camera_model": "FISHEYE624", "fl_x": 9}, "camera_model=FISHEYE624"),
        ({"latlong": True}, "latlong=True"),
        ({"camera_model": "OPENCV_FISHEYE"}, 'fisheye lens needs "fl_x"'),
        ({"camera_model": "FOV", "fl_x": 9}, 'FOV needs "omega"'),
        ({"camera_model": "FOV", "fl_x": 9, "omega": 4}, "not 4"),
    ):
        scene.contents["train"] = whole | other
        scene.write()
        assert_refused(SceneError, words, scene.read, other)
        scene.contents["train"] = whole
        scene.frame(1).update(other)
        scene.write()
        message = assert_refused(SceneError, words, scene.read, other)
        assert "frame 1" in message, words
        scene.contents["train"]["frames"][1] = dict(frame)


def test_lenses_are_read_from_the_file_and_its_frames(scene):
    scene.contents["train"] |= {"fl_x": 30, "k1": -0.1, "p1": 0.01, "camera_model": "OPENCV"}
    scene.frame(1).update({"k1": 0.05})
    scene.frame(2).update({"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k4": 0.001, "p1": 0})
    scene.frame(3).update({"is_fisheye": True, "sx1": 0.003, "sy1": 0.004})
    scene.frame(4).update({"camera_model": "FOV", "omega": 0.8})
    scene.write()
    lenses = scene.read(resolution=6).splits["train"].intrinsics.lenses
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
    scene.contents["train"] |= {"camera_model": "FULL_OPENCV", "k4": 0.3}
    scene.write()
    assert scene.read().splits["train"].intrinsics.lenses.coefficients[0, 3] == 0.3


def test_a_lens_that_folds_inside_its_images(scene):
    scene.contents["train"] |= {"fl_x": 6, "k1": -0.4}
    scene.write()
    message = scene.error()
    for words in ("r_0.png", "perspective lens with k1=-0.4", "row 0", "undistort"):
        assert words in message
    # Barely outside the corners it does no harm; half a fisheye's circle is dark, which it may be.
    scene.contents["train"] |= {"fl_x": 16}
    scene.write()
    scene.read()
    scene.contents["train"] |= {"fl_x": 1.5, "k1": 0, "is_fisheye": True}
    scene.write()
    views = scene.read().splits["train"]
    corner = views.image(0)[:2, :2]
    assert not corner.any()
    assert views.image(4)[8, 5:7, 3].min() == 255
    assert not views.valid()[0, 0, 0]


# Masks


def test_masks_of_a_car_bonnet_are_ignored(scene):
    mask = np.full((12, 12), 255, np.uint8)
    mask[9:] = 0
    Image.fromarray(mask).save(scene.path / "train" / "bonnet.png")
    for index in range(5):
        scene.frame(index)["mask_path"] = "train/bonnet.png"
    scene.write()
    views = scene.read().splits["train"]
    assert views.ignored[:, 9:].all()
    assert not views.ignored[:, :9].any()


def test_masks_become_alpha(scene):
    (scene.path / "masks").mkdir()
    mask = np.zeros((12, 12), np.uint8)
    mask[:, 3:] = 255
    mask[:, 6:9] = 51
    straight = picture(0)
    straight[..., 3] = 255
    for name, values in (("grey", mask), ("ones", mask // 255), ("rgb", mask[..., None] + [0] * 3)):
        Image.fromarray(values.astype(np.uint8)).save(scene.path / "masks" / f"{name}.png")
    Image.fromarray(straight).save(scene.path / "train" / "r_1.png")
    for name in ("grey", "rgb", "ones"):
        scene.frame(1)["mask_path"] = f"masks/{name}.png"
        scene.write()
        views = scene.read(mask_use="alpha").splits["train"]
        share = (mask if name != "ones" else mask // 255 * 255)[..., None] / 255
        assert np.abs(views.image(1).numpy() - straight * share).max() <= 0.5 + 1e-4, name
        assert torch.equal(views.image(0), scene.read(mask_use="alpha").splits["train"].image(0))
    # A mask is averaged with its image.
    scene.frame(1)["mask_path"] = "masks/grey.png"
    scene.write()
    masked = straight * (mask[..., None] / 255)
    masked[..., 3] = mask
    whole = np.concatenate([masked[..., :3], masked[..., 3:]], axis=2)
    expected = whole.reshape(4, 3, 4, 3, 4).mean(axis=(1, 3))
    found = scene.read(resolution=4, mask_use="alpha").splits["train"].image(1).numpy()
    assert np.abs(found - expected).max() <= 0.5 + 1e-3


def test_video_of_a_moving_camera(scene):
    scene.add("video", 3)
    message = scene.error()
    assert "transforms_video.json" in message
    assert "moves" in message


SINGULAR = np.array(pose(1)) @ np.diag([1.01, 1, 1, 1])
REFUSED_FRAMES = [
    ("file_path", ..., '"file_path"'),
    *(("file_path", name, "file_path") for name in (3, "", None, "train/r_1\0")),
    *(("file_path", name, "leaves the scene's folder") for name in ("../outside", "a/../../b")),
    *(
        ("transform_matrix", matrix, "4 rows of 4 numbers")
        for matrix in ([[1, 0], [0, 1]], "identity", [[1, 2, 3, 4]] * 2, [[[]]])
    ),
    ("transform_matrix", np.array(pose(1)).T.tolist(), "last row"),
    ("transform_matrix", SINGULAR.tolist(), "not orthonormal"),
    ("transform_matrix", (np.array(pose(1)) * [-1, 1, 1, 1]).tolist(), "determinant -1"),
    *(("time", time, "must be a number") for time in (math.nan, math.inf, "soon", [0.5], True)),
    ("mask_path", "../low.png", "mask_path leaves the scene's folder"),
    ("mask_path", 3, "it must be text"),
]
"""Key of a frame, a value that it cannot have, and what is said of it."""

REFUSED_FILES = [
    *(({"camera_angle_x": angle}, "between 0 and pi") for angle in (0, -1, math.pi, math.nan)),
    *(({"camera_angle_x": angle}, "between 0 and pi") for angle in ("wide", None, True)),
    *(
        ({"camera_angle_x": ..., **other}, 'no "camera_angle_x".*fl_x and w')
        for other in ({}, {"w": 12}, {"fl_x": 0, "w": 12}, {"fl_x": None}, {"fl_y": 30})
    ),
    *(
        ({"fl_x": 30, key: value}, f"{key} is .*in pixels, or be left out")
        for key, value in (
            ("fl_x", "30 mm"),
            ("fl_x", -3),
            ("fl_y", math.inf),
            ("cx", []),
            ("w", "a"),
        )
    ),
]
"""Keys of a file, and what is said of them."""


def test_values_that_keys_cannot_have_are_refused_by_their_key(scene):
    whole = json.dumps(scene.contents["train"])
    for key, value, words in REFUSED_FRAMES:
        scene.contents["train"] = json.loads(whole)
        scene.frame(1)[key] = value
        if value is ...:
            del scene.frame(1)[key]
        scene.write()
        message = assert_refused(SceneError, words, scene.read, (key, value))
        assert "frame 1" in message, (key, value)
    for changes, words in REFUSED_FILES:
        scene.contents["train"] = {**json.loads(whole), **changes}
        for key in [key for key, value in changes.items() if value is ...]:
            del scene.contents["train"][key]
        scene.write()
        assert_refused(SceneError, words, scene.read, changes)


def test_a_world_on_its_side_is_told_of(scene):
    for frame in scene.contents["train"]["frames"]:
        x, y, z, last = frame["transform_matrix"]
        frame["transform_matrix"] = [x, z, [-value for value in y], last]
    scene.write()
    with pytest.warns(UserWarning, match="mean up vector is .* degrees off. If the scene lies on"):
        scene.read()


def test_the_same_view_twice(scene):
    whole, first = dict(scene.frame(3)), scene.frame(1)
    for change, words in (
        ({"file_path": "train/r_1.png"}, "same file"),
        ({"time": 0.25, "transform_matrix": first["transform_matrix"]}, "same camera and time"),
    ):
        scene.frame(3).update(whole | change)
        scene.write()
        assert_refused(SceneError, f"frame 3.*{words}.*frame 1", scene.read, words)
    Image.new("L", (12, 9), 255).save(scene.path / "low.png")
    scene.frame(3).update(whole)
    first["mask_path"] = "low.png"
    scene.write()
    assert_refused(SceneError, "12x9 pixels.*r_1.png, whose mask it is, has 12x12", scene.read, "")
