"""Camera paths from files: what is read, what is rendered, what is refused."""

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.refusals import assert_refused
from xplanes.errors import ConfigError, SceneError
from xplanes.rendering.pictures import to_bytes
from xplanes.scenes.cameras import PosedCamera
from xplanes.scenes.views import Views
from xplanes.tools.camera_path import read_camera_path
from xplanes.tools.render import VideoOptions, render_video
from xplanes.tools.runs import TrainedRun, load_run


@pytest.fixture(scope="module")
def trained(trained_run: Path) -> TrainedRun:
    return load_run(trained_run)


@pytest.fixture(scope="module")
def views(trained: TrainedRun) -> Views:
    return trained.scene.splits["train"]


def write(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


SHOTS = ((40.0, 0.75), (55.0, 0.25))
"""Fields of view and times of two frames."""


def nerfstudio(views: Views, **changed: Any) -> dict[str, Any]:
    """Two cameras of training views, with different fields of view."""
    poses = views.camera_to_world[:2].flatten(1).tolist()
    return {
        "camera_type": "perspective",
        "render_height": 12,
        "render_width": 20,
        "seconds": 0.5,
        "keyframes": [],
        "camera_path": [
            {"camera_to_world": pose, "fov": fov, "aspect": 20 / 12, "render_time": time}
            for pose, (fov, time) in zip(poses, SHOTS, strict=True)
        ],
        **changed,
    }


def transforms(views: Views, **changed: Any) -> dict[str, Any]:
    frames = [{"transform_matrix": pose.tolist()} for pose in views.camera_to_world[:3]]
    return {"camera_angle_x": 0.8, "w": 16, "h": 10, "frames": frames, **changed}


def test_a_frame_is_the_render_from_its_camera_at_its_time(trained, views, tmp_path):
    path = write(tmp_path / "camera_path.json", nerfstudio(views))
    folder = render_video(trained, VideoOptions(str(path), out=f"{tmp_path}/frames/"))
    for index, (fov, time) in enumerate(SHOTS):
        focal = 6 / math.tan(math.radians(fov / 2))
        rays = PosedCamera(views.camera_to_world[index], focal, 12, 20).rays()
        image = trained.module.renderer.image(
            trained.module.field, *trained.frame.rays(*rays), time, trained.scene.background
        )
        expected = to_bytes(image["colour"].view(12, 20, 3)).numpy().astype(int)
        found = np.asarray(Image.open(folder / f"frame_{index:04d}.png")).astype(int)
        assert np.abs(found - expected).max() <= 1
        assert np.ptp(expected) > 30


def test_a_transforms_file_is_a_path(views, tmp_path):
    path = read_camera_path(write(tmp_path / "a.json", transforms(views, fps=7)))
    assert torch.equal(path.poses, views.camera_to_world[:3])
    assert path.times.tolist() == [0, 0.5, 1]
    assert (path.height, path.width, path.fps) == (10, 16, 7)
    assert path.focal(10, 16).tolist() == pytest.approx([8 / math.tan(0.4)] * 3)


def test_sizes_rates_and_times_can_be_set(views, tmp_path):
    path = str(write(tmp_path / "a.json", nerfstudio(views)))
    written, changed = VideoOptions(path=path), VideoOptions(path=path, size=10, fps=9, time="0.5")
    assert (written.shape({"train": views}), written.rate) == ((12, 20), 4)
    assert (changed.shape({"train": views}), changed.rate) == ((6, 10), 9)
    assert written.times({"train": views}).tolist() == [0.75, 0.25]
    assert changed.times({"train": views}).tolist() == [0.5, 0.5]


def test_times_of_a_spline_that_overshoots_stay_in_range(views, tmp_path, caplog):
    content = nerfstudio(views)
    for entry, time in zip(content["camera_path"], (-0.03, 1.08), strict=True):
        entry["render_time"] = time
    assert read_camera_path(write(tmp_path / "a.json", content)).times.tolist() == [0, 1]
    assert "2 of 2 times lie a little below 0 or above 1" in caplog.text


def test_damaged_paths_are_refused(views, tmp_path):
    path, usual = tmp_path / "a.json", nerfstudio(views)

    def entry(**changed: Any) -> dict[str, Any]:
        first, second = usual["camera_path"]
        return {**usual, "camera_path": [first, {**second, **changed}]}

    for content, words in [
        ([], "must hold a JSON object"),
        ({}, 'Its key "camera_path"'),
        ({**usual, "camera_path": []}, "holds no cameras"),
        ({**usual, "camera_path": [3]}, r"camera_path\[0\] is 3"),
        ({**usual, "camera_type": "fisheye"}, "camera_type is 'fisheye'"),
        ({**usual, "render_width": 0}, "render_width is 0"),
        (entry(fov=180), r"camera_path\[1\]: fov is 180"),
        (entry(render_time=None), r"camera_path\[1\]: render_time is None"),
        (entry(render_time=1.5), r"camera_path\[1\]: render_time is 1.5"),
        (entry(camera_to_world=[1.0] * 11), r"camera_path\[1\]: camera_to_world must be"),
        (transforms(views, camera_angle_x=None), "camera_angle_x is None"),
    ]:
        call = partial(read_camera_path, write(path, content))
        assert_refused(SceneError, words, call, content)
    path.unlink()
    assert_refused(SceneError, "no such camera path", VideoOptions(path=str(path)).check, "no file")


def test_options_that_contradict_the_path_are_refused(views, tmp_path):
    path = str(write(tmp_path / "a.json", nerfstudio(views)))
    with pytest.raises(ConfigError, match=r"--frames 5.*2 cameras"):
        VideoOptions(path=path, frames=5).check()
    wide = str(write(tmp_path / "b.json", nerfstudio(views, render_width=10_000)))
    with pytest.raises(ConfigError, match="10000 px"):
        VideoOptions(path=wide).check()
    VideoOptions(path=wide, size=64).check()
