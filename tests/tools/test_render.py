"""Rendered videos: camera paths, times and output files."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from xplanes.errors import ConfigError
from xplanes.evaluation.render import training_path, write_video
from xplanes.optional import MissingExtraError
from xplanes.rendering.pictures import to_bytes
from xplanes.tools.render import VideoOptions, cameras, find_view, render_video, times
from xplanes.tools.runs import TrainedRun, load_run
from xplanes.training.scores import score_view


@pytest.fixture(scope="module")
def trained(trained_run: Path) -> TrainedRun:
    return load_run(trained_run)


def test_ways_through_time():
    assert times("sweep", 5).tolist() == [0, 0.25, 0.5, 0.75, 1]
    assert times("back-and-forth", 4).tolist() == [0, 0.5, 1, 0.5]
    assert times("0.3", 2).tolist() == pytest.approx([0.3, 0.3])


def poses(trained: TrainedRun, options: VideoOptions) -> torch.Tensor:
    seen = cameras(options, trained.scene.splits, trained.frame)
    return torch.stack([camera.camera_to_world for camera in seen])


def test_camera_paths(trained):
    centre = trained.frame.centre
    orbit = poses(trained, VideoOptions(frames=6, elevation=30))
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
    with pytest.raises(ConfigError, match="holds files already"):
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


def test_an_mp4_without_the_extra_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtraError, match=r'-e "\.\[video\]"'):
        VideoOptions(out="video.mp4").check()


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
        ({"out": "a.png"}, "not 48"),
    ],
)
def test_options_that_cannot_be_are_refused(options, words):
    with pytest.raises(ConfigError, match=words):
        VideoOptions(**options).check()


def test_a_video_stays_with_the_camera_of_a_rig(trained):
    views = trained.scene.splits["train"]
    poses = views.camera_to_world[[0, 1, 1, 1, 1, 0]]
    rig = replace(views.subset(range(6)), camera_to_world=poses, times=torch.arange(6) / 5)
    indices, seen_at = training_path(rig, 5)
    assert indices == [1] * 5
    assert seen_at.tolist() == [0, 0.25, 0.5, 0.75, 1]


def moving(views, times):
    """Views from as many places as there are times, all by one camera."""
    return replace(views.subset(range(len(times))), times=torch.tensor(times))


def test_a_video_follows_a_moving_camera_at_its_times(trained):
    views = trained.scene.splits["train"]
    seen = moving(views, [0.5, 0.0, 1.0, 0.25, 0.75])
    indices, seen_at = training_path(seen, 5)
    assert indices == [1, 3, 0, 4, 2]
    assert seen_at.tolist() == [0, 0.25, 0.5, 0.75, 1]
    assert training_path(seen, 3)[0] == [1, 0, 2]
    still = moving(views, [0.0] * 6)
    assert training_path(still, 7)[0] == [0, 1, 2, 2, 3, 4, 5]
    # A camera that stands still at first is no rig.
    poses = views.camera_to_world[[0, 0, 0, 1, 2, 3, 4, 5]]
    paused = replace(moving(views, [t / 7 for t in range(8)]), camera_to_world=poses)
    assert training_path(paused, 8)[0] == list(range(8))


def test_a_video_does_not_jump_between_cameras(trained):
    views = trained.scene.splits["train"]
    near, far = (views.camera_to_world[0].clone() for _ in range(2))
    far[0, 3] += 3
    poses = torch.stack([near, far] * 4)
    poses[:, 1, 3] += torch.arange(8) / 10
    # Two views of each timestep: from each the one beside the last.
    pairs = replace(moving(views, [0.0, 0.0, 0.3, 0.3, 0.6, 0.6, 1.0, 1.0]), camera_to_world=poses)
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


def test_cameras_of_the_training_views_are_a_path(trained):
    options = VideoOptions("cameras", frames=3, size=20)
    found = cameras(options, trained.scene.splits, trained.frame)
    views = trained.scene.splits["train"]
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
