"""Captures as nerfstudio and instant-ngp write them."""

import json
import logging
import math
import re
import unicodedata
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.balls import ball_views, surrounding
from tests.captures import settings
from tests.lens_oracle import direction
from tests.refusals import assert_refused
from xplanes.errors import MissingSplitError, SceneError
from xplanes.scenes import store
from xplanes.scenes.batches import RayBatches, ViewBatches, ViewSettings
from xplanes.scenes.datamodule import UNIFORM, whole_view
from xplanes.scenes.frame import scene_frame
from xplanes.scenes.nerfstudio import NerfstudioSettings
from xplanes.scenes.views import joined
from xplanes.streams import step_generator
from xplanes.training.scores import score_image

SIZE, ANGLE = 24, 0.7
FOCAL = 0.5 * SIZE / math.tan(0.5 * ANGLE)
PINHOLE = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 12.0, "cy": 12.0, "w": SIZE, "h": SIZE}


def read_capture(folder, splits, **changes):
    return settings(NerfstudioSettings, "nerfstudio", folder, **changes).load(splits)


class Capture:
    """A capture on disk: the images of a ball, and keys of the file and of its frames."""

    def __init__(self, path, count=10, **shared):
        self.path = path
        self.views = ball_views(count, 0.6, size=SIZE, angle=ANGLE)
        (path / "images").mkdir(parents=True)
        self.content = {**PINHOLE, "aabb_scale": 16, **shared, "frames": []}
        for index, pose in enumerate(self.views.camera_to_world.double().tolist()):
            name = f"images/frame_{index:05d}.png"
            # Alpha is 0 or 255: multiplied by it or not, colour is the same.
            Image.fromarray(self.views.image(index).numpy()).save(path / name)
            self.content["frames"].append({"file_path": name, "transform_matrix": pose})

    @property
    def frames(self):
        return self.content["frames"]

    def timed(self, times, key="time"):
        for frame, time in zip(self.frames, times, strict=True):
            frame[key] = time
        return self

    def read(self, splits=("train",), resolution=None, **options):
        (self.path / "transforms.json").write_text(json.dumps(self.content))
        return read_capture(self.path, splits, resolution=resolution, **options)

    def refused(self, words, case=None, error=SceneError, **options):
        return assert_refused(error, words, partial(self.read, **options), case)


@pytest.fixture
def capture(tmp_path):
    return Capture(tmp_path / "ball")


def numbers(views):
    return [int(file[-9:-4]) for file in views.files]


def test_a_capture_equals_what_it_was_written_from(capture):
    capture.timed([i / 9 for i in range(10)])
    scene = capture.read(("train", "val"))
    assert scene.name == "ball"
    parts = scene.splits
    assert sorted(numbers(parts["train"]) + numbers(parts["val"])) == list(range(10))
    for views in parts.values():
        for index, number in enumerate(numbers(views)):
            assert torch.equal(views.image(index), capture.views.image(number))
            assert views.times[index] == pytest.approx(number / 9)
            for mine, theirs in zip(
                views.image_rays(index), capture.views.image_rays(number), strict=True
            ):
                torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("keys", "model"),
    [
        ({"camera_model": "OPENCV", "k1": -0.2, "k2": 0.05, "p1": 0.01, "p2": -0.02}, None),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.15}, None),
        ({"camera_model": "FULL_OPENCV", "k1": 0.3, "k4": 0.2, "k5": 0.02}, None),
        ({"camera_model": "OPENCV", "k1": -0.05, "k3": 0.01, "k4": 0.004}, "polynomial"),
        ({"distortion_params": [0.1, 0.0, 0.01, 0.02, 0.001, -0.002]}, "polynomial"),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.03, "k2": 0.005, "k4": 1e-4}, "fisheye"),
        ({"is_fisheye": True, "k1": 0.03}, "fisheye"),
        ({"distortion_params": [0.15, 0.02, 0.0, 0.0, 0.001, -0.002]}, None),
    ],
)
def test_a_distorted_lens_gives_its_rays(tmp_path, keys, model):
    shared = {"fl_x": 20.0, "fl_y": 21.0, "cx": 11.0, "cy": 12.5, **keys}
    capture = Capture(tmp_path, 4, **shared)
    # One frame tells a lens of its own.
    capture.frames[2] |= {"fl_x": 25.0, "k1": 0.02}
    listed = keys.get("distortion_params", [0.0] * 6)
    numbers_of = dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), listed, strict=True))
    numbers_of |= {key: value for key, value in keys.items() if key[0] in "kp"}
    for resolution, scale in ((None, 1), (8, 1 / 3)):
        views = capture.read(resolution=resolution, eval_every=10).splits["train"]
        side = views.width
        for index, number in enumerate(numbers(views)):
            own = numbers_of | ({"k1": 0.02} if number == 2 else {})
            focal = (scale * (25 if number == 2 else 20), scale * 21)
            origins, found = views.image_rays(index)
            pose = capture.views.camera_to_world[number].double().numpy()
            for row, column in ((0, 0), (side // 2, side // 3), (side - 1, 1), (1, side - 1)):
                target, centre = (column + 0.5, row + 0.5), (11 * scale, 12.5 * scale)
                local = direction(model or "perspective", target, own, focal, centre, widest=1.4)
                expected = pose[:3, :3] @ np.array(local)
                ray = found[row * side + column].numpy()
                assert np.abs(ray - expected).max() < 1e-5, (number, row, column)
            assert np.abs(origins.numpy() - pose[:3, 3]).max() < 1e-6


def test_frames_are_held_out_at_even_ranks_of_time(capture):
    """Neither the first nor the last, whatever the order of the file."""
    capture.timed([(7 * i % 10) / 10 for i in range(10)])
    for every, expected in ((8, [0.4]), (4, [0.2, 0.6]), (3, [0.1, 0.4, 0.7]), (100, [])):
        parts = capture.read(eval_every=every).splits
        found = sorted(capture.frames[i]["time"] for i in numbers(parts["train"]))
        assert found == [i / 10 for i in range(10) if i / 10 not in expected], every
        if expected:
            val = capture.read(("val",), eval_every=every).splits["val"]
            assert sorted(round(time, 5) for time in val.times.tolist()) == expected
    capture.refused(
        r"no val split.*data\.eval_every=100",
        error=MissingSplitError,
        splits=("val",),
        eval_every=100,
    )
    capture.refused(
        r"no test split.*Splits of this capture: train, val.*data\.eval_split",
        error=MissingSplitError,
        splits=("test",),
    )
    # Without times, the names of the files decide.
    for frame in capture.frames:
        del frame["time"]
    capture.frames.reverse()
    assert numbers(capture.read(("val",), eval_every=4).splits["val"]) == [6, 2]
    assert capture.read().splits["train"].is_static


def test_lists_of_file_names_are_the_splits(capture):
    names = [frame["file_path"] for frame in capture.frames]
    capture.content |= {"train_filenames": names[3:], "test_filenames": [f"./{names[1]}"]}
    parts = capture.read(("train", "test")).splits
    assert numbers(parts["train"]) == list(range(3, 10))
    assert numbers(parts["test"]) == [1]
    capture.refused("no val split", error=MissingSplitError, splits=("val",))
    assert len(capture.read(views=3, splits=("train",)).splits["train"]) == 3
    whole = dict(capture.content)
    # Some tools list the same views for validation as for testing.
    capture.content |= {"val_filenames": [names[1], names[2]]}
    parts = capture.read(("val", "test")).splits
    assert [numbers(parts[split]) for split in ("val", "test")] == [[1, 2], [1]]
    for change, words in (
        ({"val_filenames": "a"}, "val_filenames is 'a', not a list"),
        ({"val_filenames": ["../x.png"]}, "val_filenames leaves the scene's folder"),
        ({"train_filenames": []}, "no frames to train on"),
    ):
        capture.content = whole | change
        capture.refused(words, change)
    capture.content = whole
    capture.content = whole | {"val_filenames": [names[2], names[3]]}
    with pytest.warns(UserWarning, match="1 of 2 views of val_filenames are in train_filenames"):
        parts = capture.read(("train", "val")).splits
    assert [numbers(parts[split]) for split in ("train", "val")] == [[3, 4, 5, 6, 7, 8, 9], [2, 3]]
    capture.content = whole
    capture.frames.pop(5)
    with pytest.warns(UserWarning, match=r"1 names.*\n.*frame_00005.png is in no frame"):
        assert numbers(capture.read().splits["train"]) == [3, 4, 6, 7, 8, 9]
    (capture.path / names[5]).unlink()
    with pytest.warns(UserWarning, match=r"1 names in lists .*\n.*train_filenames: .*no image"):
        assert numbers(capture.read().splits["train"]) == [3, 4, 6, 7, 8, 9]


def test_lists_and_frames_may_spell_a_missing_image_differently(capture):
    names = [frame["file_path"] for frame in capture.frames]
    capture.content |= {"train_filenames": [f"./{name}" for name in names]}
    (capture.path / names[5]).unlink()
    with pytest.warns(UserWarning, match="1 of 10 frames are left out") as told:
        assert numbers(capture.read().splits["train"]) == [0, 1, 2, 3, 4, 6, 7, 8, 9]
    assert len(told) == 1


@pytest.mark.parametrize("key", ["time", "timestamp"])
def test_times_in_any_unit_are_mapped_over_all_frames(capture, key, caplog):
    # Nanoseconds since 1970, which single precision cannot tell apart.
    capture.timed([1_700_000_000_000_000_000 + 33_000_000 * i for i in range(10)], key)
    with caplog.at_level(logging.INFO, logger="xplanes"):
        parts = capture.read(("train", "val")).splits
    assert f"{key} from 1700000000000000000 to 1700000000297000000" in caplog.text
    for views in parts.values():
        expected = [number / 9 for number in numbers(views)]
        assert views.times.tolist() == pytest.approx(expected, abs=1e-6)


def test_times_from_0_to_1_stay(capture, caplog):
    capture.timed([0.1 + i / 20 for i in range(10)])
    with caplog.at_level(logging.INFO, logger="xplanes"):
        views = capture.read().splits["train"]
    assert float(views.times.min()) == pytest.approx(0.1)
    assert "mapped" not in caplog.text
    capture.frames[4]["time"] = "soon"
    capture.refused("time is 'soon'; it must be a number")
    del capture.frames[4]["time"]
    with pytest.warns(UserWarning, match='out:\n.*frame 4.*has no "time", but 9 of 10'):
        capture.read()
    for frame in capture.frames[5:]:
        frame["time"] = None
    capture.refused('frame 4.*has no "time", but 4 of 10')


def label_masks():
    """Masks as programs write them; all mean the lower triangle."""
    inside = np.tri(SIZE, dtype=np.uint8)
    palette = Image.fromarray(inside, "P")
    palette.putpalette([0, 0, 0, 128, 0, 0])
    cut = np.full((SIZE, SIZE, 4), 90, np.uint8)
    cut[..., 3] = 255 * inside
    colours = np.zeros((SIZE, SIZE, 3), np.uint8)
    colours[inside > 0] = 220, 20, 60
    return {
        "black and white": Image.fromarray(inside * 255),
        "0 and 1": Image.fromarray(inside),
        "numbers of things": Image.fromarray(inside * 3),
        "16 bits": Image.fromarray(inside.astype(np.uint16) * 65535),
        "numbers in 16 bits": Image.fromarray(inside.astype(np.uint16) * 2),
        "palette": palette,
        "colours": Image.fromarray(colours),
        "alpha": Image.fromarray(cut),
    }


@pytest.mark.parametrize("kind", label_masks())
def test_masks_of_labels_colours_and_alpha_mean_what_they_show(capture, kind):
    label_masks()[kind].save(capture.path / "mask.png")
    for frame in capture.frames:
        frame["mask_path"] = "mask.png"
    views = capture.read(eval_every=100, mask_use="alpha").splits["train"]
    expected = capture.views.image(0) * torch.ones(SIZE, SIZE).tril()[..., None]
    assert torch.equal(views.image(0), expected.byte())


def masked(capture, values, ending="png", of=lambda index: True, **options):
    """Give frames a mask of grey values; the others get a black one."""
    for index, frame in enumerate(capture.frames):
        frame["mask_path"] = f"masks/{index}.{ending}"
        path = capture.path / frame["mask_path"]
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(values if of(index) else 0 * values).save(path, **options)


def band(rows=SIZE // 4):
    """A mask of the car bonnet that a camera sees at the bottom of every image."""
    values = np.full((SIZE, SIZE), 255, np.uint8)
    values[SIZE - rows :] = 0
    return values


def disc():
    """The silhouette of a thing in the middle."""
    row, column = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    return np.where(row**2 + column**2 < (0.4 * SIZE) ** 2, 255, 0).astype(np.uint8)


@pytest.mark.parametrize(("ending", "value"), [("png", 255), ("png", 1), ("jpg", 255)])
def test_pixels_that_masks_leave_out_are_neither_drawn_nor_scored(capture, caplog, ending, value):
    masked(capture, band() // 255 * value, ending, quality=95)
    shown = torch.from_numpy(band() > 0)
    for index, frame in enumerate(capture.frames):
        pixels = capture.views.image(index)
        pixels[~shown] = torch.tensor([255, 0, 255, 255], dtype=torch.uint8)
        Image.fromarray(pixels.numpy()).save(capture.path / frame["file_path"])
    with caplog.at_level("INFO"):
        scene = capture.read(eval_every=5)
    assert "masks leave out 25.0% of the pixels. They are taken for pixels to ignore" in caplog.text
    train = scene.splits["train"]
    assert torch.equal(train.image(0), capture.views.image(0)), "colours stay as they are"
    assert all(torch.equal(train.shown(index), shown) for index in range(len(train)))
    assert torch.equal(train.valid()[1], shown)
    assert torch.equal(train.subset(torch.tensor([2])).shown(0), shown)
    batches = RayBatches(train, scene_frame(train), UNIFORM, seed=0)
    colours = torch.cat([batches.draw(step)["target"] for step in range(3)])
    assert len(colours) > 500
    marked = (colours - torch.tensor([1.0, 0.0, 1.0])).abs().amax(dim=1) < 0.01
    assert not marked.any()
    view = ViewBatches(train, ViewSettings(background="white"), seed=0).draw(0)
    assert torch.equal(view["shown"].view(SIZE, SIZE), shown)


def test_scores_leave_ignored_pixels_out(capture):
    masked(capture, band())
    views = capture.read(("val",), eval_every=5).splits["val"]
    item = whole_view(views, 0, torch.ones(3))
    image = {"colour": item["target"].clone(), "opacity": torch.ones(SIZE, SIZE)}
    image["colour"][-SIZE // 4 :] = 0.5
    found = score_image(image, item)
    assert found.psnr == 100
    assert found.ssim > 0.8, "only windows beside the ignored pixels see them"
    image["colour"][0, 0] -= 0.1
    assert score_image(image, item).psnr < 60


def test_masks_that_look_like_silhouettes_bound_the_scene(capture, caplog):
    masked(capture, disc())
    Image.fromarray(np.roll(disc(), 1, axis=1)).save(capture.path / "masks/5.png")
    with caplog.at_level("INFO"):
        views = capture.read(eval_every=100).splits["train"]
    assert "They are taken for silhouettes" in caplog.text
    assert views.ignored is None
    assert not views.image(0)[0, 0, 3]
    ignoring = capture.read(eval_every=100, mask_use="ignore").splits["train"]
    assert torch.equal(ignoring.shown(0), torch.from_numpy(disc() > 0))


def test_rays_of_stored_images_leave_ignored_pixels_out(capture, monkeypatch, tmp_path):
    masked(capture, band())
    monkeypatch.setattr(store, "IN_MEMORY", 0)
    views = capture.read(eval_every=100, cache=str(tmp_path / "cache")).splits["train"]
    assert views.is_stored
    batches = RayBatches(views, scene_frame(views), UNIFORM, seed=0)
    for step in range(5):
        _, _, row, _, _ = batches._from_files(
            views.images, torch.rand(200, 3, dtype=torch.float64), step_generator(0, step)
        )
        assert int(row.max()) < SIZE - SIZE // 4


def test_images_that_masks_leave_out_whole_are_left_out(capture):
    masked(capture, band(), of=lambda index: index not in (2, 4))
    with pytest.warns(UserWarning, match=r"all pixels of 2 of 10 images: images/frame_00002\.png"):
        views = capture.read(eval_every=100).splits["train"]
    assert numbers(views) == [0, 1, 3, 5, 6, 7, 8, 9]
    assert len(views.ignored) == 8
    masked(capture, band())
    (held_out,) = numbers(capture.read(("val",), eval_every=9).splits["val"])
    masked(capture, band(), of=lambda index: index != held_out)
    given = settings(NerfstudioSettings, "nerfstudio", capture.path, eval_every=9)
    with pytest.warns(UserWarning, match=rf"all pixels of 1 of 1 images: .*0{held_out}\.png"):
        assert len(given.read().splits["val"]) == 9
    masked(capture, 0 * band())
    capture.refused("leave out all pixels of 9 of 9.*mask_use=alpha", mask_use="ignore")


def test_ignored_pixels_stay_ignored_among_other_views(capture):
    masked(capture, band())
    views = capture.read(eval_every=100).splits["train"]
    small = capture.read(eval_every=100, mask_use="lrm", resolution=8).splits["train"]
    both = joined(small, views)
    assert not both.ignored[:10].any()
    assert torch.equal(both.shown(13), views.shown(3))
    assert joined(small, small).ignored is None


def test_dim_values_of_noise_and_of_video_are_no_labels(capture):
    noise = np.random.default_rng(0).integers(0, 3, (SIZE, SIZE)).astype(np.uint8)
    masked(capture, noise)
    with pytest.warns(UserWarning, match="10 of 10 images show nothing"):
        capture.read(eval_every=100, mask_use="alpha")
    # Videos have black at 16 and white at 235.
    masked(capture, np.where(band() > 0, 235, 16).astype(np.uint8))
    views = capture.read(eval_every=100).splits["train"]
    assert torch.equal(views.shown(0), torch.from_numpy(band() > 0))


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_masks_of_instant_ngp_are_white_where_pixels_are_ignored(capture, ending):
    for frame in capture.frames:
        path = capture.path / frame["file_path"]
        Image.open(path).convert("RGB").save(path.with_suffix(f".{ending}"))
        frame["file_path"] = f"./images/{path.stem}.{ending}"
        Image.fromarray(255 - band()).save(path.with_name(f"dynamic_mask_{path.stem}.png"))
    scene = capture.read(eval_every=100)
    views = scene.splits["train"]
    assert torch.equal(views.shown(0), torch.from_numpy(band() > 0))
    assert scene.notes["masks"].startswith("leave out 25.0% of the pixels. They are taken for pix")


@pytest.mark.parametrize("name", ["{stem}.alpha.png", "{stem}.png.alpha.png"])
def test_alpha_beside_images_is_read(capture, name):
    for frame in capture.frames:
        path = capture.path / frame["file_path"]
        Image.fromarray(band()).save(path.with_name(name.format(stem=path.stem)))
    views = capture.read(eval_every=100).splits["train"]
    assert views.ignored is None
    assert not views.image(0)[band() == 0].any()


def test_a_missing_mask_is_not_the_image_itself(capture):
    masked(capture, band())
    for frame in capture.frames:
        frame["mask_path"] = f"masks/{Path(frame['file_path']).name}"
        name = f"masks/{int(frame['file_path'][-9:-4])}.png"
        (capture.path / name).rename(capture.path / frame["mask_path"])
    (capture.path / capture.frames[3]["mask_path"]).unlink()
    with pytest.warns(UserWarning, match="1 of 10 frames are left out:(.|\n)*frame 3.*no mask of"):
        assert len(capture.read(eval_every=100).splits["train"]) == 9


@pytest.mark.parametrize("name", ["mask/{}.png", "images/{}_mask.png", "Masks_2/{}.png"])
def test_masks_that_nothing_names_are_told_of(capture, name):
    for frame in capture.frames:
        path = capture.path / name.format(Path(frame["file_path"]).stem)
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(band()).save(path)
    folder = name.partition("/")[0]
    with pytest.warns(UserWarning, match=f"{folder}.* is not read.*data.masks={folder},"):
        assert capture.read().splits["train"].ignored is None


def test_one_mask_of_all_images_is_no_silhouette(capture):
    """Such as the circle that nerfstudio's own tool draws for fisheye images."""
    masked(capture, disc())
    with pytest.warns(UserWarning, match="silhouettes.*Both readings are possible.*=ignore if"):
        assert capture.read().splits["train"].ignored is None
    for frame in capture.frames:
        del frame["mask_path"]
    capture.content["mask_path"] = "masks/0.png"
    views = capture.read().splits["train"]
    assert torch.equal(views.shown(0), torch.from_numpy(disc() > 0))


def test_masks_that_hide_the_middle_may_be_inverted(capture):
    masked(capture, 255 - disc())
    with pytest.warns(UserWarning, match="Both readings.*Silhouettes are white where the scene is"):
        capture.read()


def test_masks_that_may_mean_either_are_asked_about(capture):
    masked(capture, band(5 * SIZE // 12))
    with pytest.warns(UserWarning, match=r"Both readings are possible.*data\.mask_use=alpha"):
        capture.read(eval_every=100)


def test_all_masks_of_a_capture_have_one_scale(capture):
    # In a frame without the thing, a lossy format makes values next to 0 of black.
    masked(capture, disc(), "jpg", of=lambda index: index != 3, quality=60)
    nearly = np.random.default_rng(0).integers(0, 3, (SIZE, SIZE)).astype(np.uint8)
    Image.fromarray(nearly).save(capture.path / "masks/3.jpg", quality=100)
    with pytest.warns(UserWarning, match="1 of 10 images show nothing"):
        views = capture.read(eval_every=100).splits["train"]
    assert not views.image(3).any()
    assert views.image(0)[SIZE // 2, SIZE // 2, 3] == 255


@pytest.mark.parametrize("count", [1, 2])
def test_of_very_few_frames_none_can_be_held_out(tmp_path, count):
    capture = Capture(tmp_path / "few", count)
    capture.refused("never held out", splits=("val",), error=MissingSplitError)


def test_a_mark_at_the_start_and_comments_are_read(tmp_path):
    capture = Capture(tmp_path, 4)
    expected = capture.read(eval_every=10).splits["train"].camera_to_world
    path = tmp_path / "transforms.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content), encoding="utf-8-sig")
    found = read_capture(tmp_path, ["train"], eval_every=10)
    assert torch.equal(found.splits["train"].camera_to_world, expected)
    text = json.dumps({"name": "http://x//y,]", "frames": content["frames"]}, indent=1)
    text = text.replace('"frames"', f'/* the\nlens */ {json.dumps(PINHOLE)[1:-1]}, // x\n "frames"')
    path.write_text(text[:-2] + ", # the end\n}")
    found = read_capture(tmp_path, ["train"], eval_every=10)
    assert torch.equal(found.splits["train"].camera_to_world, expected)
    content["distortion_params"] = [0.1, 0.0, 0.0, 0.0]
    path.write_text(json.dumps(content))
    with pytest.raises(SceneError, match="a list of the 6 numbers k1, k2, k3, k4, p1, p2"):
        read_capture(tmp_path, ["train"])


def test_keys_of_other_programs_change_nothing(capture):
    plain = capture.read().splits["train"]
    capture.content |= {
        "applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]],
        "applied_scale": 3.0,
        "scale": 0.33,
        "offset": [0.5, 0.5, 0.5],
        "ply_file_path": "sparse.ply",
        "orientation_override": "none",
        "k3": 0,
        "camera_angle_x": "?",
        "rolling_shutter": [0, 0, 0, 0],
    }
    for frame in capture.frames:
        frame |= {"colmap_im_id": 3, "sharpness": 10.0, "mask_path": None, "depth_file_path": "x"}
    found = capture.read().splits["train"]
    assert torch.equal(found.camera_to_world, plain.camera_to_world)
    assert torch.equal(found.images, plain.images)
    assert torch.equal(found.intrinsics.focal, plain.intrinsics.focal)
    capture.content["from_na"] = True
    capture.refused("from_na=True stands for poses with other axes")


def test_what_is_no_capture(tmp_path):
    Capture(tmp_path / "other").read()
    for name, words in (
        (".", r"holds no transforms\.json\. Such scenes in .*: other\. Set data\.root"),
        ("none", r"none does not exist\. Such scenes in .*: other.*xplanes inspect FOLDER"),
        ("other/images", r"holds no transforms\.json\. Set data\.root and data\.scene"),
    ):
        read = partial(read_capture, tmp_path / name, ["train"])
        assert_refused(SceneError, words, read, name)


def test_lenses_and_poses_of_many_cameras_stay_with_their_images(capture):
    """Views taken out, spread and held out keep the lens of their own frame."""
    for index, frame in enumerate(capture.frames):
        frame |= {"fl_x": 20.0 + index, "k1": 0.01 * (index + 1), "time": (3 * index % 10) / 10}
    parts = capture.read(("train", "val"), eval_every=3, views=4).splits
    for views in parts.values():
        for index, number in enumerate(numbers(views)):
            assert views.intrinsics.focal[index, 0] == 20 + number
            lens = views.intrinsics.lens(index)
            assert float(lens.coefficients[0, 0]) == pytest.approx(0.01 * (number + 1))
            expected = surrounding(10, 4.0)[number]
            torch.testing.assert_close(views.camera_to_world[index], expected)


def test_keys_that_are_not_read_are_named(capture):
    capture.content |= {"mask_color": [0, 0, 0], "envmap": "", "intrinsics": {"f": 9}}
    capture.frames[2]["rolling_shutter"] = [1, 0, 0, 0]
    words = "not read are 'intrinsics', 'mask_color', 'rolling_shutter'"
    with pytest.warns(UserWarning, match=words):
        capture.read()


def test_files_of_rays_beside_images_are_told_of(capture):
    for name in ("rays_frame_00003.dat", "rays_frame_00004.dat"):
        (capture.path / "images" / name).write_bytes(b"")
    with pytest.warns(UserWarning, match=r"rays in files beside 2 of 10 .*rays_frame_00003\.dat"):
        capture.read()
    capture.content["enable_ray_loading"] = False
    capture.read()


@pytest.mark.parametrize("level", [0, 255])
def test_a_colour_may_be_transparent(capture, level):
    expected = capture.read(eval_every=100).splits["train"]
    for index, frame in enumerate(capture.frames):
        pixels = capture.views.image(index).numpy()
        pixels = np.where(pixels[..., 3:] > 0, pixels[..., :3].clip(1, 254), level)
        Image.fromarray(pixels.astype(np.uint8)).save(capture.path / frame["file_path"])
    capture.content["white_transparent" if level else "black_transparent"] = True
    found = capture.read(eval_every=100).splits["train"]
    assert torch.equal(found.images[..., 3], expected.images[..., 3])
    assert (found.images.short() - expected.images.short()).abs().max() <= 1


def focal_lengths(capture, place="file", **keys):
    """What the focal lengths of a capture are read as if these keys take the place of them."""
    for key in PINHOLE:
        capture.content.pop(key, None)
    for entry in [capture.content] if place == "file" else capture.frames:
        entry |= keys
    return capture.read().splits["train"].intrinsics.focal[0].tolist()


DEGREES = math.degrees(ANGLE)
FLATTER = 2 * math.atan(math.tan(0.5 * ANGLE) / 1.25)


@pytest.mark.parametrize("place", ["file", "frames"])
@pytest.mark.parametrize(
    ("keys", "expected", "words"),
    [
        ({"fl_x": "30.5", "fl_y": "3e1", "w": f"{SIZE}", "h": SIZE}, [30.5, 30], ""),
        ({"intrinsic_matrix": [[31, 0, 12, 0], [0, 29, 12, 0], [0, 0, 1, 0]]}, [31, 29], ""),
        ({"K": [[31, 0, 12], [0, 31, 12], [0, 0, 1]], "fl_x": 30}, [30, 31], ""),
        ({"K": [31, 0, 12, 0, 29, 12, 0, 0, 1]}, [31, 29], ""),
        ({"fx": 31, "fy": "29", "cx": 12, "cy": 12, "width": SIZE, "height": SIZE}, [31, 29], ""),
        ({"x_fov": DEGREES, "fl_x": 99, "w": SIZE, "h": SIZE}, [FOCAL, FOCAL], ""),
        ({"x_fov": DEGREES, "y_fov": DEGREES}, [FOCAL, FOCAL], ""),
        ({"fovx": DEGREES, "fovy": DEGREES}, [FOCAL, FOCAL], ""),
        (
            {"camera_angle_x": DEGREES},
            [FOCAL, FOCAL],
            r"camera_angle_x=40\.1\d* is read in degrees",
        ),
        ({"camera_angle_x": ANGLE, "camera_angle_y": ANGLE}, [FOCAL, FOCAL], ""),
        (
            {"camera_angle_x": ANGLE, "camera_angle_y": FLATTER},
            [FOCAL, 1.25 * FOCAL],
            "camera_angle_y of 10 of 10 frames gives pixels that are not square",
        ),
        (
            {"x_fov": DEGREES, "y_fov": math.degrees(FLATTER)},
            [FOCAL, 1.25 * FOCAL],
            "y_fov of 10 of 10 frames gives pixels that are not square",
        ),
    ],
)
def test_intrinsics_as_programs_write_them(capture, place, keys, expected, words):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert focal_lengths(capture, place, **keys) == pytest.approx(expected)
    assert bool(said) is bool(words)
    assert all(re.search(words, str(each.message)) for each in said)


def test_focal_lengths_that_disagree_with_fields_of_view(capture):
    with pytest.warns(UserWarning, match="frame 0 .*fl_x=30 is used, but camera_angle_x m"):
        focal_lengths(capture, fl_x=30, w=SIZE, h=SIZE, camera_angle_x=ANGLE)


@pytest.mark.parametrize(
    "write",
    [
        lambda pose: {"transform_matrix": pose[:3].tolist()},
        lambda pose: {"transform_matrix": pose.ravel().tolist()},
        lambda pose: {"transform_matrix": (pose * [0.3, 0.3, 0.3, 1]).tolist()},
        lambda pose: {"transform_matrix_start": pose.tolist()},
    ],
)
def test_poses_as_programs_write_them(capture, write):
    expected = capture.read().splits["train"].camera_to_world
    for frame in capture.frames:
        frame |= write(np.array(frame.pop("transform_matrix")))
    found = capture.read().splits["train"].camera_to_world
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("keys", "setting", "is_turned"),
    [({}, None, True), ({"orientation_override": "none"}, None, False), ({}, False, False)],
)
def test_a_world_whose_y_axis_is_up_is_turned(capture, keys, setting, is_turned):
    notes = capture.read().notes
    assert notes["up"].startswith("the z axis of the files; the cameras' mean up vector is")
    for frame in capture.frames:
        frame["transform_matrix"] = (
            np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
            @ frame["transform_matrix"]
        ).tolist()
    capture.content |= keys
    scene = capture.read(orient=setting)
    up = scene.splits["train"].camera_to_world[:, :3, 1].mean(dim=0)
    assert bool(up[2] > 0.99 * up.norm()) is is_turned
    assert ("the world is turned, as it is" in scene.notes["up"]) is is_turned


def test_the_up_vector_of_instant_ngp_is_the_worlds(capture):
    capture.content["up"] = [0.0, 2.0, 0.0]
    scene = capture.read()
    assert scene.notes["up"] == "(0, 1, 0) of the files, by their key up"
    stated = np.array([f["transform_matrix"] for f in capture.frames])[:, 1, :3]
    found = scene.splits["train"].camera_to_world[:, 2, :3]
    np.testing.assert_allclose(found.numpy(), stated[numbers(scene.splits["train"])], atol=1e-6)
    assert "mean up vector" in capture.read(orient=False).notes["up"]
    capture.content["up"] = [0, 0, "z"]
    assert "mean up vector" in capture.read().notes["up"]


def test_positions_in_map_coordinates_are_read_relative_to_their_mean(capture):
    near = capture.read().splits["train"]
    for frame in capture.frames:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += [691_607.0, 5_334_760.0, 520.0]
        frame["transform_matrix"] = pose.tolist()
    with pytest.warns(UserWarning, match=r"relative to \(691606, 5334760, 522\)"):
        found = capture.read().splits["train"]
    shift = (found.camera_to_world - near.camera_to_world)[:, :3, 3]
    torch.testing.assert_close(found.camera_to_world[:, :, :3], near.camera_to_world[:, :, :3])
    torch.testing.assert_close(shift, shift[:1].expand_as(shift), atol=1e-5, rtol=0)
    assert float(shift.abs().max()) < 5
    capture.frames[0]["transform_matrix"][0][3] = 1e30
    capture.refused("which single precision cannot resolve")


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"n_frames": 6}, "n_frames=6 makes instant-ngp read the first 6 of 10 frames"),
        ({"sharpness_discard_threshold": 0.5}, "sharpness_discard_threshold=0.5 makes instant-ngp"),
        ({"n_frames": 10, "sharpness_discard_threshold": 0.0}, ""),
    ],
)
def test_what_instant_ngp_would_leave_out_is_told(capture, keys, words):
    capture.content |= keys
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        capture.read()
    assert [words in str(each.message) for each in caught] == [True] * bool(words)


def test_smaller_copies_stand_in_for_images_that_are_missing(capture):
    whole = capture.read(resolution=12).splits["train"]
    (capture.path / "images").rename(capture.path / "images_4")
    with pytest.warns(UserWarning, match=r"10 of 10 images are missing and read from smaller"):
        found = capture.read(resolution=12).splits["train"]
    assert found.files[0].startswith("images_4/")
    for mine, theirs in zip(found.image_rays(1), whole.image_rays(1), strict=True):
        torch.testing.assert_close(mine, theirs)
    for key in ("w", "h"):
        del capture.content[key]
    capture.refused("no image .*images/frame_00000", error=MissingSplitError)


def test_a_vertical_field_of_view_beside_a_focal_length(capture):
    del capture.content["fl_y"]
    capture.content |= {"w": 2 * SIZE, "h": 2 * SIZE, "fl_x": 2 * FOCAL, "cx": 30.0, "cy": 20.0}
    capture.content["camera_angle_y"] = 2 * math.atan(math.tan(0.5 * ANGLE) / 1.25)
    with pytest.warns(UserWarning, match="camera_angle_y of 10 of 10 frames gives pixels that are"):
        intrinsics = capture.read().splits["train"].intrinsics
    assert intrinsics.focal[0].tolist() == pytest.approx([FOCAL, 1.25 * FOCAL])
    assert intrinsics.centre[0].tolist() == [15, 10]


def test_images_elsewhere_or_one_folder_deeper(capture):
    expected = capture.read().splits["train"].files
    images, elsewhere = capture.path / "images", capture.path.parent / "elsewhere"
    images.rename(elsewhere)
    for frame in capture.frames:
        frame["file_path"] = str(elsewhere / Path(frame["file_path"]).name)
    capture.refused(r"leaves the scene's folder .*Put a link to \S*elsewhere inside the folder")
    images.mkdir()
    elsewhere.rename(images / "images")
    for frame in capture.frames:
        frame["file_path"] = f"images/{Path(frame['file_path']).name}"
    found = capture.read().splits["train"].files
    assert found == tuple(f"images/{file}" for file in expected)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
def test_a_file_in_another_encoding_is_read(capture, encoding):
    (capture.path / "images").rename(capture.path / "bildér")
    for frame in capture.frames:
        frame["file_path"] = frame["file_path"].replace("images", "bildér")
    path = capture.path / "transforms.json"
    path.write_text(json.dumps(capture.content, ensure_ascii=False), encoding=encoding)
    read = partial(read_capture, capture.path, ["train"])
    assert len(read().splits["train"]) == 9
    path.write_bytes(json.dumps(capture.content, ensure_ascii=False).encode("cp1252"))
    with pytest.warns(UserWarning, match="not in UTF-8 and is read as Latin-1"):
        assert len(read().splits["train"]) == 9


def test_a_percent_encoded_name_is_read(capture):
    (capture.path / "images").rename(capture.path / "my images")
    for frame in capture.frames:
        frame["file_path"] = frame["file_path"].replace("images", "my%20images")
    assert len(capture.read().splits["train"]) == 9
    name = "my images/frame%200.png"
    (capture.path / "my images/frame_00000.png").rename(capture.path / name)
    capture.frames[0]["file_path"] = name  # A file of exactly this name comes first.
    assert len(capture.read().splits["train"]) == 9


@pytest.mark.parametrize(
    "change",
    [
        lambda name: name.removeprefix("images/"),
        lambda name: name.replace("images", "Images").upper(),
        lambda name: unicodedata.normalize("NFD", name),
        lambda name: f"/home/somebody/ball/{name}",
        lambda name: f"../ball/{name}",
    ],
)
def test_images_are_found_by_names_that_are_nearly_theirs(capture, change):
    for frame in capture.frames:
        path = capture.path / frame["file_path"]
        named = path.with_name(f"é{path.name}")
        path.rename(named)
        frame["file_path"] = change(f"images/{named.name}")
    assert len(capture.read(eval_every=100).splits["train"]) == 10


def test_a_link_to_nothing_is_a_missing_image(capture):
    path = capture.path / capture.frames[3]["file_path"]
    path.unlink()
    path.symlink_to(capture.path.parent / "gone.png")
    with pytest.warns(UserWarning, match=r"1 of 10 frames are left out:(.|\n)*frame 3.*no image"):
        assert len(capture.read(eval_every=100).splits["train"]) == 9


@pytest.mark.parametrize("name", ["pinhole_6", 2])
def test_lenses_of_unknown_names_are_told_of(capture, name):
    capture.content |= {"camera_model": name, "k1": 0.01}
    with pytest.warns(UserWarning, match=f"camera_model='{str(name).upper()}' is not known"):
        lens = capture.read().splits["train"].intrinsics.lens(0)
    assert float(lens.coefficients[0, 0]) == 0.01


def test_a_name_that_several_images_have_is_none_of_them(capture):
    path = capture.path / capture.frames[3]["file_path"]
    with Image.open(path) as picture:
        picture.save(path.with_suffix(".webp"), lossless=True)
        picture.save(path.with_suffix(".tif"))
    path.unlink()
    with pytest.warns(UserWarning, match=r"1 of 10 frames are left out"):
        capture.read()
    # The one of the same name but for case is the one.
    path.with_suffix(".tif").rename(path.with_suffix(".pNg"))
    assert len(capture.read(eval_every=100).splits["train"]) == 10
