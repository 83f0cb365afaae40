"""Captures as LLFF's tools write them."""

import numpy as np
import pytest
import torch

from tests.captures import HEIGHT, WIDTH, picture, poses, save, settings, write_colmap, write_rows
from tests.scenes.common import refused, told
from xplanes.readers.colmap import ColmapSettings
from xplanes.readers.llff import LlffSettings
from xplanes.readers.multicamera import MultiCameraSettings

COUNT = 10


@pytest.fixture
def folder(tmp_path):
    """Images in two sizes, of cameras whose axes are down, right and back in the file."""
    for index in range(COUNT):
        save(tmp_path / "fern/images" / f"IMG_{index}.JPG", picture(index, 2 * HEIGHT, 2 * WIDTH))
        save(tmp_path / "fern/images_2" / f"IMG_{index}.png", picture(index))
    write_rows(tmp_path / "fern", poses(COUNT), 2 * HEIGHT, 2 * WIDTH, 70.0)
    return tmp_path / "fern"


def read(folder, splits=("train",), **changes):
    changes = {"orient": False, "eval_every": 100, **changes}
    return settings(LlffSettings, "llff", folder, **changes).load(splits)


@pytest.mark.parametrize(("resolution", "width"), [(None, 80), (80, 80), (41, 41), (40, 40)])
def test_cameras_and_images_of_the_width_asked_for(folder, resolution, width):
    assert LlffSettings.recognises(folder)
    assert not MultiCameraSettings.recognises(folder)
    scene = read(folder, resolution=resolution)
    views = scene.splits["train"]
    assert views.width == width
    assert views.files[3] == ("images_2/IMG_3.png" if width == 40 else "images/IMG_3.JPG")
    assert views.intrinsics.focal[0].tolist() == pytest.approx([70 * width / 80] * 2, rel=0.01)
    found = torch.from_numpy(poses(COUNT)).float()
    torch.testing.assert_close(views.camera_to_world, found, atol=1e-6, rtol=0)
    assert views.is_static
    assert scene.notes["times"].startswith("none, as in LLFF's static captures")


def test_captures_of_dynamic_scenes_have_the_times_in_their_names(folder):
    assert read(folder, static=False).splits["train"].times[3] == pytest.approx(3 / 9)
    (folder / "camera_paths").mkdir()
    assert LlffSettings.recognises(folder)
    assert not MultiCameraSettings.recognises(folder)
    for number in range(3):  # Nvidia's Dynamic Scenes have a folder for each timestep.
        save(folder / f"mv_images/{number:05d}/cam01.png", picture(number))
    assert LlffSettings.recognises(folder)
    assert not MultiCameraSettings.recognises(folder)
    (folder / "motion_masks").mkdir()
    with pytest.warns(UserWarning, match="motion_masks is not read"):
        scene = read(folder)
    assert scene.splits["train"].times[3] == pytest.approx(3 / 9)
    assert "IMG_9.JPG -> 9" in scene.notes["times"]
    assert read(folder, static=True).splits["train"].times.tolist() != [0.0] * COUNT


@pytest.mark.parametrize("changes", [{"static": False}, {}], ids=str)
def test_numbers_of_cameras_are_times_of_dynamic_scenes(tmp_path, changes):
    for index in range(4):
        save(tmp_path / f"jump/images/cam{index:02d}.png", picture(index))
    write_rows(tmp_path / "jump", poses(4), HEIGHT, WIDTH, 36.0)
    if not changes:
        (tmp_path / "jump/flow_i1").mkdir()
    with pytest.warns(UserWarning, match="of cameras") as warned:
        views = read(tmp_path / "jump", **changes).splits["train"]
    assert views.times.tolist() == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert not any("time_pattern" in str(each.message) for each in warned)


def test_models_of_colmap_beside_it_are_preferred(folder):
    """As Mip-NeRF 360's captures have them."""
    camera = {1: ("PINHOLE", 2 * WIDTH, 2 * HEIGHT, (70.0, 70.0, float(WIDTH), float(HEIGHT)))}
    images = [(f"IMG_{index}.JPG", pose, 1, 0) for index, pose in enumerate(poses(COUNT))]
    write_colmap(folder / "sparse/0", camera, images)
    assert ColmapSettings.recognises(folder)
    assert not LlffSettings.recognises(folder)
    found = settings(ColmapSettings, "colmap", folder).load(["train"])
    assert found.notes["poses"].startswith("those of COLMAP; data=llff reads poses_bounds.npy")
    assert found.splits["train"].is_static
    assert "data.static=false" in found.notes["times"]
    found = settings(ColmapSettings, "colmap", folder, static=False).load(["train"])
    assert found.splits["train"].times[1] == pytest.approx(1 / 9)
    (folder / "flow").mkdir()
    assert LlffSettings.recognises(folder)


def test_rows_that_are_not_finite_are_left_out(folder):
    rows = np.load(folder / "poses_bounds.npy")
    rows[4, 0] = np.nan
    np.save(folder / "poses_bounds.npy", rows)
    with told(r"1 of 10 rows are left out:\n.*row 4 \(IMG_4.JPG\)"):
        files = [file for views in read(folder).splits.values() for file in views.files]
    assert len(files) == 9
    assert not any("IMG_4" in file for file in files)


def test_other_numbers_of_images_than_of_rows(folder):
    (folder / "images/IMG_4.JPG").unlink()
    assert read(folder).splits["train"].files[0].startswith("images_2/")
    next(path for path in (folder / "images_2").iterdir() if "IMG_4" in path.name).unlink()
    refused(lambda: read(folder), "has 10 cameras, but .* holds 9")
    (folder / "poses_bounds.npy").unlink()
    refused(lambda: read(folder), "holds no poses_bounds.npy and")
