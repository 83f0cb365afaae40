"""Image files of every kind: those that are read, and what is said of the others."""

from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image, features

from tests.captures import HEIGHT, WIDTH, picture, poses, save, settings, write_colmap
from tests.scenes.common import refused
from xplanes import RadianceModule
from xplanes.errors import ConfigError, LRMError, SceneError
from xplanes.lrm.checkpoint import read_weights
from xplanes.preparation.sequence import load_triplanes
from xplanes.readers.colmap import ColmapSettings
from xplanes.readers.colmap_model import read_model
from xplanes.readers.entries import read_object
from xplanes.readers.formats import orientation
from xplanes.readers.images import load_images, native_sizes
from xplanes.training.checkpoints import load_checkpoint

POINTER = (
    "version https://git-lfs.github.com/spec/v1\n"
    "oid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n"
)


@pytest.mark.parametrize(
    ("ending", "options"),
    [
        ("webp", {"lossless": True}),
        ("tif", {"compression": "tiff_lzw"}),
        ("bmp", {}),
        ("avif", {"quality": 100, "subsampling": "4:4:4"}),
        ("jp2", {"irreversible": False}),
        ("ppm", {}),
        ("tga", {}),
        ("qoi", {}),
        ("jfif", {"format": "JPEG", "quality": 100, "subsampling": 0}),
        ("jpg", {"format": "MPO", "quality": 100, "subsampling": 0}),
    ],
)
def test_further_formats_are_read(tmp_path, ending, options):
    if ending in ("avif", "webp") and not features.check(ending):
        pytest.skip(f"Pillow was built without {ending}")
    path = tmp_path / f"a.{ending}"
    smooth = Image.fromarray(picture(3, 4, 6)).resize((48, 32), Image.Resampling.BICUBIC)
    smooth.save(path, **options)
    (found,) = load_images([path], None)
    assert np.abs(found[..., :3].short().numpy() - np.asarray(smooth)).max() <= 12
    assert bool((found[..., 3] == 255).all())


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.heic", b"\0\0\0\x18ftypheic\0\0\0\0", r"is in HEIC, .*mogrify -format png \*\.heic"),
        ("a.jpg", b"\0\0\0\x18ftypmif1\0\0\0\0", "is in HEIC"),
        ("a.jxl", b"\0\0\0\x0cJXL \r\n\x87\n" + bytes(20), "is in JPEG XL"),
        ("a.exr", b"v/1\x01\x02\0\0\0" + bytes(20), "is in OpenEXR"),
        ("a.hdr", b"#?RADIANCE\n", "is in Radiance HDR"),
        ("a.dng", b"II*\0" + bytes(20), "is in a camera's raw format"),
        ("a.psd", b"8BPS" + bytes(20), "is in Photoshop"),
        ("a.png", b"\0\0\0\x18ftypisom" + bytes(20), "is in MP4"),
        ("a.jpg", POINTER.encode(), "is a pointer of Git LFS.*: run git lfs pull"),
        ("a.jpg", b"/annex/objects/SHA256E-s1--ab.jpg\n", "is a pointer of git-annex"),
        ("a.jpg", b"\n<!DOCTYPE html><html>", "is a web page"),
        ("a.jpg", b"", "cannot be decoded as an image.*truncated or damaged"),
    ],
)  # fmt: skip
def test_other_files_are_named_for_what_they_are(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    refused(partial(native_sizes, [tmp_path / name]), words)


def test_all_files_that_cannot_be_read_are_named_at_once(tmp_path):
    paths = [tmp_path / f"{i}.jpg" for i in range(7)]
    for path in paths[1:]:
        path.write_text(POINTER)
    save(paths[0], picture(0))
    last = r"\.\.\. and 1 more problems like these\.$"
    refused(partial(native_sizes, paths), "1.jpg is a pointer", "5.jpg is a pointer", last)


def test_pointers_of_git_lfs_are_named_wherever_a_file_is_read(tmp_path):
    words = "is a pointer of Git LFS.*git lfs pull"
    for name, error, read in (
        ("model.safetensors", LRMError, read_weights),
        ("model.ckpt", LRMError, read_weights),
        ("last.ckpt", ConfigError, load_checkpoint),
        ("best.ckpt", ConfigError, RadianceModule.load_from_checkpoint),
        ("planes.safetensors", ConfigError, load_triplanes),
        ("transforms.json", SceneError, partial(read_object, content="frames")),
    ):
        (tmp_path / name).write_text(POINTER)
        refused(partial(read, tmp_path / name), words, case=name, error=error)
    camera = {1: ("PINHOLE", WIDTH, HEIGHT, (36.0, 36.0, 20.0, 15.0))}
    images = [("a.png", poses(1)[0], 1, 1)]
    parts = ("cameras", "images", "points3D")
    for name in [f"{part}.{ending}" for part in parts for ending in ("bin", "txt")]:
        model = tmp_path / name
        write_colmap(model, camera, images, [[0, 0, 0]], text=name.endswith("txt"))
        (model / name).write_text(POINTER)
        refused(partial(read_model, model), words, case=name)


TOP = {
    **{1: (0, 1), 2: (0, 1), 3: (0, -1), 4: (0, -1)},
    **{5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)},
}
"""Where the top of the upright picture is in the stored one under each orientation of EXIF."""


def photos(folder, pixels, tag, ending="jpg"):
    """Four images whose EXIF tells how they are turned. Their names."""
    exif = Image.Exif()
    exif[0x0112] = tag
    folder.mkdir(parents=True)
    names = [f"{index}.{ending}" for index in range(4)]
    for name in names:
        pixels.save(folder / name, exif=exif, quality=95)
    return names


@pytest.mark.parametrize(
    ("tag", "ending"), [*((tag, "jpg") for tag in TOP), (6, "png"), (6, "webp"), (6, "tif")]
)
def test_what_is_up_follows_exif(tmp_path, tag, ending):
    """Where the top of the upright picture is in the stored one, the world's z axis points."""
    names = photos(tmp_path / "room/images", Image.fromarray(picture(0)), tag, ending)
    assert orientation(tmp_path / "room/images" / names[3]) == tag
    # Cameras that look horizontally around an axis, rolled so that the upright picture is upright.
    turns, aim = poses(4), TOP[tag]
    for pose in turns:
        right, up = pose[:3, 0].copy(), np.array([0.0, 0, 1])
        rolled = [right * aim[1] + up * aim[0], up * aim[1] - right * aim[0], np.cross(right, up)]
        pose[:3, :3] = np.stack(rolled, axis=1)
    lying = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    turns[:, :3] = lying @ turns[:, :3]
    camera = {1: ("SIMPLE_PINHOLE", WIDTH, HEIGHT, (30.0, WIDTH / 2, HEIGHT / 2))}
    images = [(name, pose, 1, 0) for name, pose in zip(names, turns, strict=True)]
    write_colmap(tmp_path / "room/sparse/0", camera, images)
    read = settings(ColmapSettings, "colmap", tmp_path / "room", static=True, eval_every=100)
    views = read.load(["train"]).splits["train"]
    assert views.images.shape[1:3] == (HEIGHT, WIDTH), "pixels stay"
    for pose in views.camera_to_world:
        top = aim[0] * pose[:3, 0] + aim[1] * pose[:3, 1]
        torch.testing.assert_close(top, torch.tensor([0.0, 0, 1]), atol=1e-5, rtol=0)


def test_masks_and_cameras_of_turned_photos_say_exif(tmp_path):
    folder = tmp_path / "room"
    names = photos(folder / "images", Image.fromarray(picture(0)), 6)
    for name in names:
        save(folder / "masks" / f"{name}.png", picture(1, WIDTH, HEIGHT))
    lens = (36.0, WIDTH / 2, HEIGHT / 2)
    images = [(name, pose, 1, 0) for name, pose in zip(names, poses(4), strict=True)]
    for width, height, masks, of_all, words in (
        (WIDTH, HEIGHT, "masks", "{}.png has 30x40", r"for display.*magick mogrify -rotate 270"),
        (HEIGHT, WIDTH, None, "{} has 40x30", r"calibrated with the rotated image.*-auto-orient"),
    ):
        write_colmap(folder / "sparse/0", {1: ("SIMPLE_PINHOLE", width, height, lens)}, images)
        made = settings(ColmapSettings, "colmap", folder, static=True, masks=masks)
        words = [f"EXIF orientation.*{words}", *map(of_all.format, names)]
        refused(partial(made.load, ["train"]), *words)
