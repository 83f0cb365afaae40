"""Captures as nerfstudio and instant-ngp write them."""

import json
import logging
import math
import unicodedata
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.balls import ball_views, surrounding
from tests.captures import save, settings
from tests.scenes.common import Transforms, assert_same_rays, keys_of, refused, told
from xplanes.errors import MissingSplitError
from xplanes.readers.nerfstudio import NerfstudioSettings
from xplanes.scenes import store
from xplanes.scenes.batches import RayBatches, ViewBatches, ViewSettings
from xplanes.scenes.datamodule import UNIFORM, whole_view
from xplanes.scenes.frame import scene_frame
from xplanes.scenes.lenses import COEFFICIENTS, LensModel
from xplanes.scenes.views import joined
from xplanes.streams import step_generator
from xplanes.training.scores import score_image

SIZE, ANGLE = 24, 0.7
FOCAL = 0.5 * SIZE / math.tan(0.5 * ANGLE)
PINHOLE = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 12.0, "cy": 12.0, "w": SIZE, "h": SIZE}


class Capture(Transforms):
    """The images of a ball, and keys of the file and of its frames."""

    kind, option, file = NerfstudioSettings, "nerfstudio", "transforms.json"

    def __init__(self, path, count=10, **shared):
        super().__init__(path)
        self.views = ball_views(count, 0.6, size=SIZE, angle=ANGLE)
        self.contents["train"] = {**PINHOLE, "aabb_scale": 16, **shared, "frames": []}
        for index, pose in enumerate(self.views.camera_to_world.double().tolist()):
            name = f"images/frame_{index:05d}.png"
            # Alpha is 0 or 255: multiplied by it or not, colour is the same.
            save(path / name, self.views.image(index).numpy())
            self.frames().append({"file_path": name, "transform_matrix": pose})

    def timed(self, times, key="time"):
        for index, time in enumerate(times):
            self.change(index, **{key: time})

    def put(self, name, values):
        """Write an image for each frame, whose stem stands in the name."""
        for frame in self.frames():
            save(self.path / name.format(Path(frame["file_path"]).stem), values)

    def all(self, **options):
        """All views as one split."""
        return self.train(eval_every=100, **options)


@pytest.fixture
def capture(tmp_path):
    return Capture(tmp_path / "ball")


def numbers(views):
    return [int(file[-9:-4]) for file in views.files]


@pytest.mark.parametrize(
    ("keys", "model", "expected"),
    [
        ({"camera_model": "OPENCV", "k1": -0.2, "k2": 0.05, "p2": -0.02}, "PERSPECTIVE", {}),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.15}, "PERSPECTIVE", {}),
        ({"camera_model": "FULL_OPENCV", "k1": 0.3, "k4": 0.2, "k5": 0.02}, "PERSPECTIVE", {}),
        ({"camera_model": "OPENCV", "k1": -0.05, "k3": 0.01, "k4": 0.004}, "POLYNOMIAL", {}),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.03, "k4": 1e-4}, "FISHEYE", {}),
        ({"is_fisheye": True, "k1": 0.03}, "FISHEYE", {}),
        ({"is_fisheye": "True", "k1": 0.03}, "FISHEYE", {}),
        ({"is_fisheye": "false", "k1": 0.15}, "PERSPECTIVE", {}),
        (
            {"distortion_params": [0.1, 0.0, 0.01, 0.02, 0.001, -0.002]},
            "POLYNOMIAL",
            {"k1": 0.1, "k3": 0.01, "k4": 0.02, "p1": 0.001, "p2": -0.002},
        ),
        ({"distortion_params": [0, 0.02, 0, 0, 0, 0]}, "PERSPECTIVE", {"k2": 0.02}),
    ],
    ids=keys_of,
)
def test_lenses_as_programs_write_them(tmp_path, keys, model, expected):
    expected = expected or {key: value for key, value in keys.items() if key[0] in "kp"}
    capture = Capture(tmp_path, 3, **keys)
    capture.change(2, k1=0.02)  # One frame tells a lens of its own.
    lenses = capture.all(resolution=8).intrinsics.lenses
    assert lenses.model.tolist() == [LensModel[model]] * 3
    for row, own in zip(lenses.coefficients.tolist(), ({}, {}, {"k1": 0.02}), strict=True):
        named = zip(COEFFICIENTS, row, strict=True)
        assert {name: value for name, value in named if value} == expected | own


# Splits and times


def test_frames_are_held_out_at_even_ranks_of_time(tmp_path, capture):
    """Neither the first nor the last, whatever the order of the file."""
    capture.timed([(7 * i % 10) / 10 for i in range(10)])
    for every, expected in ((8, [4]), (3, [1, 4, 7])):
        splits = capture.read(("train", "val"), eval_every=every).splits
        ranks = [sorted((10 * views.times).round().tolist()) for views in splits.values()]
        assert ranks == [[rank for rank in range(10) if rank not in expected], expected]
    assert len(capture.all()) == 10
    for split, every, words in (
        ("val", 100, r"no val split.*data\.eval_every=100"),
        ("test", 8, r"no test split.*Splits of this capture: train, val.*data\.eval_split"),
    ):
        capture.refused(words, error=MissingSplitError, splits=(split,), eval_every=every)
    # Without times, the names of the files decide.
    capture.change_each(time=...)
    capture.frames().reverse()
    assert numbers(capture.read(("val",), eval_every=4).splits["val"]) == [6, 2]
    assert capture.train().is_static
    for few in (1, 2):
        capture = Capture(tmp_path / f"{few}", few)
        capture.refused("never held out", splits=("val",), error=MissingSplitError)


def test_lists_of_file_names_are_the_splits(capture):
    def read(*splits):
        return [numbers(views) for views in capture.read(splits).splits.values()]

    names = [frame["file_path"] for frame in capture.frames()]
    capture.change(train_filenames=names[3:], test_filenames=[f"./{names[1]}"])
    assert read("train", "test") == [[3, 4, 5, 6, 7, 8, 9], [1]]
    capture.refused("no val split", error=MissingSplitError, splits=("val",))
    assert len(capture.train(views=3)) == 3
    whole = dict(capture.contents["train"])
    # Some tools list the same views for validation as for testing.
    capture.change(val_filenames=[names[1], names[2]])
    assert read("val", "test") == [[1, 2], [1]]
    for changes, words in (
        ({"val_filenames": "a"}, "val_filenames is 'a', not a list"),
        ({"val_filenames": ["../x.png"]}, "val_filenames leaves the scene's folder"),
        ({"val_filenames": ..., "train_filenames": []}, "no frames to train on"),
    ):
        capture.change(**changes)
        capture.refused(words)
    capture.change(val_filenames=[], test_filenames=[])
    assert read("train", "val")[1]  # Every eighth, as without lists.
    capture.change(**whole, val_filenames=[names[2], names[3]])
    with told("1 of 2 views of val_filenames are in train_filenames"):
        assert read("train", "val") == [[3, 4, 5, 6, 7, 8, 9], [2, 3]]
    capture.change(val_filenames=...)
    capture.frames().pop(5)
    with told(r"1 names.*\n.*frame_00005.png is in no frame"):
        assert read("train") == [[3, 4, 6, 7, 8, 9]]
    (capture.path / names[5]).unlink()
    with told(r"1 names in lists .*\n.*train_filenames: .*no image"):
        assert read("train") == [[3, 4, 6, 7, 8, 9]]


@pytest.mark.parametrize(
    ("key", "first", "step", "source"),
    [
        # Nanoseconds since 1970, which single precision cannot tell apart.
        ("time", 17 * 10**17, 33_000_000, "1700000000000000000 to 1700000000297000000"),
        ("timestamp", 1_700_000_000.25, 0.125, "1700000000.25 to 1700000001.375"),
        ("timestep_index", 12, 1, "12 to 21"),
    ],
)
def test_times_in_any_unit_are_mapped_over_all_frames(capture, caplog, key, first, step, source):
    capture.timed([first + step * i for i in range(10)], key)
    with caplog.at_level(logging.INFO, logger="xplanes"):
        scene = capture.read(("train", "val"))
    assert f"{key} from {source} is mapped to times from 0 to 1" in caplog.text
    assert f'"{key}" of transforms.json, from {source}: ' in scene.notes["times"]
    for views in scene.splits.values():
        expected = [number / 9 for number in numbers(views)]
        assert views.times.tolist() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("zone", ["Z", "", "+02:00"])
def test_dates_are_times(capture, zone):
    capture.timed([f"2026-01-02T11:59:{50 + number * 0.25:05.2f}0{zone}" for number in range(10)])
    assert capture.all().times.tolist() == pytest.approx([number / 9 for number in range(10)])


@pytest.mark.parametrize("number", [0, 0.5, 1700000000])
def test_dates_and_numbers_are_not_mixed(capture, number):
    capture.timed([number] + [f"2026-01-02T11:59:{50 + index}Z" for index in range(9)])
    capture.refused("frame 1 .*time is '2026-01-02T11:59:50Z'; it must be .*, or all dates")


def test_numbers_in_names_are_the_times_of_a_video_that_is_known_to_change(capture):
    assert capture.all().times.tolist() == [0] * 10
    found = settings(NerfstudioSettings, "nerfstudio", capture.path, static=False, eval_every=100)
    scene = found.load(["train"])
    assert scene.splits["train"].times.tolist() == pytest.approx([i / 9 for i in range(10)])
    assert "numbers in their names" in scene.notes["times"]
    capture.timed([2, *range(9)])  # Times of the file come first.
    assert capture.all(static=False).times.tolist().count(0.25) == 2


def test_times_from_0_to_1_stay(capture, caplog):
    capture.timed([0.1 + i / 20 for i in range(10)])
    with caplog.at_level(logging.INFO, logger="xplanes"):
        views = capture.train()
    assert float(views.times.min()) == pytest.approx(0.1)
    assert "mapped" not in caplog.text
    for index in range(4, 10):
        capture.change(index, time=None)
    capture.refused('frame 4.*has no "time", but 4 of 10')


# Masks


def label_masks():
    """Masks as programs write them; all mean the lower triangle."""
    inside = np.tri(SIZE, dtype=np.uint8)
    palette = Image.fromarray(inside, "P")
    palette.putpalette([0, 0, 0, 128, 0, 0])
    cut = np.full((SIZE, SIZE, 4), 90, np.uint8)
    cut[..., 3] = 255 * inside
    colours = inside[..., None] * np.array([220, 20, 60], np.uint8)
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
def test_masks_of_labels_colours_and_alpha_mean_what_they_show(tmp_path, kind):
    capture = Capture(tmp_path, 3)
    label_masks()[kind].save(capture.path / "mask.png")
    capture.change_each(mask_path="mask.png")
    expected = capture.views.image(0) * torch.ones(SIZE, SIZE).tril()[..., None]
    assert torch.equal(capture.all(mask_use="alpha").image(0), expected.byte())


def masked(capture, values, ending="png", of=lambda index: True, **options):
    """Give frames a mask of grey values; the others get a black one."""
    (capture.path / "masks").mkdir(exist_ok=True)
    for index in range(len(capture.frames())):
        capture.change(index, mask_path=f"masks/{index}.{ending}")
        path = capture.path / f"masks/{index}.{ending}"
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


def assert_shown(views, values, index=0):
    """The pixels of a view that are not ignored are those where the mask is not black."""
    assert torch.equal(views.shown(index), torch.from_numpy(values > 0))


@pytest.mark.parametrize(("ending", "value"), [("png", 255), ("png", 1), ("jpg", 255)])
def test_pixels_that_masks_leave_out_are_neither_drawn_nor_scored(capture, caplog, ending, value):
    masked(capture, band() // 255 * value, ending, quality=95)
    shown = torch.from_numpy(band() > 0)
    for index in range(10):
        pixels = capture.views.image(index)
        pixels[~shown] = torch.tensor([255, 0, 255, 255], dtype=torch.uint8)
        save(capture.image(index), pixels.numpy())
    with caplog.at_level("INFO"):
        train = capture.train(eval_every=5)
    assert "masks leave out 25.0% of the pixels. They are taken for pixels to ignore" in caplog.text
    assert torch.equal(train.image(0), capture.views.image(0)), "colours stay as they are"
    assert all(torch.equal(train.shown(index), shown) for index in range(len(train)))
    assert torch.equal(train.valid()[1], shown)
    assert_shown(train.subset(torch.tensor([2])), band())
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


def test_masks_that_look_like_silhouettes_bound_the_scene(capture):
    masked(capture, disc())
    save(capture.path / "masks/5.png", np.roll(disc(), 1, axis=1))
    scene = capture.read(eval_every=100)
    assert "They are taken for silhouettes" in scene.notes["masks"]
    views = scene.splits["train"]
    assert views.ignored is None
    assert not views.image(0)[0, 0, 3]
    assert_shown(capture.all(mask_use="ignore"), disc())


def test_rays_of_stored_images_leave_ignored_pixels_out(capture, monkeypatch, tmp_path):
    masked(capture, band())
    monkeypatch.setattr(store, "IN_MEMORY", 0)
    views = capture.all(cache=str(tmp_path / "cache"))
    assert views.is_stored
    batches = RayBatches(views, scene_frame(views), UNIFORM, seed=0)
    for step in range(5):
        _, _, row, _, _ = batches._from_files(
            views.images, torch.rand(200, 3, dtype=torch.float64), step_generator(0, step)
        )
        assert int(row.max()) < SIZE - SIZE // 4


def test_images_that_masks_leave_out_whole_are_left_out(capture):
    masked(capture, band(), of=lambda index: index not in (2, 4))
    with told(r"all pixels of 2 of 10 images: images/frame_00002\.png"):
        views = capture.all()
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
    views = capture.all()
    small = capture.all(mask_use="lrm", resolution=8)
    both = joined(small, views)
    assert not both.ignored[:10].any()
    assert torch.equal(both.shown(13), views.shown(3))
    assert joined(small, small).ignored is None


def test_dim_values_of_noise_and_of_video_are_no_labels(capture):
    noise = np.random.default_rng(0).integers(0, 3, (SIZE, SIZE)).astype(np.uint8)
    masked(capture, noise)
    with pytest.warns(UserWarning, match="10 of 10 images show nothing"):
        capture.all(mask_use="alpha")
    # Videos have black at 16 and white at 235.
    masked(capture, np.where(band() > 0, 235, 16).astype(np.uint8))
    assert_shown(capture.all(), band())


def test_all_masks_of_a_capture_have_one_scale(capture):
    # In a frame without the thing, a lossy format makes values next to 0 of black.
    masked(capture, disc(), "jpg", of=lambda index: index != 3, quality=60)
    nearly = np.random.default_rng(0).integers(0, 3, (SIZE, SIZE)).astype(np.uint8)
    Image.fromarray(nearly).save(capture.path / "masks/3.jpg", quality=100)
    with pytest.warns(UserWarning, match="1 of 10 images show nothing"):
        views = capture.all()
    assert not views.image(3).any()
    assert views.image(0)[SIZE // 2, SIZE // 2, 3] == 255


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_masks_of_instant_ngp_are_white_where_pixels_are_ignored(capture, ending):
    capture.put("images/dynamic_mask_{}.png", 255 - band())
    for index in range(10):
        path = capture.image(index).with_suffix(f".{ending}")
        save(path, capture.views.image(index)[..., :3].numpy())
        capture.change(index, file_path=f"./images/{path.name}")
    scene = capture.read(eval_every=100)
    assert_shown(scene.splits["train"], band())
    assert scene.notes["masks"].startswith("leave out 25.0% of the pixels. They are taken for pix")


@pytest.mark.parametrize("name", ["{}.alpha.png", "{}.png.alpha.png"])
def test_alpha_beside_images_is_read(capture, name):
    capture.put(f"images/{name}", band())
    views = capture.all()
    assert views.ignored is None
    assert not views.image(0)[band() == 0].any()


@pytest.mark.parametrize(
    "lost",
    ["in another folder", "a link to nothing", "one of several", "in a list", "a mask", "", None],
)
def test_a_frame_without_its_image_or_its_mask_is_left_out(capture, lost):
    path, words = capture.image(3), "no image"
    with Image.open(path) as picture:
        pixels = picture.copy()
    if not lost:  # The name itself.
        capture.change(3, file_path=lost)
        words = f"file_path is {lost!r}"
    elif lost == "in another folder":
        (capture.path / "right").mkdir()
        capture.change(3, file_path=f"right/{path.name}")
    elif lost == "a mask":  # Which is not the image itself.
        capture.put("{}.png", band())
        capture.change_each(file_path=lambda name: name, mask_path="frame_00000.png")
        capture.change(3, mask_path=path.name)
        (capture.path / path.name).unlink()
        words = "no mask of"
    else:
        path.unlink()
    if lost == "a link to nothing":
        path.symlink_to(capture.path.parent / "gone.png")
    elif lost == "one of several":
        pixels.save(path.with_suffix(".webp"), lossless=True)
        pixels.save(path.with_suffix(".tif"))
    elif lost == "in a list":  # Which may spell it differently.
        capture.change(train_filenames=[f"./{frame['file_path']}" for frame in capture.frames()])
    with told(f"1 of 10 frames are left out:(.|\n)*frame 3.*{words}"):
        assert numbers(capture.all()) == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    if lost == "one of several":  # The one of the same name but for case is the one.
        path.with_suffix(".tif").rename(path.with_suffix(".pNg"))
        assert len(capture.all()) == 10


@pytest.mark.parametrize("name", ["mask/{}.png", "images/{}_mask.png", "Masks_2/{}.png"])
def test_masks_that_nothing_names_are_told_of(capture, name):
    capture.put(name, band())
    folder = name.partition("/")[0]
    with told(f"{folder}.* is not read.*data.masks={folder},"):
        assert capture.train().ignored is None


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (disc(), "silhouettes.*Both readings are possible.*=ignore if"),
        (255 - disc(), "Both readings.*Silhouettes are white where the scene is"),
        (band(5 * SIZE // 12), r"Both readings are possible.*data\.mask_use=alpha"),
    ],
    ids=["one for all images", "that hide the middle", "of nearly half"],
)
def test_masks_that_may_mean_either_are_asked_about(capture, values, words):
    masked(capture, values)
    with told(words):
        views = capture.all()
    assert (views.ignored is None) == (values[0, 0] == 0)


def test_one_mask_of_all_images_is_no_silhouette(capture):
    """Such as the circle that nerfstudio's own tool draws for fisheye images."""
    save(capture.path / "mask.png", disc())
    capture.change(mask_path="mask.png")
    assert_shown(capture.train(), disc())


@pytest.mark.parametrize("level", [0, 255])
def test_a_colour_may_be_transparent(capture, level):
    expected = capture.all()
    for index in range(10):
        pixels = capture.views.image(index).numpy()
        pixels = np.where(pixels[..., 3:] > 0, pixels[..., :3].clip(1, 254), level)
        save(capture.image(index), pixels.astype(np.uint8))
    chosen, other = ("white", "black") if level else ("black", "white")
    capture.change(**{f"{chosen}_transparent": "true", f"{other}_transparent": "False"})
    found = capture.all()
    assert torch.equal(found.images[..., 3], expected.images[..., 3])
    assert (found.images.short() - expected.images.short()).abs().max() <= 1


# Files


def test_coefficients_of_minus_one_are_none(tmp_path):
    capture = Capture(tmp_path, 3, k1=0.02, k2=0.001, p1=-1, p2=-1)
    with told("p1, p2 are -1, as agi2nerf writes it for none"):
        lenses = capture.all(resolution=8).intrinsics.lenses
    found = dict(zip(COEFFICIENTS, lenses.coefficients[0].tolist(), strict=True))
    assert {key: value for key, value in found.items() if value} == {"k1": 0.02, "k2": 0.001}


def test_a_mark_at_the_start_and_comments_are_read(capture):
    expected = capture.all().camera_to_world
    path = capture.path / "transforms.json"
    text = json.dumps({"name": "http://x//y,]", "frames": capture.frames()}, indent=1)
    text = text.replace('"frames"', f'/* the\nlens */ {json.dumps(PINHOLE)[1:-1]}, // x\n "frames"')
    path.write_text(text[:-2] + ", # the end\n}", encoding="utf-8-sig")
    found = capture.load(eval_every=100)
    assert torch.equal(found.splits["train"].camera_to_world, expected)
    capture.change(distortion_params=[0.1, 0.0, 0.0, 0.0])
    capture.refused("a list of the 6 numbers k1, k2, k3, k4, p1, p2")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
def test_a_file_in_another_encoding_is_read(capture, encoding):
    (capture.path / "images").rename(capture.path / "bildér")
    capture.change_each(file_path=lambda name: name.replace("images", "bildér"))
    path = capture.path / "transforms.json"
    text = json.dumps(capture.contents["train"], ensure_ascii=False)
    path.write_text(text, encoding=encoding)
    assert len(capture.load().splits["train"]) == 9
    path.write_bytes(text.encode("cp1252"))
    with told("not in UTF-8 and is read as Latin-1"):
        assert len(capture.load().splits["train"]) == 9


def test_keys_of_other_programs_change_nothing(capture):
    plain = capture.train()
    capture.change(
        applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]],
        **{"applied_scale": 3.0, "scale": 0.33, "offset": [0.5, 0.5, 0.5], "k3": 0},
        **{"ply_file_path": "sparse.ply", "orientation_override": "none", "camera_angle_x": "?"},
        rolling_shutter=[0, 0, 0, 0],
    )
    capture.change_each(colmap_im_id=3, sharpness=10.0, mask_path=None, depth_file_path="x")
    found = capture.train()
    assert torch.equal(found.camera_to_world, plain.camera_to_world)
    assert torch.equal(found.images, plain.images)
    assert torch.equal(found.intrinsics.focal, plain.intrinsics.focal)
    capture.change(from_na=True)
    capture.refused("from_na=True stands for poses with other axes")


@pytest.mark.parametrize(
    ("keys", "of_a_frame", "words"),
    [
        ({"n_frames": 6}, {}, "n_frames=6 makes instant-ngp read the first 6 of 10 frames"),
        ({"sharpness_discard_threshold": 0.5}, {}, "discard_threshold=0.5 makes instant-ngp"),
        ({"n_frames": 10, "sharpness_discard_threshold": 0.0}, {}, None),
        (
            {**dict.fromkeys(PINHOLE, ...), "fl_x": 30, "w": SIZE, "camera_angle_x": ANGLE},
            {},
            "frame 0 .*fl_x=30 is used, but camera_angle_x m",
        ),
        (
            {"mask_color": [0, 0, 0], "envmap": "", "intrinsics": {"f": 9}},
            {"rolling_shutter": [1, 0, 0, 0]},
            "not read are 'intrinsics', 'mask_color', 'rolling_shutter'",
        ),
    ],
    ids=keys_of,
)
def test_keys_that_are_not_followed_are_told(capture, keys, of_a_frame, words):
    capture.change(**keys)
    capture.change(2, **of_a_frame)
    with told(words):
        capture.read()


def test_files_of_rays_beside_images_are_told_of(capture):
    for name in ("rays_frame_00003.dat", "rays_frame_00004.dat"):
        (capture.path / "images" / name).write_bytes(b"")
    with told(r"rays in files beside 2 of 10 .*rays_frame_00003\.dat"):
        capture.read()
    capture.change(enable_ray_loading=False)
    with told(None):
        capture.read()


def test_what_is_no_capture(tmp_path):
    capture = Capture(tmp_path / "other")
    capture.write()
    capture.path = tmp_path
    refused(capture.load, r"holds no transforms\.json\. Such scenes in .*: other\. Set data\.root")


# Cameras


def test_lenses_and_poses_of_many_cameras_stay_with_their_images(capture):
    """Views taken out, spread and held out keep the lens of their own frame."""
    for index in range(10):
        keys = {"fl_x": 20.0 + index, "k1": 0.01 * (index + 1), "time": (3 * index % 10) / 10}
        capture.change(index, **keys)
    parts = capture.read(("train", "val"), eval_every=3, views=4).splits
    for views in parts.values():
        for index, number in enumerate(numbers(views)):
            assert views.intrinsics.focal[index, 0] == 20 + number
            lens = views.intrinsics.lens(index)
            assert float(lens.coefficients[0, 0]) == pytest.approx(0.01 * (number + 1))
            expected = surrounding(10, 4.0)[number]
            torch.testing.assert_close(views.camera_to_world[index], expected)


DEGREES = math.degrees(ANGLE)
FLATTER = 2 * math.atan(math.tan(0.5 * ANGLE) / 1.25)
NOT_SQUARE = "{} of 10 of 10 frames gives pixels that are not square"


@pytest.mark.parametrize("place", ["file", "frames"])
@pytest.mark.parametrize(
    ("keys", "expected", "words"),
    [
        ({"fl_x": "30.5", "fl_y": "3e1", "w": f"{SIZE}", "h": SIZE}, (30.5, 30), None),
        ({"intrinsic_matrix": [[31, 0, 12, 0], [0, 29, 12, 0], [0, 0, 1, 0]]}, (31, 29), None),
        ({"K": [[31, 0, 12], [0, 31, 12], [0, 0, 1]], "fl_x": 30}, (30, 31), None),
        ({"K": [31, 0, 12, 0, 29, 12, 0, 0, 1]}, (31, 29), None),
        ({"fx": 31, "fy": "29", "cx": 12, "cy": 12, "width": SIZE, "height": SIZE}, (31, 29), None),
        ({"x_fov": DEGREES, "fl_x": 99, "w": SIZE, "h": SIZE}, (FOCAL, FOCAL), None),
        ({"x_fov": DEGREES, "y_fov": DEGREES}, (FOCAL, FOCAL), None),
        ({"fovx": DEGREES, "fovy": DEGREES}, (FOCAL, FOCAL), None),
        ({"camera_angle_x": DEGREES}, (FOCAL, FOCAL), r"angle_x=40\.1\d* is read in degrees"),
        ({"camera_angle_x": ANGLE, "camera_angle_y": ANGLE}, (FOCAL, FOCAL), None),
        (
            {"camera_angle_x": ANGLE, "camera_angle_y": FLATTER},
            (FOCAL, 1.25 * FOCAL),
            NOT_SQUARE.format("camera_angle_y"),
        ),
        (
            {"fl_x": 2 * FOCAL, "w": 2 * SIZE, "h": 2 * SIZE, "camera_angle_y": FLATTER},
            (FOCAL, 1.25 * FOCAL),
            NOT_SQUARE.format("camera_angle_y"),
        ),
        (
            {"x_fov": DEGREES, "y_fov": math.degrees(FLATTER)},
            (FOCAL, 1.25 * FOCAL),
            NOT_SQUARE.format("y_fov"),
        ),
    ],
    ids=keys_of,
)
def test_intrinsics_as_programs_write_them(capture, place, keys, expected, words):
    capture.change(**dict.fromkeys(PINHOLE, ...))
    (capture.change if place == "file" else capture.change_each)(**keys)
    with told(words):
        focal = capture.train().intrinsics.focal[0]
    assert focal.tolist() == pytest.approx(expected)


@pytest.mark.parametrize("name", ["pinhole_6", 2])
def test_lenses_of_unknown_names_are_told_of(capture, name):
    capture.change(camera_model=name, k1=0.01)
    with told(f"camera_model='{str(name).upper()}' is not known"):
        assert float(capture.train().intrinsics.lenses.coefficients[0, 0]) == 0.01


@pytest.mark.parametrize(
    "write",
    [
        lambda pose: {"transform_matrix": pose[:3].tolist()},
        lambda pose: {"transform_matrix": pose.ravel().tolist()},
        lambda pose: {"transform_matrix": (pose * [0.3, 0.3, 0.3, 1]).tolist()},
        lambda pose: {"transform_matrix": (pose * [1.0008, 1.0008, 1.0008, 1]).tolist()},
        lambda pose: {"transform_matrix_start": pose.tolist()},
    ],
    ids=["three rows", "one list", "scaled", "scaled a little", "of a rolling shutter"],
)
def test_poses_as_programs_write_them(capture, write):
    expected = capture.train().camera_to_world
    for index, frame in enumerate(capture.frames()):
        capture.change(index, **write(np.array(frame.pop("transform_matrix"))))
    torch.testing.assert_close(capture.train().camera_to_world, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("keys", "setting", "is_turned"),
    [({}, None, True), ({"orientation_override": "none"}, None, False), ({}, False, False)],
)
def test_a_world_whose_y_axis_is_up_is_turned(capture, keys, setting, is_turned):
    notes = capture.read().notes
    assert notes["up"].startswith("the z axis of the files; the cameras' mean up vector is")
    lying = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    capture.change_each(transform_matrix=lambda matrix: (lying @ matrix).tolist())
    capture.change(**keys)
    scene = capture.read(orient=setting)
    up = scene.splits["train"].camera_to_world[:, :3, 1].mean(dim=0)
    assert bool(up[2] > 0.99 * up.norm()) is is_turned
    assert ("the world is turned, as it is" in scene.notes["up"]) is is_turned


def test_the_up_vector_of_instant_ngp_is_the_worlds(capture):
    capture.change(up=[0.0, 2.0, 0.0])
    scene = capture.read()
    assert scene.notes["up"] == "(0, 1, 0) of the files, by their key up"
    stated = np.array([f["transform_matrix"] for f in capture.frames()])[:, 1, :3]
    found = scene.splits["train"].camera_to_world[:, 2, :3]
    np.testing.assert_allclose(found.numpy(), stated[numbers(scene.splits["train"])], atol=1e-6)
    assert "mean up vector" in capture.read(orient=False).notes["up"]
    capture.change(up=[0, 0, "z"])
    assert "mean up vector" in capture.read().notes["up"]


# Names of images


def test_smaller_copies_stand_in_for_images_that_are_missing(capture):
    whole = capture.train(resolution=12)
    (capture.path / "images").rename(capture.path / "images_4")
    with told(r"10 of 10 images are missing and read from smaller"):
        found = capture.train(resolution=12)
    assert found.files[0].startswith("images_4/")
    assert_same_rays(found, 1, whole, 1)
    names = [frame["file_path"] for frame in capture.frames()]
    capture.change(train_filenames=[f"./{name}" for name in names[:6]], val_filenames=names[6:])
    with told("10 of 10 images are missing and read from smaller"):
        parts = capture.read(("train", "val")).splits.values()
    assert [numbers(views) for views in parts] == [[0, 1, 2, 3, 4, 5], [6, 7, 8, 9]]
    capture.put("masks/{}.png", np.full((2 * SIZE, 2 * SIZE), 255, np.uint8))
    capture.put("masks_4/{}.png", disc())
    for index, name in enumerate(names):
        capture.change(index, mask_path=name.replace("images", "masks"))
    with told("read from smaller|Both readings"):
        assert_shown(capture.train(mask_use="ignore"), disc())
    capture.change(w=..., h=...)
    capture.refused("no image .*images/frame_00000", error=MissingSplitError)


def test_images_elsewhere_or_one_folder_deeper(capture):
    expected = capture.train().files
    images, elsewhere = capture.path / "images", capture.path.parent / "elsewhere"
    images.rename(elsewhere)
    capture.change_each(file_path=lambda name: str(elsewhere / Path(name).name))
    capture.refused(r"leaves the scene's folder .*Put a link to \S*elsewhere inside the folder")
    images.mkdir()
    elsewhere.rename(images / "images")
    capture.change_each(file_path=lambda name: f"images/{Path(name).name}")
    assert capture.train().files == tuple(f"images/{file}" for file in expected)


@pytest.mark.parametrize(
    "keys",
    [{"cx": 0.5, "cy": 0.5}, {"cx": 0, "cy": 0}, {"cx": 24.0, "cy": 24.0, "w": ..., "h": ...}],
    ids=keys_of,
)
def test_principal_points_in_other_units_are_told_of(capture, keys):
    capture.change(**keys)
    with told("frame_00000.png: the principal point .* far from the middle .* 24x24 pixels"):
        capture.train()
    capture.change(fl_x=FOCAL / SIZE**2, fl_y=FOCAL / SIZE**2)
    capture.refused("the focal length along x is .* must lie between 0.02")


@pytest.mark.parametrize("ending", [".png", ""])
def test_names_that_leave_the_folder_do_not_stand_for_images_inside(capture, ending):
    capture.change_each(file_path=lambda name: f"../{name.removesuffix('.png')}{ending}")
    assert len(capture.all()) == 10
    for index in range(10):
        save(capture.path.parent / f"images/frame_{index:05d}.png", disc())
    capture.refused("leaves the scene's folder")


def test_a_percent_encoded_name_is_read(capture):
    (capture.path / "images").rename(capture.path / "my images")
    capture.change_each(file_path=lambda name: name.replace("images", "my%20images"))
    assert len(capture.train()) == 9
    name = "my images/frame%200.png"
    (capture.path / "my images/frame_00000.png").rename(capture.path / name)
    capture.change(0, file_path=name)  # A file of exactly this name comes first.
    assert len(capture.train()) == 9


@pytest.mark.parametrize(
    "new",
    [
        lambda name: name.removeprefix("images/"),
        lambda name: name.replace("images", "Images").upper(),
        lambda name: unicodedata.normalize("NFD", name),
        lambda name: f"/home/somebody/ball/{name}",
        lambda name: f"../ball/{name}",
        lambda name: f"./ball/{name}",
        lambda name: name.replace("images", "input"),
        lambda name: f"./../{name}",
        lambda name: f"../../{name.removesuffix('.png')}",
        lambda name: f"../data/fox/{name}",
        lambda name: name.replace("images", "train"),
        lambda name: name.replace("images/", "C:\\data\\train/"),
    ],
    ids="bare capitals é machine beside above renamed below lower fox split windows".split(),
)
def test_images_are_found_by_names_that_are_nearly_theirs(capture, new):
    for index in range(10):
        path = capture.image(index)
        path.rename(path.with_name(f"é{path.name}"))
    capture.change_each(file_path=lambda name: new(name.replace("/", "/é")))
    assert len(capture.all()) == 10
