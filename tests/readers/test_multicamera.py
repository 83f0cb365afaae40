"""Videos of several fixed cameras, written from rendered views and read back."""

import itertools
import json
import shutil
import subprocess
import zipfile
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.balls import ball_views, surrounding, swinging
from tests.captures import save, settings, write_colmap, write_rows
from tests.scenes.common import assert_same_rays, refused, told
from tests.training.runs import changed
from xplanes.components import build
from xplanes.errors import ConfigError, MissingSplitError, SceneError
from xplanes.optional import MissingExtraError
from xplanes.readers import videos as recordings
from xplanes.readers.colmap import ColmapSettings
from xplanes.readers.listing import Calibration
from xplanes.readers.llff import LlffSettings
from xplanes.readers.multicamera import MultiCameraSettings, Recording, _are_stamped
from xplanes.readers.nerfstudio import NerfstudioSettings
from xplanes.readers.rigs import Camera, read_cameras, recordings_of_cameras
from xplanes.scenes import store
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Scene, Views

av = pytest.importorskip("av")
imageio = pytest.importorskip("imageio.v2")

CAMERAS, FRAMES, SIZE = 4, 6, 48


def captured() -> Views:
    """A swinging ball before grey, seen by fixed cameras: opaque, camera by camera."""
    poses = surrounding(CAMERAS, 4.0, 0).repeat_interleave(FRAMES, dim=0)
    times = torch.linspace(0, 1, FRAMES).repeat(CAMERAS)
    views = ball_views(
        len(poses), 0.6, centre=swinging(0.5, 0.3), size=SIZE, times=times, poses=poses
    )
    images = views.in_memory().clone()
    images[images[..., 3] == 0] = 102
    images[..., 3] = 255
    return replace(views, images=images)


VIEWS = captured()
POSES = VIEWS.camera_to_world[::FRAMES].double().numpy()
FOCAL = float(VIEWS.intrinsics.focal[0, 0])


def rgb(camera: int) -> np.ndarray:
    """Frames of a camera. uint8 [T, H, W, 3]"""
    return VIEWS.in_memory()[camera * FRAMES : (camera + 1) * FRAMES, ..., :3].numpy()


def write_video(path: Path, frames: np.ndarray, rate: float = 30) -> None:
    options = {"fps": rate, "codec": "libx264", "pixelformat": "yuv444p", "macro_block_size": 1}
    with imageio.get_writer(path, output_params=["-crf", "5"], **options) as writer:
        for frame in frames:
            writer.append_data(frame)


def write_images(folder: Path, frames: np.ndarray) -> None:
    for number, frame in enumerate(frames):
        save(folder / f"{number + 5}.png", frame)  # 10 comes after 9.


def neural_3d_video(folder: Path, write: Callable, suffix: str) -> Path:
    """The views in the layout of Neural 3D Video, with the calibration of twice their size."""
    folder.mkdir(parents=True)
    for camera in range(CAMERAS):
        write(folder / f"cam{camera:02d}{suffix}", rgb(camera))
    write_rows(folder, POSES, 2 * SIZE, 2 * SIZE, 2 * FOCAL)
    return folder


def with_transforms(folder: Path, name: str, change=lambda frames: None, **keys) -> None:
    """The poses in a transforms.json with the place of each camera, whose frames may change."""
    frames = [
        {"file_path": name.format(camera), "transform_matrix": pose.tolist()}
        for camera, pose in enumerate(POSES)
    ]
    change(frames)
    content = {"fl_x": FOCAL, "w": SIZE, "h": SIZE, **keys, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    (folder / "poses_bounds.npy").unlink(missing_ok=True)


def with_colmap(folder: Path, name, *, height=2 * SIZE, cameras=CAMERAS, text=False) -> None:
    """The poses in a sparse model of one image of each camera, twice as large as the frames."""
    name = name.format if isinstance(name, str) else name
    lens = {1: ("PINHOLE", 2 * SIZE, height, (2 * FOCAL, 2 * FOCAL, float(SIZE), float(SIZE)))}
    images = [(name(camera), POSES[camera], 1, 3) for camera in range(cameras)]
    write_colmap(folder / "sparse" / "0", lens, images, text=text)
    (folder / "poses_bounds.npy").unlink(missing_ok=True)


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Videos, not to be changed."""
    return neural_3d_video(tmp_path_factory.mktemp("n3v") / "scene", write_video, ".mp4")


@pytest.fixture
def copied(videos: Path, tmp_path: Path) -> Path:
    """The same videos, which may be changed."""
    return shutil.copytree(videos, tmp_path / "copied")


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """The same frames as images."""
    return neural_3d_video(tmp_path / "scene", write_images, "")


def read(folder: Path, splits=("train", "test"), **options):
    options = {"test_cameras": ["cam00"]} | options
    return settings(MultiCameraSettings, "multicamera", folder, **options).load(splits)


def refuse(folder: Path, words: str, error: type[Exception] = SceneError, **options) -> None:
    refused(partial(read, folder, **options), words, case=(words, options), error=error)


def require_rays_of(found: Views, indices: list[int]) -> None:
    expected = VIEWS.subset(torch.tensor(indices))
    assert len(found) == len(expected)
    assert torch.allclose(found.times, expected.times)
    for index in range(len(found)):
        assert_same_rays(found, index, expected, index)


def require_all(scene: Scene) -> None:
    """All frames are there with every pixel, those of the first camera as test views."""
    for split, first, last in (("test", 0, FRAMES), ("train", FRAMES, len(VIEWS))):
        require_rays_of(scene.splits[split], list(range(first, last)))
        assert torch.equal(scene.splits[split].in_memory(), VIEWS.in_memory()[first:last])


def require_recognised(folder: Path) -> None:
    """No other format takes the folder for its own."""
    kinds = (ColmapSettings, LlffSettings, NerfstudioSettings, MultiCameraSettings)
    assert [kind for kind in kinds if kind.recognises(folder)] == [MultiCameraSettings]


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


@pytest.mark.parametrize("place", ["GX01{:04d}.MP4", "iphone-{}.mp4", "videos/cam{:02d}.mp4"])
def test_videos_of_other_names_or_beside_their_images(copied, place):
    (copied / place).parent.mkdir(exist_ok=True)
    names = [place.format(camera) for camera in range(CAMERAS)]
    for camera, name in enumerate(names):
        (copied / f"cam{camera:02d}.mp4").rename(copied / name)
        if "/" in name:
            write_images(copied / "images" / Path(name).stem, rgb(camera))
    (copied / "._GX010000.MP4").write_bytes(b"")
    require_recognised(copied)
    found = read(copied, test_cameras=[Path(names[0]).stem])
    require_rays_of(found.splits["test"], list(range(FRAMES)))
    assert not (found.splits["test"].in_memory() == VIEWS.in_memory()[:FRAMES]).all()  # Videos.


def test_folders_of_images_keep_every_pixel(images):
    for name in ("camera_paths", "mv_images/00000", "mv_images/00001"):  # Which are no cameras.
        write_images(images / name, rgb(0)[:1])
    (images / "camera_path.mp4").write_bytes(b"")
    require_all(read(images))
    for name in ("camera_paths", "mv_images"):
        shutil.rmtree(images / name)
    (images / "camera_path.mp4").unlink()
    for name in ("cam{:02d}", "./cam{:02d}/5.png", "cam{:02d}\\5"):
        with_transforms(images, name)
        require_recognised(images)
        require_all(read(images))


def test_cameras_in_map_coordinates_are_read_relative_to_a_point_near_them(images):
    moved = POSES.copy()
    moved[:, :3, 3] += [500_000, 5_400_000, 300]
    write_rows(images, moved, 2 * SIZE, 2 * SIZE, 2 * FOCAL)
    with told(r"read relative to \(500001, 5399999, 302\)"):
        found = read(images, orient=False).splits["train"].camera_to_world[::FRAMES, :3, 3]
    away = (found - found[:1]) - torch.from_numpy(POSES[1:, :3, 3] - POSES[1:2, :3, 3])
    assert away.abs().max() < 1e-5


@pytest.mark.parametrize(
    ("outer", "inner", "name"),
    [
        *(("", "images", "{:04d}"), ("", "4x", "view_{}"), ("", "rgb/full", "cam{:02d}")),
        *(("frames", "", "CAM_{}"), ("", "", "Camera.{:03d}")),
    ],
)
def test_folders_of_cameras_may_have_other_names_and_levels(videos, tmp_path, outer, inner, name):
    shutil.copy(videos / "poses_bounds.npy", tmp_path)
    for camera in range(CAMERAS):
        place = tmp_path / outer / name.format(camera)
        write_images(place / inner, rgb(camera))
        if "images" in inner:
            write_images(place / "masks", rgb(camera))
    require_recognised(tmp_path)
    require_all(read(tmp_path, test_cameras=[name.format(0)]))


def in_folders(images: Path, what: str, name: str) -> None:
    """Frames of each camera as images or a video in its folder, with masks beside them."""
    for camera in range(CAMERAS):
        shutil.rmtree(images / f"cam{camera:02d}")
        folder = images / name.format(camera)
        write_images(folder / "masks", rgb(camera))
        if what == "images":
            write_images(folder / what, rgb(camera))
        else:
            write_video(folder / what, rgb(camera))
            (folder / f"._{what}").write_bytes(b"")


@pytest.mark.parametrize("calibration", ["poses", "transforms", "folders", "colmap", "below"])
@pytest.mark.parametrize("what", ["images", "clip.mp4"])
@pytest.mark.parametrize("name", ["cam{:02d}", "Camera.{:03d}"])
def test_sources_of_one_name_in_folders_of_cameras(images, calibration, what, name):
    in_folders(images, what, name)
    if calibration in ("transforms", "folders"):
        inner = f"/{what}" + "/5.png" * (what == "images")
        with_transforms(images, name + inner * (calibration == "transforms"))
    elif calibration != "poses":
        with_colmap(images, f"{name}/images/5.png" if calibration == "below" else f"{name}.png")
    require_recognised(images)
    with told(r"scene: \S+0/masks, \S+1/masks, .* is not read.*alpha channel"):
        found = read(images, test_cameras=[name.format(0)])
    assert {file.split("/")[0] for file in found.splits["test"].files} == {name.format(0)}
    require_rays_of(found.splits["test"], list(range(FRAMES)))
    assert len(found.splits["train"]) == len(VIEWS) - FRAMES
    shown = found.splits["test"].in_memory()[..., :3].float()
    assert (shown - torch.from_numpy(rgb(0)).float()).abs().mean() < 6  # And no masks.


@pytest.mark.parametrize(
    ("mask", "outer"), [("masks/cam{:02d}", "images"), ("cam{:02d}_mask.mp4", ""), ("matte", "rgb")]
)
def test_masks_of_a_rig_are_no_cameras_and_told_of(images, mask, outer):
    if outer:
        move(images, outer)
    for camera in range(CAMERAS):
        path = images / mask.format(camera)
        if path.suffix:
            path.write_bytes(b"")
        else:
            write_images(path, rgb(camera))
    require_recognised(images)
    with told("scene: (masks|matte|cam00_mask.mp4, .*) is not read.*alpha channel"):
        require_all(read(images))


@pytest.mark.parametrize("name", ["cam{:02d}/masked_{}.png", "masked_rig/cam{:02d}/{}.png"])
def test_frames_whose_names_speak_of_masks_are_read(images, name):
    for path in sorted(images.glob("cam*/*")):
        new = images / name.format(int(path.parent.name[3:]), path.stem)
        new.parent.mkdir(parents=True, exist_ok=True)
        path.rename(new)
        if "rig" in name and not [*path.parent.iterdir()]:
            path.parent.rmdir()
    with told(None):
        require_all(read(images))


@pytest.mark.parametrize("outer", ["normal_speed", "seg1"])
@pytest.mark.parametrize("calibration", ["poses", "colmap"])
def test_folders_of_cameras_may_be_called_like_other_kinds(images, outer, calibration):
    move(images, outer)
    if calibration == "colmap":
        with_colmap(images, "cam{:02d}.png")
    require_recognised(images)
    require_all(read(images))


@pytest.mark.parametrize("empty", ["", None])
def test_frames_of_a_rig_without_a_file_are_left_out(images, empty):
    def insert(frames: list) -> None:
        frames.insert(1, {**frames[0], "file_path": empty})

    with_transforms(images, "cam{:02d}", insert)
    require_recognised(images)
    with told("1 of 5 frames are left out:\n.*frame 1 "):
        require_all(read(images))


def test_videos_of_masks_belong_to_no_row_or_registered_image(copied):
    for camera in range(CAMERAS):
        (copied / f"cam{camera:02d}.mp4").rename(copied / f"GX{camera}.mp4")
        (copied / f"GX{camera}_mask.mp4").write_bytes(b"")
    require_recognised(copied)
    with told("GX0_mask.mp4, .* is not read"):
        read(copied, test_cameras=["GX0"])
    for path in copied.glob("GX*"):
        path.rename(copied / path.name.replace("GX", "cam0"))
    with_colmap(copied, "cam{:02d}.png")
    require_recognised(copied)
    with told("cam00_mask.mp4, .* is not read"):
        read(copied)


def test_images_extracted_beside_loose_videos_are_no_cameras(copied):
    save(copied / "frames" / "0.png", rgb(0)[0])
    for camera in range(CAMERAS):
        (copied / f"cam{camera:02d}.mp4").rename(copied / f"GX{camera}.mp4")
    assert not MultiCameraSettings.recognises(copied)


@pytest.mark.parametrize("names", ["Camera Camera.001 Camera.002", "cam cam2", "cam_left cam_top2"])
def test_some_cameras_have_no_number(tmp_path, names):
    for name in names.split():
        (tmp_path / f"{name}.mp4").write_bytes(b"")
    for name in ("camera_paths", "cam_calib"):
        save(tmp_path / name / "0.png", rgb(0)[0])
    found = recordings_of_cameras(tmp_path)
    assert sorted(path.stem for path in found) == sorted(names.split())


def test_cameras_may_have_an_image_of_another_kind(images):
    for camera in range(CAMERAS):
        save(images / f"cam{camera:02d}" / "calibration.png", rgb(camera)[0])
    with_transforms(images, "cam{:02d}/calibration.png")
    assert MultiCameraSettings.recognises(images)


@pytest.mark.parametrize(
    "other",
    [
        "{}_mask.png",
        "{}.masked.png",
        "depth_{:05d}.png",
        "segmentation_{}.png",
        "{}.jpg",
        "background.png",
    ],
)
def test_images_of_other_kinds_beside_frames_are_left_out(images, other):
    for camera in range(CAMERAS):
        for number in range(5, 5 + FRAMES):
            save(images / f"cam{camera:02d}" / other.format(number), rgb(camera)[0] // 2)
    mask = r"cam00/10[_.]mask(ed)?.png, .* is not read.*alpha channel of the cameras' images"
    with told(mask if "mask" in other else "no frames beside 5."):
        found = read(images)
    require_rays_of(found.splits["test"], list(range(FRAMES)))
    if not other.endswith("jpg"):  # Of two formats, either may stay.
        require_all(found)


def test_captures_tell_of_videos_that_are_not_read(copied):
    for camera in range(CAMERAS):
        save(copied / "images" / f"GX{camera:02d}.png", rgb(camera)[0])
        (copied / f"cam{camera:02d}.mp4").rename(copied / f"GX{camera:02d}.mp4")
    with_transforms(copied, "images/GX{:02d}.png")
    assert not MultiCameraSettings.recognises(copied)
    read_images = partial(settings(NerfstudioSettings, "nerfstudio", copied).load, ["train"])
    with told("GX00.mp4, GX01.mp4, .* 4 videos .* Each image has the name of one: .*multicamera"):
        read_images()
    require_rays_of(read(copied, test_cameras=["GX00"]).splits["test"], list(range(FRAMES)))
    (copied / "GX03.mp4").rename(copied / "other.mp4")
    with told("videos are not read.*If they are of several fixed cameras: .*data=multicamera"):
        read_images()


def test_a_camera_that_stopped_early_is_left_out(images):
    for path in sorted((images / "cam02").iterdir())[2:]:
        path.unlink()
    with told(r"cam02 \(2\) have fewer than 50% of the 6 frames of other cameras, and are left"):
        scene = read(images)
    assert len(scene.splits["train"]) == (CAMERAS - 2) * FRAMES
    with told("not all cameras have an image of the numbers of cam00"):
        assert len(read(images, test_cameras=["cam02"]).splits["test"]) == 2


@pytest.mark.parametrize("image", ["images/cam{:02d}.png", "cam{:02d}/0001.png"])
def test_frames_that_name_an_image_of_a_camera_mean_its_video(copied, image):
    (copied / "masks").mkdir()
    for camera in range(CAMERAS):
        save(copied / image.format(camera), rgb(camera)[0])
        (copied / "masks" / f"cam{camera:02d}.mp4").write_bytes(b"none")
    with_transforms(copied, image)
    require_rays_of(read(copied, test_cameras=["cam00"]).splits["test"], list(range(FRAMES)))


def test_frames_have_the_number_that_varies(images):
    for camera in range(CAMERAS):
        for path in sorted((images / f"cam{camera:02d}").iterdir()):
            path.rename(path.with_name(f"birthday_{path.stem}_{camera:02d}.png"))
    for camera, gone in ((1, 6), (2, 7)):
        (images / f"cam{camera:02d}" / f"birthday_{gone}_{camera:02d}.png").unlink()
    with told("cam01/birthday_7_01.png, cam02/birthday_6_02.png"):
        found = read(images)
    assert len(found.splits["test"]) == FRAMES - 2


def stamp(images: Path, name: Callable[[int, int], str]) -> None:
    """Rename each camera's frames by its number and theirs."""
    for camera in range(CAMERAS):
        found = sorted((images / f"cam{camera:02d}").iterdir(), key=lambda path: int(path.stem))
        for number, path in enumerate(found):
            path.rename(path.with_name(f"{name(camera, number)}.png"))


def late(apart: int, number: int) -> str:
    """The milliseconds of a frame, some later than those of others."""
    return str(1700000000000 + 40 * number + apart)


STAMPS = {
    "milliseconds": (late, "3", "40"),
    "nanoseconds": (
        lambda camera, number: f"rgb_{1700000000000000000 + 40000000 * number + 1000003 * camera}",
        *(r"3e\+06", r"4e\+07"),
    ),
    "seconds": (
        lambda camera, number: f"{1699999999.9 + number / 30 + camera / 500:.6f}",
        *("0.006", "0.0333"),
    ),
    "dates": (
        lambda camera, number: f"PXL_20260102_1159{58900 + 40 * number + camera:05d}",
        *("0.003", "0.04"),
    ),
    "both ways": (lambda camera, number: late((0, 5, -5, 0)[camera], number), "10", "40"),
}


@pytest.mark.parametrize("gone", [False, True])
@pytest.mark.parametrize("kind", STAMPS)
def test_images_of_nearly_equal_times_are_simultaneous(images, kind, gone):
    name, apart, step = STAMPS[kind]
    stamp(images, name)
    words = rf"scene: images of the nearest .* by up to {apart}, .* of one camera by {step}\."
    if gone:
        (images / f"cam02/{name(2, 3)}.png").unlink()
        words += rf"|cam00/{name(0, 3)}.* \(cam02: 5; cam00, cam01, cam03: 6\). 3 images are left"
    with told(words):
        found = read(images)
    if not gone:
        require_all(found)
    times = [number / 5 for number in range(FRAMES) if not gone or number != 3]
    for views in found.splits.values():
        assert sorted({*views.times.tolist()}) == pytest.approx(times, abs=1e-3)


@pytest.mark.parametrize(
    "name",
    [
        lambda camera, number: f"take_1.{998 + number}",
        lambda camera, number: f"{camera}.{98 + number}",
        lambda camera, number: f"{1 if camera == 1 else camera + 7}.{1 + number:04d}",
        lambda camera, number: f"{1700000000 + number / 30 + camera * 1e-6:.6f}",
        # A burst in one camera.
        lambda camera, number: f"I_20260102_1159{50 + number}{'_1' * (camera == number == 2)}",
    ],
)
def test_numbers_of_takes_and_cameras_are_no_seconds(images, name):
    stamp(images, name)
    with told(None):
        require_all(read(images))


@pytest.mark.parametrize(
    ("name", "first"),
    [
        (lambda camera, number: f"{10 * number + camera % 3:05d}", "00000"),  # Not of a clock.
        *((lambda camera, number, by=by: late(by * camera, number), late(0, 0)) for by in (14, 20)),
        # 22 is more than 0.3 of 40.
        (lambda camera, number: late((0, 11, -11, 0)[camera], number), late(0, 0)),
    ],
)
def test_cameras_without_simultaneous_frames_are_refused(images, name, first):
    stamp(images, name)
    words = rf"no number .* all cameras \(cam00/{first}.png.* differ by less than 0\.3 of the"
    refuse(images, f"{words}.*that none are simultaneous")


def test_folders_of_single_views_are_no_cameras(tmp_path):
    for view, what in ((view, what) for view in range(CAMERAS) for what in ("rgb", "depth_0")):
        save(tmp_path / f"{view:04d}" / f"{what}.png", rgb(view)[0])
    for name in ("{:04d}/rgb.png", "{:04d}/depth_0"):
        with_transforms(tmp_path, name)
        assert NerfstudioSettings.recognises(tmp_path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("cam{:02d}.jpg", False),
        ("cam{:02d}/0005.png", False),
        ("first frames/cam{:02d}.png", True),
        ("cam{:02d}_0005.png", False),
        ("0005_cam{:02d}.png", False),
        (lambda camera: f"{'left' if camera < 2 else 'right'}/cam{camera:02d}.png", False),
    ],
)
def test_colmap_may_have_registered_an_image_of_each_camera(images, name, text):
    expected = read(images)
    with_colmap(images, name, text=text)
    require_recognised(images)
    found = read(images)
    require_all(found)
    assert found.splits["train"].files == expected.splits["train"].files
    assert found.video.files == expected.video.files


def move(folder: Path, outer: str, name: str = "cam{:02d}") -> None:
    """Move the cameras of a folder, and rename them."""
    (folder / outer).mkdir(exist_ok=True)
    for camera in range(CAMERAS):
        (folder / f"cam{camera:02d}").rename(folder / outer / name.format(camera))


def test_cameras_that_colmap_registered_may_lie_in_one_folder(images):
    for camera in range(CAMERAS):
        save(images / "images" / f"cam{camera:02d}" / "1.png", rgb(camera)[0])
    with_colmap(images, "cam{:02d}.png")
    move(images, "videos")
    require_recognised(images)
    require_all(read(images))
    # Several images of each camera: cameras that move, with their masks.
    names = [f"cam{camera:02d}/{number}.png" for camera in range(CAMERAS) for number in range(2)]
    lens = {1: ("PINHOLE", SIZE, SIZE, (FOCAL, FOCAL, SIZE / 2, SIZE / 2))}
    write_colmap(images / "sparse" / "0", lens, [(name, POSES[0], 1, 3) for name in names])
    assert ColmapSettings.recognises(images)
    assert not MultiCameraSettings.recognises(images)
    refuse(images, r"several images of each camera, such as cam00/0\.png.* with data=colmap")


def test_images_of_cameras_as_4dgaussians_counts_them(images):
    with_colmap(images, lambda camera: f"image{camera + 1}.jpg")
    (images / "sparse/0").rename(images / "sparse_")
    require_recognised(images)
    with told(r"image1, image2, \.\.\. are taken for images of cam00, cam01, cam02, cam03, in"):
        require_all(read(images))


def test_rows_of_poses_have_the_plain_order_of_names(images):
    move(images, ".", "view_{}")
    (images / "view_2").rename(images / "view_10")
    with told("row 0 is view_0, row 1 is view_1, row 2 is view_10"):
        require_all(read(images, test_cameras=["view_0"]))


def test_images_and_cameras_that_do_not_belong_together(copied):
    def refuse_model(words: str, name: str | Callable[[int], str], **changes) -> None:
        with_colmap(copied, name, **changes)
        refuse(copied, words)

    plain = "cam{:02d}.png"
    both = r"images\.bin: {}.*Registered images: {}.*cam\*, in .*copied: cam00\.mp4, cam01\.mp4"
    (copied / "images").mkdir()
    with_colmap(copied, plain)
    assert len(read_cameras(copied)[0]) == CAMERAS
    left = r"left0\.png, left1\.png, left2\.png, left3\.png"
    refuse_model(both.format("left0.png may be of no video or folder", left), "left{}.png")
    refuse_model(
        both.format("cam00/1.png, cam00/2.png, .* belongs to cam00.mp4", "cam00/1.png"),
        lambda camera: f"cam00/{camera + 1}.png",
    )
    refuse_model("no registered image belongs to cam01.mp4, no", plain, cameras=1)
    with_colmap(copied, plain, cameras=3)  # COLMAP loses a camera now and then.
    with told(r"no registered image of cam03\.mp4: 1 of 4 cameras are left out"):
        assert len(read_cameras(copied)[0]) == CAMERAS - 1
    refuse_model(
        r"cam00\.mp4 has 48x48 pixels, but .* 96x48, of another aspect", plain, height=SIZE
    )
    (copied / "cam02.mov").write_bytes(b"")
    refuse_model(r"cam02\.png may be of cam02\.mov or of cam02\.mp4", plain)
    (copied / "cam02.mov").unlink()
    (copied / "0001").mkdir()
    refuse_model("cam00/0001.png may be of 0001 or of cam00", "cam{:02d}/0001.png")
    (copied / "sparse" / "0" / "images.bin").unlink()
    refuse(copied, r"holds neither images\.bin nor images\.txt")


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


def test_the_video_is_that_of_a_training_camera(videos, caplog):
    """By default the first camera is held out of training."""
    centres = VIEWS.camera_to_world[::FRAMES, :3, 3]
    away = (centres - centres.mean(dim=0)).norm(dim=1)
    central = 1 + int(away[1:].argmin())
    with caplog.at_level("INFO"):
        scene = read(videos, test_cameras=None)
    assert {file.split("/")[0] for file in scene.splits["test"].files} == {"cam00"}
    assert "held out cam00 of the cameras cam00, cam01" in caplog.text
    assert scene.video.files == tuple(f"cam{central:02d}/{i:06d}" for i in range(FRAMES))
    assert scene.video.times.tolist() == pytest.approx(torch.linspace(0, 1, FRAMES).tolist())
    assert read(videos, splits=("train",), video_camera="cam03").video.files[0][:5] == "cam03"
    for name in ("cam00", "cam9"):
        words = f"video_camera={name} is not a training camera.*must not see.*cam01, cam02"
        refuse(videos, words, video_camera=name)


def test_large_captures_are_kept_on_disk(videos, copied, tmp_path, monkeypatch, capsys):
    """And transforms.json may name videos."""
    with_transforms(copied, "cam{:02d}.mp4")
    expected, before = read(copied), sorted(videos.iterdir())
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
    place = [f"data.root={videos.parent}", f"data.scene={videos.name}", "data.resolution=null"]
    plain = changed((), "data=multicamera", *place, "data.frames=[0,2,1]")
    settings = build(plain["data"], SceneSettings, "data")
    scene = settings.read()
    assert set(scene.splits) == {"train", "test"}
    assert len(scene.video) == 3
    assert not scene.static_reason
    all_of_them = [f"cam0{camera}" for camera in range(CAMERAS)]
    for error, words, changes in (
        (SceneError, r"train_on_video=true.*already", {"train_on_video": True}),
        *((ConfigError, "frames=", {"frames": f}) for f in ([0, 1], [3, 2, 1], [-1, 2, 1])),
        (ConfigError, "frames=", {"frames": [0, 2, 0]}),
        (ConfigError, r"centre=\[1.0, 2.0\]: must be three", {"centre": [1, 2]}),
        (SceneError, r"no camera cam7\. Its cameras are cam00, cam01", {"test_cameras": ["cam7"]}),
        (SceneError, r"leaves no camera", {"test_cameras": all_of_them}),
    ):
        refused(lambda c=changes: replace(settings, **c).read(), words, case=changes, error=error)
    for words, options in (
        (r"no split val: its splits are train, test", {"splits": ("val",)}),
        (r"has no split test", {"test_cameras": []}),
    ):
        refuse(videos, words, error=MissingSplitError, **options)


def test_cameras_of_different_lengths_and_rates(copied):
    write_video(copied / "cam02.mp4", rgb(2)[:4])
    with told(r"different .* \(cam02: 4; cam00, cam01, cam03: 6\). The first 4 .*trim"):
        train = read(copied).splits["train"]
    assert len(train) == 3 * 4
    assert train.times[:4].tolist() == pytest.approx([0, 1 / 3, 2 / 3, 1])
    words = r"cam02\.mp4 has 4 frames.*data\.frames=\[0,3,1\]"
    refuse(copied, words, frames=[0, 5, 1])
    write_video(copied / "cam02.mp4", rgb(2), rate=25)
    train = read(copied).splits["train"]
    assert [file[:5] for file in train.files[::FRAMES]] == ["cam01", "cam02", "cam03"]
    for times, rate in zip(train.times.view(3, FRAMES).tolist(), (30, 25, 30), strict=True):
        shares = [number * 25 / rate / (FRAMES - 1) for number in range(FRAMES)]
        assert times == pytest.approx(shares, abs=0.01)


@pytest.mark.parametrize("apart", [0, 100])
@pytest.mark.parametrize("gone", [[FRAMES - 1], [2], [0], [1, FRAMES - 1]], ids=str)
def test_a_frame_that_one_camera_lacks_is_left_out(images, apart, gone):
    for camera in range(CAMERAS):  # Cameras may have their own numbers for the same timestep.
        for path in sorted((images / f"cam{camera:02d}").iterdir(), key=lambda p: int(p.stem)):
            path.rename(path.with_name(f"x{int(path.stem) + apart * camera}.png"))
    for number in gone:
        (images / "cam02" / f"x{5 + number + 2 * apart}.png").unlink()
    with told(f"not all cameras have an image .* {3 * len(gone)} images are left out"):
        views = read(images).splits["train"]
    if apart and 0 in gone:
        return  # Nobody can tell whether the first or the last one is missing.
    kept = [number for number in range(FRAMES) if number not in gone]
    times = [(number - kept[0]) / (kept[-1] - kept[0]) for number in kept]
    assert views.times.tolist() == pytest.approx(times * (CAMERAS - 1))
    places = [camera * FRAMES + number for camera in range(1, CAMERAS) for number in kept]
    assert torch.equal(views.in_memory(), VIEWS.in_memory()[places])


def test_frames_that_all_cameras_lack_are_a_gap_in_time(images):
    for camera in range(CAMERAS):
        (images / f"cam{camera:02d}/10.png").rename(images / f"cam{camera:02d}/50.png")
    scene = read(images)
    shares = [0, 1 / 45, 2 / 45, 3 / 45, 4 / 45, 1]
    assert scene.splits["train"].times[:FRAMES].tolist() == pytest.approx(shares)
    assert scene.splits["train"].files[FRAMES - 1] == "cam01/000005"
    assert scene.notes["times"] == "the numbers in their names, from 5 to 50"
    few = read(images, frames=[3, 5, 2])
    assert few.splits["train"].times[:2].tolist() == [0, 1]
    assert few.notes["times"] == "the numbers in their names, from 8 to 50"
    for camera in range(CAMERAS):  # Times of day are no numbers of frames, as minutes end.
        for path in (images / f"cam{camera:02d}").iterdir():
            second = int(path.stem) - 5 + 58
            clock = f"11{second // 60:02d}{second % 60:02d}"
            path.rename(path.with_name(f"IMG_20260102_{clock}.png"))
    times = read(images).splits["train"].times
    assert times[:FRAMES].tolist() == pytest.approx(shares)


def test_keys_of_transforms_mean_what_they_mean_to_nerfstudio(images):
    lying = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

    def lie(frames: list) -> None:
        for frame in frames:
            frame["transform_matrix"] = (lying @ frame["transform_matrix"]).tolist()

    def up(change=lie, **keys) -> str:
        with_transforms(images, "cam{:02d}", change, **keys)
        return read(images).notes["up"]

    assert "the world is turned" in up()
    assert "the z axis of the files" in up(orientation_override="none")
    assert up(up=[0, 2, 0]) == "(0, 1, 0) of the files, by their key up"
    with told(r"keys that are not read are 'colour', 'mask_path', 'white_transparent'\."):
        up(
            lambda frames: frames[0].update(mask_path="mask.png"),
            **{"white_transparent": True, "colour": "sRGB", "orientation_override": "none"},
        )


@pytest.mark.parametrize("key", ["time", "timestamp", "timestep_index"])
def test_times_of_transforms_are_told_of(images, key):
    def add(frames: list) -> None:
        second = [frame["file_path"].replace("5.png", "6.png") for frame in frames]
        pairs = zip(frames[:], second, strict=True)
        frames += [frame | {"file_path": name, key: 3} for frame, name in pairs]

    with_transforms(images, "cam{:02d}/5.png", add)
    with told(f"not read are '{key}'.*data=nerfstudio reads times"):
        require_all(read(images))


def test_images_that_are_missing_beside_videos(images):
    write_video(images / "cam03.mp4", rgb(3))
    shutil.rmtree(images / "cam03")
    (images / "cam02" / "7.png").unlink()
    refuse(images, r"numbers of cam00/7\.png, cam01/7\.png \(cam02: 5; .*: 6\)\. Add what is")
    for camera in range(CAMERAS - 2):
        (images / f"cam{camera:02d}" / "7.png").unlink()
    with told(r"cam0\d: numbers are missing between 6.png and 8.png.*Add|different .*cam03: 6\)"):
        assert len(read(images).splits["test"]) == 5


def test_damaged_and_missing_videos_are_named(copied):
    path = copied / "cam01.mp4"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    refuse(copied, r"cam01\.mp4.*(truncated|damaged)")
    path.write_bytes(b"no video")
    refuse(copied, r"cam01\.mp4 cannot be decoded as a video")
    path.unlink()
    refuse(copied, r"has 4 cameras, but .* holds 3 .*: cam00\.mp4, cam02\.mp4")


def test_rows_of_poses_that_cannot_be(images):
    path = images / "poses_bounds.npy"
    poses = np.load(path)
    for column, value, words in (
        (4, 0.0, "row 2 .*height is 0"),
        (14, np.nan, "focal length is nan"),
        (0, 3.0, "row 2 .*orthonormal"),
    ):
        spoilt = poses.copy()
        spoilt[2, column] = value
        np.save(path, spoilt)
        refuse(images, words)
    np.save(path, poses[:, :16])
    refuse(images, r"not one row of 17 numbers")
    np.save(path, np.array([{}]), allow_pickle=True)
    refuse(images, r"poses_bounds\.npy cannot be read")
    with zipfile.ZipFile(path, "w"):
        refuse(images, r"poses_bounds\.npy cannot be read")
    with path.open("wb") as file:
        header = {"descr": "<f8", "fortran_order": False, "shape": (10**12, 17)}
        np.lib.format.write_array_header_1_0(file, header)
    refuse(images, r"poses_bounds\.npy cannot be read")


@pytest.mark.parametrize("calibration", ["rows", "pose", "gone", "empty"])
def test_broken_cameras_are_left_out(images, calibration):
    path = images / "poses_bounds.npy"
    if calibration == "rows":
        rows = np.load(path)
        rows[2, 3] = np.inf
        np.save(path, rows)
    elif calibration == "pose":
        with_transforms(images, "cam{:02d}", lambda frames: frames[2].update(transform_matrix=None))
    else:
        with_transforms(images, "cam{:02d}")
        shutil.rmtree(images / "cam02")
        if calibration == "empty":
            (images / "cam02").mkdir()
    require_recognised(images)
    with told(r"1 of 4 (rows|frames|cameras) are left out:\n.*cam02"):
        found = read(images)
    require_rays_of(
        found.splits["train"], [*range(FRAMES, 2 * FRAMES), *range(3 * FRAMES, 4 * FRAMES)]
    )


@pytest.mark.parametrize("name", ["cam{:02d}", "cam{:02d}.mkv", "videos/cam{:02d}.mp4"])
def test_videos_of_transforms_may_have_other_endings_and_places(copied, name):
    for camera in range(CAMERAS):
        path = copied / f"cam{camera:02d}.mp4"
        path.rename(path.with_suffix(".MP4"))
    with_transforms(copied, name)
    require_recognised(copied)
    require_rays_of(read(copied).splits["test"], list(range(FRAMES)))


@pytest.mark.parametrize("name", ["cam{}.png", "{:02d}.png"])
def test_folders_that_may_be_timesteps_are_told_of(tmp_path, name):
    for number, camera in itertools.product(range(CAMERAS), repeat=2):
        save(tmp_path / f"{number:04d}" / name.format(camera), rgb(camera)[number])
    write_rows(tmp_path, POSES, SIZE, SIZE, FOCAL)
    with told("folders 0000, 0001, 0002, 0003 are taken for cameras, but may be timesteps"):
        read(tmp_path, ["train"], test_cameras=[])


def test_places_of_recordings_that_cannot_be(copied):
    (copied / "poses_bounds.npy").unlink()
    refuse(copied, r"neither poses_bounds\.npy .* nor transforms\.json .*cam00\.mp4")
    for name, words in (
        ("cam05.ogg", "is not a video"),
        ("../other", "leaves the scene's folder"),
        ("/cam05.mp4", "is not a video"),
        ("", "must be text"),
        (".", "is the scene's folder"),
        ("cam01.mp4", r"another pose than .* data=nerfstudio"),
    ):
        with_transforms(copied, name)
        refuse(copied, words)


def test_cameras_of_images_need_no_pyav(images, monkeypatch, videos):
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    assert len(read_cameras(images)[0]) == CAMERAS
    require_all(read(images))
    refuse(videos, r'pip install "xplanes\[video\]"', error=MissingExtraError)


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


@pytest.mark.parametrize(
    ("stamps", "words", "first", "times"),
    [
        (lambda _: [0, 33, 67, 233, 267, 300], None, 0, [0, 0.11, 0.223, 0.777, 0.89, 1]),
        (
            lambda camera: [400 * (camera == 2) + 33 * n for n in range(6)],
            r"cam02\.mkv begins 0\.4 s after .*trim the videos",
            *(0, [0, 0.2, 0.4, 0.6, 0.8, 1]),
        ),
        (
            lambda camera: [
                400 * (camera == 2) + (40 if camera else 33) * n for n in range(FRAMES)
            ],
            r"cam02\.mkv begins 0\.4 s after .*these times are used.*trim the videos",
            *(FRAMES, [2 / 3]),
        ),
    ],
    ids=["variable", "one later", "different"],
)
def test_times_of_frames_are_those_of_the_files(tmp_path, stamps, words, first, times):
    """A camera that begins later, and one of another rate, are told of."""

    def write(path: Path, frames: np.ndarray) -> None:
        write_stamped(path, frames, stamps(int(path.stem[-1])))

    folder = neural_3d_video(tmp_path / "scene", write, ".mkv")
    with told(words):
        found = read(folder).splits["train"].times[first:]
    assert found[: len(times)].tolist() == pytest.approx(
        times, abs=0.01 if first or not words else 1e-6
    )


@pytest.mark.parametrize("fast", range(2))
@pytest.mark.parametrize(("count", "counts"), [(400, False), (600, True)])
def test_rates_differ_if_the_cameras_drift_apart(fast, count, counts):
    rates = [29.97, 29.97]
    rates[fast] = 30.0
    camera = Camera("cam00", Path("cam00.mp4"), np.eye(4), Calibration(per_width=1.0), "")
    each = [Recording(camera, (2, 2), count, r, tuple(n / r for n in range(count))) for r in rates]
    assert _are_stamped(each) is counts
    if counts:
        words = "has 30 frames per second, but .* 29.97, and not all"
        refused(lambda: _are_stamped([each[0], replace(each[1], times=())]), words)


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
