"""One capture, written in every format, is read as the same."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.balls import ball_views, surrounding, swinging
from tests.captures import save, settings, write_colmap
from tests.scenes.common import assert_same_rays, refused
from xplanes.readers.colmap import ColmapSettings
from xplanes.readers.dnerf import BlenderSettings
from xplanes.readers.multicamera import MultiCameraSettings
from xplanes.readers.nerfies import NerfiesSettings
from xplanes.readers.nerfstudio import NerfstudioSettings
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Scene, Views

CAMERAS, FRAMES, SIZE, ANGLE = 4, 4, 24, 0.7
FOCAL = 0.5 * SIZE / math.tan(0.5 * ANGLE)
NAMES = [f"cam{k:02d}/frame_{frame:04d}" for k in range(CAMERAS) for frame in range(FRAMES)]
TIMES = [frame / (FRAMES - 1) for _ in range(CAMERAS) for frame in range(FRAMES)]

TRAIN, TEST = NAMES[FRAMES:], NAMES[:FRAMES]


def captured() -> Views:
    """A ball that swings, and shades from red to green, seen by fixed cameras, one by one."""
    poses = surrounding(CAMERAS, 4.0, 2).repeat_interleave(FRAMES, dim=0)
    ball = {"centre": swinging(0.4, 0.4), "times": torch.tensor(TIMES), "poses": poses}
    views = ball_views(len(NAMES), 0.6, size=SIZE, angle=ANGLE, **ball)
    images = views.in_memory().clone()
    shade = torch.arange(0, 240, 10, dtype=torch.uint8)
    images[..., 1] = torch.where(images[..., 3] > 0, shade[:, None], images[..., 1])
    return replace(views, images=images)


VIEWS = captured()
POSES = VIEWS.camera_to_world.double().numpy()


def rgba(index: int) -> np.ndarray:
    return VIEWS.image(index).numpy()


def before_noise(index: int) -> np.ndarray:
    """The image without alpha, noise where that is 0. uint8 [h, w, 3]"""
    noise = np.random.default_rng(index).integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8)
    return np.where(rgba(index)[..., 3:] > 0, rgba(index)[..., :3], noise)


def write_images(folder: Path, masks: str = "{}.png") -> None:
    """Images without alpha, and their masks."""
    for index, name in enumerate(NAMES):
        save(folder / "images" / f"{name}.png", before_noise(index))
        save(folder / "masks" / masks.format(name), rgba(index)[..., 3])


def blender(folder: Path) -> SceneSettings:
    for index, name in enumerate(NAMES):
        save(folder / f"{name}.png", rgba(index))
    frames = {
        name: {"file_path": f"./{name}", "transform_matrix": pose.tolist(), "time": time}
        for name, pose, time in zip(NAMES, POSES, TIMES, strict=True)
    }
    for split, part in (("train", TRAIN), ("test", TEST)):
        content = {"camera_angle_x": ANGLE, "frames": [frames[name] for name in part]}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return settings(BlenderSettings, "blender", folder)


def nerfstudio(folder: Path) -> SceneSettings:
    write_images(folder)
    frames = [
        {
            "file_path": f"images/{name}.png",
            "mask_path": f"masks/{name}.png",
            "transform_matrix": pose.tolist(),
            "time": 100 + int(name[-4:]),
        }
        for name, pose in zip(NAMES, POSES, strict=True)
    ]
    lists = {
        f"{split}_filenames": [f"images/{name}.png" for name in part]
        for split, part in (("train", TRAIN), ("test", TEST))
    }
    content = {"fl_x": FOCAL, "w": SIZE, "h": SIZE, **lists, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return settings(NerfstudioSettings, "nerfstudio", folder)


def colmap(folder: Path, *, text: bool) -> SceneSettings:
    write_images(folder, "{}.png.png")
    lens = {1: ("PINHOLE", SIZE, SIZE, (FOCAL, FOCAL, SIZE / 2, SIZE / 2))}
    images = [(f"{name}.png", pose, 1, 2) for name, pose in zip(NAMES, POSES, strict=True)]
    write_colmap(folder / "sparse" / "0", lens, images, [[0.0, 0.0, 0.0]], text=text)
    # No view of the other cameras is held out.
    split = {"test_cameras": ["cam00"], "eval_every": 1000}
    return settings(ColmapSettings, "colmap", folder, masks="masks", orient=False, **split)


def nerfies(folder: Path) -> SceneSettings:
    def write(name: str, content: dict) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(json.dumps(content))

    ids = {name: name.replace("/", "_") for name in NAMES}
    scale, centre = 0.25, np.array([0.5, -1.0, 2.0])
    for index, (name, pose) in enumerate(zip(NAMES, POSES, strict=True)):
        save(folder / "rgb" / "1x" / f"{ids[name]}.png", before_noise(index))
        save(folder / "masks" / "1x" / f"{ids[name]}.png", rgba(index)[..., 3])
        camera = {
            "orientation": (pose[:3, :3] * [1, -1, -1]).T.tolist(),
            "position": (pose[:3, 3] / scale + centre).tolist(),
            "focal_length": FOCAL,
            "principal_point": [SIZE / 2, SIZE / 2],
            "image_size": [SIZE, SIZE],
        }
        write(f"camera/{ids[name]}.json", camera)
    lists = {"train_ids": [ids[name] for name in TRAIN], "val_ids": [ids[name] for name in TEST]}
    write("dataset.json", {"ids": list(ids.values()), **lists})
    write("scene.json", {"scale": scale, "center": centre.tolist()})
    write("metadata.json", {ids[name]: {"warp_id": int(name[-4:])} for name in NAMES})
    return settings(NerfiesSettings, "nerfies", folder, masks="masks", orient=False)


def multicamera(folder: Path) -> SceneSettings:
    for index, name in enumerate(NAMES):
        save(folder / f"{name}.png", rgba(index))
    lens = {1: ("SIMPLE_PINHOLE", SIZE, SIZE, (FOCAL, SIZE / 2, SIZE / 2))}
    images = [(f"{NAMES[index]}.png", POSES[index], 1, 2) for index in range(0, len(NAMES), FRAMES)]
    write_colmap(folder / "sparse" / "0", lens, images)
    return settings(MultiCameraSettings, "multicamera", folder, test_cameras=["cam00"])


FORMATS: dict[str, Callable[[Path], SceneSettings]] = {
    "blender": blender,
    "nerfstudio": nerfstudio,
    "colmap_text": lambda folder: colmap(folder, text=True),
    "colmap": lambda folder: colmap(folder, text=False),
    "nerfies": nerfies,
    "multicamera": multicamera,
}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Scene]:
    """The capture as every reader reads it; what is scored is called test."""
    root, found = tmp_path_factory.mktemp("captures"), {}
    for name, write in FORMATS.items():
        (root / name).mkdir()
        scene = write(root / name).read()
        train, scored = scene.splits.values()
        found[name] = replace(scene, splits={"train": train, "test": scored})
    return found


@pytest.mark.parametrize("name", FORMATS)
def test_rays_pixels_masks_and_times_are_those_that_were_written(scenes, name):
    for split, part in (("train", TRAIN), ("test", TEST)):
        views = scenes[name].splits[split]
        assert len(views) == len(part)
        for index, written in enumerate(part):
            place = NAMES.index(written)
            assert torch.equal(views.image(index), VIEWS.image(place)), written
            assert_same_rays(views, index, VIEWS, place)
        assert views.times.tolist() == pytest.approx(TIMES[: len(part)], abs=1e-7)


@pytest.mark.parametrize("name", ["nerfstudio", "colmap", "nerfies"])
def test_masks_for_lrms_leave_the_images_whole(name, tmp_path):
    scene = replace(FORMATS[name](tmp_path), mask_use="lrm").read()
    train, scored = scene.splits.values()
    for views, part in ((train, TRAIN), (scored, TEST)):
        for index, written in enumerate(part):
            pixels = before_noise(NAMES.index(written))
            assert np.array_equal(views.image(index)[..., :3].numpy(), pixels), written
        assert views.is_opaque
    assert scene.lrm_views is not None
    assert scene.lrm_views.files == train.files
    for index, written in enumerate(TRAIN):
        assert torch.equal(scene.lrm_views.image(index), VIEWS.image(NAMES.index(written))), written
    static = replace(FORMATS[name](tmp_path), mask_use="lrm", static=True).read().lrm_views
    assert static is not None
    assert static.is_static


def test_masks_that_are_not_there_are_not_for_lrms(tmp_path):
    made = replace(colmap(tmp_path, text=False), mask_use="lrm", masks=None)
    refused(made.read, r"data\.mask_use=lrm: no training image has a mask file.*auto")
