"""Videos of several fixed cameras, written from rendered views and read back."""

import json
import logging
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.balls import ball_views, surrounding, swinging
from tests.captures import settings, write_colmap
from xplanes.components import build
from xplanes.config import compose_plain
from xplanes.errors import ConfigError, MissingSplitError, SceneError
from xplanes.optional import MissingExtraError
from xplanes.scenes import store
from xplanes.scenes import videos as recordings
from xplanes.scenes.multicamera import MultiCameraSettings, read_cameras
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Views
from xplanes.tools.inspect import choose

av = pytest.importorskip("av")
imageio = pytest.importorskip("imageio.v2")

CAMERAS, FRAMES, SIZE = 4, 6, 48


def captured(cameras: int = CAMERAS, frames: int = FRAMES) -> Views:
    """A swinging ball before grey, seen by fixed cameras: opaque, camera by camera."""
    poses = surrounding(cameras, 4.0, 0).repeat_interleave(frames, dim=0)
    times = torch.linspace(0, 1, frames).repeat(cameras)
    views = ball_views(
        len(poses), 0.6, centre=swinging(0.5, 0.3), size=SIZE, times=times, poses=poses
    )
    white = torch.tensor([0.4, 0.4, 0.4])
    pixels = torch.stack([views.composite(i, white) for i in range(len(views))])
    opaque = torch.full((*pixels.shape[:3], 4), 255, dtype=torch.uint8)
    opaque[..., :3] = (pixels * 255).round().byte()
    return replace(views, images=opaque)


VIEWS = captured()


def rgb(camera: int) -> np.ndarray:
    """Frames of a camera. uint8 [T, H, W, 3]"""
    return VIEWS.in_memory()[camera * FRAMES : (camera + 1) * FRAMES, ..., :3].numpy()


def write_video(path: Path, frames: np.ndarray, rate: float = 30) -> None:
    options = {"fps": rate, "codec": "libx264", "pixelformat": "yuv444p", "macro_block_size": 1}
    with imageio.get_writer(path, output_params=["-crf", "5"], **options) as writer:
        for frame in frames:
            writer.append_data(frame)


def write_images(folder: Path, frames: np.ndarray) -> None:
    folder.mkdir(parents=True)
    for number, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / f"{number + 5}.png")  # 10 comes after 9.


def neural_3d_video(folder: Path, write: Callable, suffix: str) -> Path:
    """The views in the layout of Neural 3D Video, with the calibration of twice their size."""
    folder.mkdir(parents=True)
    rows = []
    for camera in range(CAMERAS):
        write(folder / f"cam{camera:02d}{suffix}", rgb(camera))
        pose = VIEWS.camera_to_world[camera * FRAMES].double().numpy()
        right, up, back, centre = pose[:3].T
        focal = 2 * float(VIEWS.intrinsics.focal[0, 0])
        hwf = np.array([2 * SIZE, 2 * SIZE, focal])
        matrix = np.stack([-up, right, back, centre, hwf], axis=1)
        rows.append([*matrix.ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def with_transforms(folder: Path, name: Callable[[int], str]) -> None:
    frames = [
        {
            "file_path": name(camera),
            "transform_matrix": VIEWS.camera_to_world[camera * FRAMES].tolist(),
        }
        for camera in range(CAMERAS)
    ]
    focal = float(VIEWS.intrinsics.focal[0, 0])
    content = {"fl_x": focal, "w": SIZE, "h": SIZE, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def with_colmap(folder: Path, name: Callable[[int], str], **changes) -> None:
    """A sparse model of one image of each camera, twice as large as the frames."""
    focal, middle = 2 * float(VIEWS.intrinsics.focal[0, 0]), float(SIZE)
    lens = {
        1: ("PINHOLE", 2 * SIZE, changes.get("height", 2 * SIZE), (focal, focal, middle, middle))
    }
    images = [
        (name(camera), VIEWS.camera_to_world[camera * FRAMES].double().numpy(), 1, 3)
        for camera in range(changes.get("cameras", CAMERAS))
    ]
    write_colmap(folder / "sparse" / "0", lens, images, text=changes.get("text", False))


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return neural_3d_video(tmp_path_factory.mktemp("n3v") / "scene", write_video, ".mp4")


def read(folder: Path, splits=("train", "test"), **options):
    options = {"test_cameras": ["cam00"]} | options
    return settings(MultiCameraSettings, "multicamera", folder, **options).load(splits)


def require_rays_of(found: Views, indices: list[int]) -> None:
    expected = VIEWS.subset(torch.tensor(indices))
    assert len(found) == len(expected)
    assert torch.allclose(found.times, expected.times)
    for index in range(len(found)):
        for one, other in zip(found.image_rays(index), expected.image_rays(index), strict=True):
            assert (one - other).abs().max() < 1e-5


def test_videos_of_neural_3d_video(videos):
    scene = read(videos)
    require_rays_of(scene.splits["test"], list(range(FRAMES)))
    require_rays_of(scene.splits["train"], list(range(FRAMES, CAMERAS * FRAMES)))
    assert scene.splits["train"].files[:2] == ("cam01/000000", "cam01/000001")
    assert scene.splits["train"].is_opaque
    expected = VIEWS.in_memory()[FRAMES:].int()
    apart = (scene.splits["train"].in_memory().int() - expected).abs().float()
    assert apart.mean() < 2
    # Each frame is nearer to its own image than to the others of its camera.
    for number in range(FRAMES):
        found = scene.splits["test"].image(number).int()
        gaps = [(found - VIEWS.image(i).int()).abs().float().mean() for i in range(FRAMES)]
        assert int(torch.stack(gaps).argmin()) == number


def test_folders_of_images_keep_every_pixel(tmp_path):
    folder = neural_3d_video(tmp_path / "scene", write_images, "")
    scene = read(folder)
    assert torch.equal(scene.splits["test"].in_memory(), VIEWS.in_memory()[:FRAMES])
    assert torch.equal(scene.splits["train"].in_memory(), VIEWS.in_memory()[FRAMES:])
    (folder / "poses_bounds.npy").unlink()
    for name in (
        lambda camera: f"cam{camera:02d}",
        lambda camera: f"./cam{camera:02d}/5.png",
        lambda camera: f"cam{camera:02d}\\5",
    ):
        with_transforms(folder, name)
        assert choose([str(folder)]).scene.name == "multicamera"
        again = read(folder)
        require_rays_of(again.splits["train"], list(range(FRAMES, CAMERAS * FRAMES)))
        assert torch.equal(again.splits["train"].in_memory(), scene.splits["train"].in_memory())


@pytest.mark.parametrize(
    ("outer", "inner", "name"),
    [
        *(("", "images", "{:04d}"), ("", "4x", "view_{}"), ("", "rgb/full", "cam{:02d}")),
        ("frames", "", "CAM_{}"),
    ],
)
def test_folders_of_cameras_may_have_other_names_and_levels(tmp_path, outer, inner, name):
    plain = neural_3d_video(tmp_path / "plain", write_images, "")
    folder = tmp_path / "deeper"
    folder.mkdir()
    np.save(folder / "poses_bounds.npy", np.load(plain / "poses_bounds.npy"))
    for camera in range(CAMERAS):
        place = folder / outer / name.format(camera)
        write_images(place / inner, rgb(camera))
        if "images" in inner:
            write_images(place / "masks", rgb(camera))
    assert choose([str(folder)]).scene.name == "multicamera"
    scene = read(folder, test_cameras=[name.format(0)])
    require_rays_of(scene.splits["test"], list(range(FRAMES)))
    pixels = scene.splits["test"].in_memory()[..., :3]
    assert np.array_equal(pixels.numpy(), rgb(0))


def test_transforms_may_name_videos(videos, tmp_path):
    for video in videos.glob("*.mp4"):
        (tmp_path / video.name).write_bytes(video.read_bytes())
    with_transforms(tmp_path, lambda camera: f"cam{camera:02d}.mp4")
    one, other = read(tmp_path), read(videos)
    assert torch.equal(one.splits["train"].in_memory(), other.splits["train"].in_memory())


def test_colmap_may_have_registered_an_image_of_each_camera(tmp_path):
    folder = neural_3d_video(tmp_path / "scene", write_images, "")
    (folder / "poses_bounds.npy").unlink()
    with_transforms(folder, lambda camera: f"cam{camera:02d}")
    expected = read(folder)
    (folder / "transforms.json").unlink()
    for text, name in (
        (False, lambda camera: f"cam{camera:02d}.jpg"),
        (False, lambda camera: f"cam{camera:02d}/0005.png"),
        (True, lambda camera: f"first frames/cam{camera:02d}.png"),
    ):
        with_colmap(folder, name, text=text)
        found = read(folder)
        assert choose([str(folder)]).overrides[0] == "data=multicamera"
        for split, views in expected.splits.items():
            assert found.splits[split].files == views.files
            assert torch.equal(found.splits[split].in_memory(), views.in_memory())
            assert torch.equal(found.splits[split].times, views.times)
            for index in range(len(views)):
                mine, theirs = found.splits[split].image_rays(index), views.image_rays(index)
                for one, other in zip(mine, theirs, strict=True):
                    assert (one - other).abs().max() < 1e-5
        for path in (folder / "sparse" / "0").iterdir():
            path.unlink()
    assert found.video.files == expected.video.files


def test_images_and_cameras_that_do_not_belong_together(videos, tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    for path in videos.glob("*.mp4"):
        (folder / path.name).write_bytes(path.read_bytes())

    def refused(match: str, name: Callable[[int], str], **changes) -> None:
        with_colmap(folder, name, **changes)
        with pytest.raises(SceneError, match=match):
            read(folder)

    def plain(camera: int) -> str:
        return f"cam{camera:02d}.png"

    both = r"images\.bin: {}.*Registered images: {}.*cam\*, in .*scene: cam00\.mp4, cam01\.mp4"
    (folder / "images").mkdir()
    with_colmap(folder, plain)
    assert len(read_cameras(folder)) == CAMERAS
    left = r"left0\.png, left1\.png, left2\.png, left3\.png"
    refused(both.format("left0.png may be of no video or folder", left), "left{}.png".format)
    refused(
        both.format("cam00/1.png, cam00/2.png, .* belongs to cam00.mp4", "cam00/1.png"),
        lambda camera: f"cam00/{camera + 1}.png",
    )
    three = r"cam00\.png, cam01\.png, cam02\.png\. "
    refused(both.format("no registered image belongs to cam03.mp4", three), plain, cameras=3)
    refused(r"cam00\.mp4 has 48x48 pixels, but .* 96x48, of another aspect", plain, height=SIZE)
    (folder / "cam02.mov").write_bytes(b"")
    refused(r"cam02\.png may be of cam02\.mov or of cam02\.mp4", plain)
    (folder / "cam02.mov").unlink()
    (folder / "0001").mkdir()
    refused("cam00/0001.png may be of 0001 or of cam00", lambda camera: f"cam{camera:02d}/0001.png")
    (folder / "sparse" / "0" / "images.bin").unlink()
    with pytest.raises(SceneError, match=r"holds neither images\.bin nor images\.txt"):
        read(folder)


def test_frames_by_range_and_stride(videos):
    scene = read(videos, frames=[1, 5, 2], resolution=24)
    train = scene.splits["train"]
    assert train.files[:3] == ("cam01/000001", "cam01/000003", "cam01/000005")
    assert train.times[:4].tolist() == [0, 0.5, 1, 0]
    assert train.size(0) == (24, 24)
    expected = VIEWS.image(FRAMES + 3)[..., :3].float().view(24, 2, 24, 2, 3).mean(dim=(1, 3))
    assert (train.image(1)[..., :3] - expected).abs().mean() < 2
    assert read(videos, frames=[2, 2, 1]).splits["train"].is_static
    few = read(videos, views=5, eval_views=2)
    assert len(few.splits["train"]) == 5
    assert few.splits["train"].times[[0, -1]].sum() == 1
    assert len(few.splits["test"]) == 2


def test_the_video_is_that_of_a_training_camera(videos):
    centres = VIEWS.camera_to_world[::FRAMES, :3, 3]
    away = (centres - centres.mean(dim=0)).norm(dim=1)
    central = 1 + int(away[1:].argmin())
    video = read(videos).video
    assert video.files == tuple(f"cam{central:02d}/{number:06d}" for number in range(FRAMES))
    assert video.times.tolist() == pytest.approx(torch.linspace(0, 1, FRAMES).tolist())
    assert read(videos, splits=("train",), video_camera="cam03").video.files[0][:5] == "cam03"
    for name in ("cam00", "cam9"):
        words = f"video_camera={name} is not a training camera.*must not see.*cam01, cam02"
        with pytest.raises(SceneError, match=words):
            read(videos, video_camera=name)


def test_large_captures_are_kept_on_disk(videos, tmp_path, monkeypatch, capsys):
    expected = read(videos)
    before = sorted(videos.iterdir())
    monkeypatch.setattr(store, "IN_MEMORY", 0)
    scene = read(videos, cache=str(tmp_path / "cache"))
    assert f"{CAMERAS * FRAMES} images" in capsys.readouterr().out
    for split in ("train", "test"):
        assert scene.splits[split].is_stored
        assert torch.equal(scene.splits[split].in_memory(), expected.splits[split].in_memory())
    assert torch.equal(scene.video.in_memory(), expected.video.in_memory())
    assert scene.splits["train"].images.places[0][0].channels == 3
    # Another split, or fewer views, need nothing new.
    read(videos, splits=("test",), cache=str(tmp_path / "cache"), views=3)
    assert not capsys.readouterr().out
    assert sorted(videos.iterdir()) == before


def test_settings_of_the_command_line(videos):
    plain = compose_plain(
        "train",
        [
            "data=multicamera",
            f"data.root={videos.parent}",
            f"data.scene={videos.name}",
            "data.resolution=null",
            "data.frames=[0,2,1]",
        ],
    )
    settings = build(plain["data"], SceneSettings, "data")
    scene = settings.read()
    assert set(scene.splits) == {"train", "test"}
    assert len(scene.video) == 3
    assert not scene.static_reason
    with pytest.raises(SceneError, match=r"train_on_video=true.*already"):
        replace(settings, train_on_video=True).read()
    for frames in ([0, 1], [3, 2, 1], [-1, 2, 1], [0, 2, 0]):
        with pytest.raises(ConfigError, match="frames="):
            replace(settings, frames=frames)
    with pytest.raises(ConfigError, match=r"centre=\[1.0, 2.0\]: must be three"):
        replace(settings, centre=[1, 2])


def test_a_camera_is_held_out_by_default(videos, tmp_path, caplog):
    with caplog.at_level("INFO"):
        scene = read(videos, test_cameras=None)
    assert {file.split("/")[0] for file in scene.splits["test"].files} == {"cam00"}
    assert "held out cam00 of the cameras cam00, cam01" in caplog.text


def test_cameras_of_different_lengths_and_rates(videos, tmp_path, caplog):
    folder = tmp_path / "scene"
    folder.mkdir()
    for path in videos.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    write_video(folder / "cam02.mp4", rgb(2)[:4])
    with caplog.at_level(logging.WARNING):
        scene = read(folder)
    assert "camera cam02 has 4 frames, but cam00 6: the first 4 frames" in caplog.text
    assert len(scene.splits["train"]) == 3 * 4
    assert scene.splits["train"].times[:4].tolist() == pytest.approx([0, 1 / 3, 2 / 3, 1])
    with pytest.raises(SceneError, match=r"cam02\.mp4 has 4 frames.*data\.frames=\[0,3,1\]"):
        read(folder, frames=[0, 5, 1])
    write_video(folder / "cam02.mp4", rgb(2), rate=25)
    scene = read(folder)
    times = {camera: [] for camera in ("cam01", "cam02", "cam03")}
    for file, time in zip(scene.splits["train"].files, scene.splits["train"].times, strict=True):
        times[file.split("/")[0]].append(float(time))
    last = (FRAMES - 1) / 25
    assert times["cam02"] == pytest.approx([i / 25 / last for i in range(FRAMES)], abs=0.01)
    assert times["cam01"] == pytest.approx([i / 30 / last for i in range(FRAMES)], abs=0.01)


@pytest.mark.parametrize("apart", [0, 100])
@pytest.mark.parametrize("gone", [[FRAMES - 1], [2], [0], [1, FRAMES - 1]])
def test_a_frame_that_one_camera_lacks_is_left_out(tmp_path, apart, gone):
    folder = neural_3d_video(tmp_path / "scene", write_images, "")
    whole = read(folder).splits["train"]
    for camera in range(CAMERAS):  # Cameras may have their own numbers for the same timestep.
        for path in sorted((folder / f"cam{camera:02d}").iterdir(), key=lambda p: int(p.stem)):
            path.rename(path.with_name(f"x{int(path.stem) + apart * camera}.png"))
    for number in gone:
        (folder / "cam02" / f"x{5 + number + 2 * apart}.png").unlink()
    words = f"not all cameras have an image .* {3 * len(gone)} images are left out"
    with pytest.warns(UserWarning, match=words):
        views = read(folder).splits["train"]
    if apart and 0 in gone:
        return  # Nobody can tell whether the first or the last one is missing.
    kept = [number for number in range(FRAMES) if number not in gone]
    times = [(number - kept[0]) / (kept[-1] - kept[0]) for number in kept]
    assert views.times.tolist() == pytest.approx(times * (CAMERAS - 1))
    places = [camera * FRAMES + number for camera in range(CAMERAS - 1) for number in kept]
    assert torch.equal(views.in_memory(), whole.in_memory()[places])


def test_images_that_are_missing_beside_videos(tmp_path):
    folder = neural_3d_video(tmp_path / "scene", write_images, "")
    write_video(folder / "cam03.mp4", rgb(3))
    shutil.rmtree(folder / "cam03")
    (folder / "cam02" / "7.png").unlink()
    with pytest.raises(SceneError, match=r"numbers of cam00/7\.png, cam01/7\.png\. Add what is"):
        read(folder)


def test_folders_beside_cameras_are_none(tmp_path):
    folder = neural_3d_video(tmp_path / "scene", write_images, "")
    whole = read(folder).splits["train"]
    for name in ("camera_paths", "mv_images/00000", "mv_images/00001"):
        write_images(folder / name, rgb(0)[:1])
    assert torch.equal(read(folder).splits["train"].in_memory(), whole.in_memory())


def test_damaged_files_are_named(videos, tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    for path in videos.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    poses = np.load(folder / "poses_bounds.npy")

    def refused(match: str, error: type[Exception] = SceneError, **options) -> None:
        with pytest.raises(error, match=match):
            read(folder, **options)

    refused(r"has no split val: its splits are train, test", MissingSplitError, splits=("val",))
    refused(r"has no split test", MissingSplitError, test_cameras=[])
    refused(r"no camera cam7\. Its cameras are cam00, cam01", test_cameras=["cam7"])
    refused(r"leaves no camera", test_cameras=[f"cam0{i}" for i in range(4)])
    content = (folder / "cam01.mp4").read_bytes()
    (folder / "cam01.mp4").write_bytes(content[: len(content) // 2])
    refused(r"cam01\.mp4.*(truncated|damaged)")
    (folder / "cam01.mp4").write_bytes(b"no video")
    refused(r"cam01\.mp4 cannot be decoded as a video")
    (folder / "cam01.mp4").unlink()
    refused(r"has 4 cameras, but .* holds 3 .*: cam00\.mp4, cam02\.mp4")
    (folder / "cam01.mp4").write_bytes(content)
    for column, value, match in (
        (4, 0.0, "row 2 .*height is 0"),
        (14, np.nan, "focal length is nan"),
        (0, 3.0, "row 2 .*orthonormal"),
        (3, np.inf, "row 2 .*NaN or infinity"),
    ):
        spoilt = poses.copy()
        spoilt[2, column] = value
        np.save(folder / "poses_bounds.npy", spoilt)
        refused(match)
    np.save(folder / "poses_bounds.npy", poses[:, :16])
    refused(r"not one row of 17 numbers")
    np.save(folder / "poses_bounds.npy", np.array([{}]), allow_pickle=True)
    refused(r"poses_bounds\.npy cannot be read")
    (folder / "poses_bounds.npy").unlink()
    refused(r"neither poses_bounds\.npy .* nor transforms\.json .*cam00\.mp4")
    for name, match in (
        ("cam05.mp4", "is not a video"),
        ("../other", "leaves the scene's folder"),
        ("/cam05.mp4", "is not a video"),
        ("", "must be text"),
        (".", "is the scene's folder"),
    ):
        with_transforms(folder, lambda camera, name=name: name)
        refused(match)
    (folder / "cam00").mkdir()
    with_transforms(folder, lambda camera: f"cam0{camera}" if camera == 0 else f"cam0{camera}.mp4")
    refused(r"cam00 holds no images")
    with_transforms(folder, lambda camera: "cam01.mp4")
    refused(r"another pose than .* data=nerfstudio")


def test_cameras_of_images_need_no_pyav(tmp_path, monkeypatch, videos):
    folder = neural_3d_video(tmp_path / "scene", write_images, "")
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    assert len(read_cameras(folder)) == CAMERAS
    assert len(read(folder).splits["train"]) == 3 * FRAMES
    with pytest.raises(MissingExtraError, match=r'pip install "xplanes\[video\]"'):
        read(videos)


def test_frames_that_an_edit_list_hides_are_not_counted(tmp_path):
    whole, cut = tmp_path / "whole.mp4", tmp_path / "cut.mp4"
    write_video(whole, np.stack([np.full((32, 32, 3), 8 * i, np.uint8) for i in range(30)]))
    tool = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    command = [tool, "-loglevel", "error", "-ss", "0.5", "-i", whole, "-c", "copy", cut]
    subprocess.run([str(word) for word in command], check=True)
    with av.open(str(cut)) as container:
        assert container.streams.video[0].frames > 15, "frames before the cut are still there"
    count = recordings.read_header(cut)[1]
    assert count == 15
    shown = [int(frame.mean()) for frame in recordings.frames(cut, range(count))]
    assert shown == pytest.approx([8 * i for i in range(15, 30)], abs=2)


def write_stamped(path: Path, frames: np.ndarray, stamps: list[int], **stream_options: int) -> None:
    """A video whose frames are shown at these milliseconds."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "5"})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv444p"
        for name, value in stream_options.items():
            setattr(stream.codec_context, name, value)
        for pixels, stamp in zip(frames, stamps, strict=True):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = stamp, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def test_times_of_variable_frame_rates_are_those_of_the_files(tmp_path):
    folder = neural_3d_video(tmp_path / "scene", write_video, ".mkv")
    stamps = [0, 33, 67, 233, 267, 300]
    for camera in range(CAMERAS):
        write_stamped(folder / f"cam0{camera}.mkv", rgb(camera), stamps)
    times = read(folder).splits["train"].times
    assert times[:FRAMES].tolist() == pytest.approx([stamp / 300 for stamp in stamps], abs=0.01)


def test_a_camera_that_begins_later_is_told_of(tmp_path):
    folder = neural_3d_video(tmp_path / "scene", write_video, ".mkv")
    for camera in range(CAMERAS):
        late = 400 if camera == 2 else 0
        stamps = [late + 33 * number for number in range(FRAMES)]
        write_stamped(folder / f"cam0{camera}.mkv", rgb(camera), stamps)
    with pytest.warns(UserWarning, match=r"cam02\.mkv begins 0\.4 s after .*trim the videos"):
        assert read(folder).splits["train"].times[:FRAMES].tolist() == pytest.approx(
            [number / (FRAMES - 1) for number in range(FRAMES)]
        )


def test_hdr_videos_are_told_of(tmp_path):
    for curve, word in ((18, "HLG"), (16, "PQ")):
        path = tmp_path / f"{word}.mkv"
        write_stamped(path, rgb(0), [33 * i for i in range(FRAMES)], color_trc=curve)
        with pytest.warns(UserWarning, match=rf"is an HDR video \({word}\).*SDR"):
            recordings.read_header(path)


@pytest.mark.parametrize(("matrix", "red"), [(1, (63, 102, 240)), (5, (81, 90, 240))])
def test_red_is_red_in_the_matrices_of_hd_and_of_sd_video(tmp_path, matrix, red):
    with av.open(str(tmp_path / "red.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "1"})
        stream.height, stream.width, stream.pix_fmt = 32, 32, "yuv444p"
        stream.codec_context.colorspace = matrix
        planes = np.broadcast_to(np.array(red, np.uint8)[:, None, None], (3, 32, 32)).copy()
        container.mux(stream.encode(av.VideoFrame.from_ndarray(planes, format="yuv444p")))
        container.mux(stream.encode())
    (frame,) = recordings.frames(tmp_path / "red.mp4", range(1))
    assert np.abs(frame.astype(int) - [255, 0, 0]).max() <= 4
