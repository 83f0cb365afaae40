"""Times from the names of images, as cameras, telephones and programs write them."""

import warnings

import pytest

from xplanes.readers.entries import unit_times
from xplanes.readers.name_times import times_in_names


@pytest.mark.parametrize(
    ("names", "times"),
    [
        ("f_9 f_10 f_13", [0, 0.25, 1]),
        ("1305031102.175304 1305031102.975304 1305031103.175304", [0, 0.8, 1]),
        ("rgb_12.5 rgb_13.0 rgb_14.5", [0, 0.25, 1]),
        ("f_0.5s f_1.0s f_2.5s", [0, 0.25, 1]),
        ("1305031102_900000000 1305031103_100000000", [0, 1]),
        ("IMG_20260102_115958 IMG_20260102_115959 IMG_20260102_120002", [0, 0.25, 1]),
        ("PXL_20260102_115959500 PXL_20260102_120000000 PXL_20260102_120001500", [0, 0.25, 1]),
        ("2026-01-31.23.59.59 2026-02-01.00.00.00 2026-02-01.00.00.03", [0, 0.25, 1]),
        ("2026-01-02_9.59.58.AM 2026-01-02_12.00.00PM 2026-01-02_2.00.02_pm", [0, 0.5, 1]),
        ("2026-01-02_at_12.00.00_AM 2026-01-02_at_12.00.01_AM", [0, 1]),
        (
            "DJI_20260102115959_0001_V DJI_20260102120000_0002_V DJI_20260102120003_0003_V",
            [0, 0.25, 1],
        ),
        ("vlcsnap-2026-01-02-12h00m01s000 vlcsnap-2026-01-02-12h00m01s400", [0, 1]),
        ("1700000000_123 1700000000_373 1700000001_123", [0, 0.25, 1]),
        ("034_device1 036_device2 042_kinect1", [0, 0.25, 1]),
        ("034_cam0 036_cam1 042_cam0", [0, 0.25, 1]),
        ("3_cam0 3_cam1 3_cam2 4_cam0 4_cam1 4_cam2 7_cam1", [0, 0, 0, 0.25, 0.25, 0.25, 1]),
        ("0034_0 0036_1 0042_0", [0, 0.25, 1]),
        ("034_view2_rgb8 036_view1_rgb8 042_view9_rgb8", [0, 0.25, 1]),
        ("c2_010 c1_011 c1_014", [0, 0.25, 1]),
        ("cam1/007 cam1/008 cam2/007 cam2/011", [0, 0.25, 0, 1]),
        ("t_001/cam1 t_002/cam1 t_005/cam2", [0, 0.25, 1]),
        ("rig1/camera1/i0001 rig1/camera2/i0002 rig1/camera1/i0005", [0, 0.25, 1]),
        ("034_cam0 036cam1 044-Camera_2", [0, 0.2, 1]),
        ("a_1_4k a_2_4k a_5_4k", [0, 0.25, 1]),
        ("clip_1_1080p clip_2_1080p clip_5_1080p", [0, 0.25, 1]),
        ("12345678_200001 12345678_200002 12345678_200005", [0, 0.25, 1]),
        ("C0001 C0002 C0005", [0, 0.25, 1]),
        ("left_001 left_002 left_005 right_001 right_002 right_005", [0, 0.25, 1] * 2),
        ("20260102_115959 20260102_115959(1) 20260102_115959(3)", [0, 0.5, 1]),
        ("f_000 f_001 f_001(7) f_004", [0, 0.25, 0.25, 1]),
        ("take2_0001 take2_0002 take_0003 take_0005", [0, 0.25, 0.5, 1]),
        ("VID_20260102_115959_001 VID_20260102_115959_002 VID_20260102_115959_003", [0, 0.5, 1]),
        ("clip(1) clip(2) clip(5)", [0, 0.25, 1]),
        (
            " ".join(
                f"cam{k}/V_20260102_11595{k}_{i:03d}" for k in (0, 1, 1) for i in (1, 2, 4, 5, 9)
            ),
            [0, 0.125, 0.375, 0.5, 1] * 3,
        ),
        ("20260102_140558 20260102_140558(0) 20260102_140558(1)", [0, 0.5, 1]),
        ("23040123/001 23040123/002 23040124/001 23040131/003", [0, 0.5, 0, 1]),
        ("00/000 00/001 00/004 01/000 01/001 02/000 03/000", [0, 0.25, 1, 0, 0.25, 0, 0]),
        ("IMG_20260102_115959_500 IMG_20260102_120000_000 IMG_20260102_120001_500", [0, 0.25, 1]),
        ("0000/cam0 0000/cam1 0001/cam0 0001/cam1 0004/cam0", [0, 0, 0.25, 0.25, 1]),
    ],
)
def test_names_tell_times(names, times):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = times_in_names([f"{name}.png" for name in names.split()])
    assert unit_times(found) == pytest.approx(times)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["00_58.png", "00_59.png", "01_00.png", "01_01.png", "01_02.png"], r"01_00\.png -> 0\)"),
        ([f"a_{i // 4}_{'abcdefgh'[i % 8]}.png" for i in range(16)], "only 4, for 16"),
        ([f"camera_{i:04d}.png" for i in range(4)], r"may be those of cameras(.|\n)*static=true"),
        ([f"{i:06d}/{j:02d}.png" for i in range(4) for j in range(2)], "taken for cameras"),
        ([f"{i:06d}/{j:02d}.png" for i in range(4) for j in range(9)], "taken for cameras"),
        ([f"frame{i:05d}/{j:02d}.png" for i in range(4) for j in range(2)], "taken for cameras"),
        ([f"{i:03d}/{j:02d}.png" for i in range(4) for j in range(3)], "taken for cameras"),
        (["t_-2.png", "t_1.png", "t_2.png"], "-2"),
        (["-1.50.png", "-0.50.png", "0.50.png"], r"\(0.50.png -> 0.5, -0.50.png -> -0.5\)"),
        ([f"view_{i:03d}.png" for i in range(120)], r"may be those of cameras .*view_001.png -> 1"),
        ([f"V{i}.png" for i in range(100)], "may be those of cameras"),
        ([f"V{i}.png" for i in range(101)], "may be those of cameras"),
        ([f"{i // 10:02d}_{i % 10:04d}.png" for i in range(200)], "are only 20, for 200"),
        ([f"{i // 20:04d}_{i % 20:02d}.png" for i in range(200)], "do not have the order"),
        ([f"s{i // 10:02d}_f{i % 10:04d}.png" for i in range(200)], "are only 20, for 200"),
        ([f"pos{i // 3}_shot{i % 3}.png" for i in range(36)], "are only 12, for 36"),
        ([f"IMG_{i // 3:04d}_{i % 3}.png" for i in range(36)], "are only 12, for 36"),
        ([f"az{i // 3:03d}_el{i % 3:02d}.png" for i in range(36)], "are only 12, for 36"),
        ([f"{kind}_{i:03d}.png" for kind in ("walk", "run") for i in range(9)], "not have the ord"),
    ],
)
def test_times_that_are_hardly_those_of_the_images_are_shown(names, words):
    with pytest.warns(UserWarning, match=words):
        assert len(times_in_names(names)) == len(names)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ("left right", "have no number, such as left"),
        ("3f2a9c b07d1e 9e4410 c5a8f2 77e0b3 0d1f6a", "differ in more than their numbers"),
        ("a_1 b_1", "all 2 images, such as a_1.png, give one number"),
        ("cam1 cam2 cam5", "numbers in the names .* such as cam1.png, are those of cameras"),
        ("view_000 view_001 view_002", "are those of cameras"),
        ("34_Camera01 34_Camera02 34_Camera03", "are those of cameras"),
        ("c01 c02 c03", "are those of cameras"),
    ],
)
def test_names_without_an_order_are_one_timestep(names, words):
    with pytest.warns(UserWarning, match=f"{words}(.|\n)*one timestep.*data.static=true"):
        assert times_in_names([f"{name}.png" for name in names.split()]) == []


@pytest.mark.parametrize("name", ["cam_{:03d}", "Camera_{}", "lens{:02d}", "v{:02d}", "c{}"])
def test_numbers_of_cameras_are_times_if_the_scene_changes(name):
    with pytest.warns(UserWarning, match="may be those of cameras"):
        assert times_in_names([f"{name.format(i)}.png" for i in range(9)], True) == [*range(9)]
