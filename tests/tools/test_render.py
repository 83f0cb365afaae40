"""Rendered videos: cameras, also those of files, times and output files."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from tests.refusals import assert_refused
from xplanes.errors import ConfigError, SceneError
from xplanes.evaluation.render import training_path, write_video
from xplanes.rendering.pictures import to_bytes
from xplanes.scenes.cameras import PosedCamera
from xplanes.scenes.views import Views
from xplanes.tools.camera_path import read_camera_path
from xplanes.tools.render import VideoOptions, find_view, render_video, times
from xplanes.tools.runs import TrainedRun
from xplanes.training.scores import score_view


@pytest.fixture(scope="module")
def views(trained: TrainedRun) -> Views:
    return trained.scene.splits["train"]


def test_ways_through_time():
    assert times("sweep", 5).tolist() == [0, 0.25, 0.5, 0.75, 1]
    assert times("back-and-forth", 4).tolist() == [0, 0.5, 1, 0.5]
    assert times("0.3", 2).tolist() == pytest.approx([0.3, 0.3])


def poses(trained: TrainedRun, options: VideoOptions) -> torch.Tensor:
    track = options.track(trained.scene, trained.frame)
    return torch.stack([camera.camera_to_world for camera in track.cameras])


def test_camera_paths(trained):
    centre = trained.frame.centre
    orbit = poses(trained, VideoOptions("orbit", frames=6, elevation=30))
    reach = (orbit[:, :3, 3] - centre).norm(dim=-1)
    assert reach.tolist() == pytest.approx([float(reach[0])] * 6, rel=1e-5)
    height = (orbit[:, 2, 3] - centre[2]) / reach
    assert height.tolist() == pytest.approx([0.5] * 6, abs=1e-5)
    fixed = poses(trained, VideoOptions(path="fixed", frames=3, elevation=30))
    assert torch.equal(fixed, orbit[:1].expand(3, 4, 4))


def test_a_view_is_found_by_its_name(trained):
    splits = trained.scene.splits
    expected = splits["test"].camera_to_world[1]
    for name in ("test/r_001.png", "test/r_001"):
        views, index = find_view(splits, name)
        assert torch.equal(views.camera_to_world[index], expected)
    with pytest.raises(ConfigError, match=r"test/r_00\d\.png"):
        find_view(splits, "test/r_0011")


def test_the_camera_of_a_view_renders_that_view(trained, tmp_path):
    views = trained.views
    parts = (trained.module.field, trained.module.renderer, trained.frame)
    expected = to_bytes(score_view(*parts, views, 1, torch.ones(3))[1]["colour"]).numpy()
    own = str(float(views.times[1]))
    for name, time in (("a.png", None), ("b.png", "own"), ("c.png", own), ("d.webp", "own")):
        options = VideoOptions("view:test/r_001", time, out=str(tmp_path / name))
        path = render_video(trained, options)
        picture = np.asarray(Image.open(path).convert("RGB")).astype(int)
        if path.suffix == ".png":
            assert np.array_equal(picture, expected), name
    jpeg = render_video(trained, VideoOptions("view:test/r_001", out=str(tmp_path / "e.jpg")))
    with Image.open(jpeg) as picture:
        assert picture.format == "JPEG"
        assert np.abs(np.asarray(picture).astype(int) - expected).mean() < 4
    # A folder or a video of several frames lets time pass.
    assert VideoOptions("view:test/r_001", out="video.webp").count == 48
    assert VideoOptions("view:test/r_001", frames=3, out="a.png").count == 3


def test_a_webp_is_the_default(trained):
    options = VideoOptions(frames=3, size=20, fps=10, time="sweep", what="depth")
    path = render_video(trained, options)
    assert path == trained.path / "media" / "render_orbit_sweep_depth.webp"
    with Image.open(path) as picture:
        assert (picture.n_frames, picture.size) == (3, (20, 20))  # type: ignore[attr-defined]
        picture.load()
        assert picture.info["duration"] == 100


def test_frames_of_a_webp_last_as_long_together_as_asked(tmp_path):
    frames = [torch.full((4, 4, 3), 10 * number, dtype=torch.uint8) for number in range(24)]
    path, durations = write_video(tmp_path / "a.webp", frames, fps=60), []
    with Image.open(path) as picture:
        for frame in ImageSequence.Iterator(picture):
            frame.load()
            durations.append(frame.info["duration"])
    assert sum(durations) == 400
    assert set(durations) == {16, 17}


def test_a_folder_takes_a_png_per_frame_and_no_others(trained, tmp_path):
    options = VideoOptions(frames=2, size=16, out=f"{tmp_path}/frames/")
    folder = render_video(trained, options)
    assert sorted(p.name for p in folder.iterdir()) == ["frame_0000.png", "frame_0001.png"]
    with pytest.raises(ConfigError, match="already contains files"):
        render_video(trained, options)


def test_an_mp4_keeps_its_frames(tmp_path):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    frames = [torch.full((35, 50, 3), value, dtype=torch.uint8) for value in (20, 120, 220)]
    path = write_video(tmp_path / "video.mp4", frames, fps=8)
    read = imageio.mimread(path)
    assert len(read) == 3
    assert read[0].shape == (34, 50, 3)
    assert [float(frame.mean()) for frame in read] == pytest.approx([20, 120, 220], abs=4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        *(
            ({"time": time}, f"--time {time}.*from 0 to 1")
            for time in ("1.1", "-0.1", "nan", "soon")
        ),
        ({"time": "own"}, "--time own: is a view's own time and needs --path view:FILE"),
        ({"path": "spiral"}, "--path spiral"),
        ({"frames": 0}, "--frames 0"),
        ({"fps": 0}, "--fps 0"),
        ({"size": -4}, "--size -4"),
        ({"size": 0}, "--size 0"),
        ({"elevation": 100}, "--elevation 100"),
        ({"out": "video.gif"}, "end in .webp"),
        ({"out": "video"}, "end in"),
        ({"out": "a.png"}, "there are 48"),
    ],
)
def test_options_that_cannot_be_are_refused(options, words):
    with pytest.raises(ConfigError, match=words):
        VideoOptions(**options).check()


def seen(views: Views, places: Sequence[int], times: Sequence[float]) -> Views:
    """Views by one camera, from places of these views, at times."""
    poses = views.camera_to_world[[*places]]
    return replace(
        views.subset(range(len(times))), camera_to_world=poses, times=torch.tensor(times)
    )


@pytest.mark.parametrize(
    ("places", "times", "expected"),
    [
        ([0, 1, 1, 1, 1, 0], [0, 0.2, 0.4, 0.6, 0.8, 1], [1] * 5),  # A rig: it stays with a camera.
        (range(5), [0.5, 0.0, 1.0, 0.25, 0.75], [1, 3, 0, 4, 2]),
        (range(5), [0.5, 0.0, 1.0, 0.25, 0.75], [1, 0, 2]),
        (range(6), [0.0] * 6, [0, 1, 2, 2, 3, 4, 5]),
        # A camera that stands still at first is no rig.
        ([0, 0, 0, 1, 2, 3, 4, 5], [t / 7 for t in range(8)], [*range(8)]),
    ],
)
def test_a_video_follows_its_camera_at_its_times(views, places, times, expected):
    rig = seen(views, places, times)
    indices, seen_at = training_path(rig, len(expected))
    assert indices == expected
    if any(times):
        torch.testing.assert_close(seen_at, torch.linspace(0, 1, len(expected)))


def test_a_video_does_not_jump_between_cameras(views):
    # Two views of each timestep: from each the one beside the last.
    pairs = seen(views, [0] * 8, [0.0, 0.0, 0.3, 0.3, 0.6, 0.6, 1.0, 1.0])
    pairs.camera_to_world[1::2, 0, 3] += 3
    pairs.camera_to_world[:, 1, 3] += torch.arange(8) / 10
    assert training_path(pairs, 4)[0] == [0, 2, 4, 6]
    # In turn: the camera with most views, which its focal length tells.
    focal = pairs.intrinsics.focal * torch.tensor([1, 1.1, 1, 1.1, 1, 1.1, 1.1, 1.1])[:, None]
    lenses = replace(pairs.intrinsics, focal=focal)
    turns = replace(pairs, times=torch.arange(8) / 7, intrinsics=lenses)
    assert training_path(turns, 5)[0] == [1, 3, 5, 6, 7]


def test_a_video_of_surroundings_stays_with_the_cameras_by_default(trained):
    alone, inside = (SimpleNamespace(is_surrounded=seen) for seen in (False, True))
    chosen = [
        options.chosen_for(scene).path  # pyright: ignore
        for options in (VideoOptions(), VideoOptions(elevation=50), VideoOptions("fixed"))
        for scene in (alone, inside)
    ]
    assert chosen == ["orbit", "cameras", "orbit", "orbit", "fixed", "fixed"]


def test_cameras_of_the_training_views_are_a_path(trained, views):
    options = VideoOptions("cameras", frames=3, size=20)
    found = options.track(trained.scene, trained.frame).cameras
    indices, _ = training_path(views, 3)
    for camera, index in zip(found, indices, strict=True):
        own = views.camera(index)
        assert torch.equal(camera.camera_to_world, own.camera_to_world)
        assert (camera.height, camera.width) == (20, 20)
        corners = [seen.rays()[1].view(seen.height, seen.width, 3) for seen in (camera, own)]
        middles = [rays.mean(dim=(0, 1)) for rays in corners]
        torch.testing.assert_close(*middles, atol=1e-3, rtol=0)
    path = render_video(trained, replace(options, time="own"))
    assert path.name == "render_cameras_own.webp"
    with Image.open(path) as video:
        assert (video.n_frames, video.size) == (3, (20, 20))  # type: ignore[attr-defined]


# Camera paths from files


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


def test_sizes_rates_and_times_can_be_set(trained, views, tmp_path):
    path = str(write(tmp_path / "a.json", nerfstudio(views)))
    written, changed = VideoOptions(path=path), VideoOptions(path=path, size=10, fps=9, time="0.5")
    for options, size, rate, seen_at in (
        (written, (12, 20), 4, [0.75, 0.25]),
        (changed, (6, 10), 9, [0.5, 0.5]),
    ):
        track = options.track(trained.scene, trained.frame)
        assert {(camera.height, camera.width) for camera in track.cameras} == {size}
        assert (track.times.tolist(), options.rate) == (seen_at, rate)


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

    for content, words in (
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
    ):
        assert_refused(SceneError, words, partial(read_camera_path, write(path, content)), content)
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
