"""Rigs with calibrations of EasyMocap, of Google's immersive videos, and of CMU Panoptic."""

import json
import re
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.captures import HEIGHT, WIDTH, picture, poses, save, settings
from tests.readers.test_colmap import OPENCV
from tests.scenes.common import refused, told
from xplanes.readers.multicamera import MultiCameraSettings
from xplanes.scenes.lenses import COEFFICIENTS

POSES = poses(4)
K = np.array([[OPENCV[0], 0, OPENCV[2]], [0, OPENCV[1], OPENCV[3]], [0, 0, 1]])
HALF = [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
DISTORTION = dict(zip(("k1", "k2", "p1", "p2"), OPENCV[4:], strict=True))
FISHEYE = {"k1": 0.02, "k2": -0.01}
VECTORS = {"EasyMocap's vectors", "immersive"}


def motion(pose, by_vector):
    """Rotation, as a matrix or a vector, and translation from the world to OpenCV's camera."""
    rotation = (pose[:3, :3] * [1, -1, -1]).T
    shift = -rotation @ pose[:3, 3]
    if not by_vector:
        return rotation, shift[:, None]
    # A rotation is 1 along its axis, where it also tells left from right.
    axis = np.linalg.svd(rotation - np.eye(3))[2][2]
    twist = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    sine, cosine = -0.5 * np.trace(twist @ rotation), 0.5 * (np.trace(rotation) - 1)
    return np.arctan2(sine, cosine) * axis[:, None], shift[:, None]


def matrix(name, values):
    rows, columns = np.shape(values)
    data = ", ".join(map(repr, np.ravel(values).astype(float).tolist()))
    head = f"{name}: !!opencv-matrix\r\n  rows: {rows}\r\n  cols: {columns}\r\n  dt: d\r\n"
    return f"{head}  data: [{data}]\r\n"


def write(folder, kind, names):
    """The calibration of cameras, as its program writes it."""
    by_vector = kind in VECTORS
    each = [(name, *motion(pose, by_vector)) for name, pose in zip(names, POSES, strict=True)]
    folder.mkdir(parents=True, exist_ok=True)
    if "EasyMocap" in kind:
        place = folder if by_vector else folder / "calib"
        place.mkdir(exist_ok=True)
        head = "%YAML:1.0\r\n---\r\nnames:\r\n" + "".join(f'  - "{name}"\r\n' for name in names)
        lens = [[*DISTORTION.values(), 0.0]]
        own = [matrix(f"K_{n}", K - HALF) + matrix(f"dist_{n}", lens) for n in names]
        own += [f"H_{n}: {HEIGHT}\r\nW_{n}: {WIDTH}\r\n" for n in names]
        key = "R" if by_vector else "Rot"
        places = [matrix(f"{key}_{n}", r) + matrix(f"T_{n}", t) for n, r, t in each]
        for name, parts in (("intri", own), ("extri", places)):
            (place / f"{name}.yml").write_text(head + "".join(parts), newline="")
    elif kind == "immersive":
        cameras = [
            {
                **{"name": name, "orientation": turn.ravel().tolist()},
                **{"position": pose[:3, 3].tolist(), "projection_type": "fisheye"},
                **{"focal_length": OPENCV[0], "principal_point": OPENCV[2:4]},
                **{"radial_distortion": [*FISHEYE.values()], "width": WIDTH, "height": HEIGHT},
            }
            for (name, turn, _), pose in zip(each, POSES, strict=True)
        ]
        (folder / "models.json").write_text(json.dumps(cameras))
    else:
        cameras = [
            {
                **{"name": name, "resolution": [WIDTH, HEIGHT], "K": K.tolist(), "type": "hd"},
                **{"distCoef": [*DISTORTION.values(), 0.0], "R": r.tolist(), "t": t.tolist()},
            }
            for name, r, t in each
        ]
        (folder / "calibration_dance.json").write_text(json.dumps({"cameras": cameras}))


KINDS = {
    "EasyMocap's vectors": ("{:02d}", "images/{}/{:06d}.jpg"),
    "EasyMocap's matrices": ("{}", "images/{}/{:06d}.jpg"),
    "immersive": ("camera_{:04d}", "{}/{:06d}.png"),
    "Panoptic": ("00_{:02d}", "hdImgs/{0}/{0}_{1:08d}.png"),
}


def build(folder, kind):
    """A rig of four cameras with three frames each. Returns the cameras' names."""
    name, file = KINDS[kind]
    names = [name.format(camera) for camera in range(4)]
    write(folder, kind, names)
    for camera in names:
        for number in range(3):
            save(folder / file.format(camera, number), picture(number))
    return names


def edit(folder, old, new, count=0):
    """Replace a pattern in the files of a calibration."""
    for path in [*folder.rglob("*.yml"), *folder.glob("*.json")]:
        path.write_text(re.sub(old, new, path.read_text(), count=count))


def read(folder, **changes):
    options = {"test_cameras": [], "orient": False, **changes}
    return settings(MultiCameraSettings, "multicamera", folder, **options).load(["train"])


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_of_other_programs_are_where_they_say(tmp_path, kind):
    names = build(tmp_path, kind)
    assert MultiCameraSettings.recognises(tmp_path)
    with told(None):
        views = read(tmp_path).splits["train"]
    assert [file.split("/")[0] for file in views.files[::3]] == names
    expected = torch.from_numpy(POSES).float()
    torch.testing.assert_close(views.camera_to_world[::3], expected, atol=1e-5, rtol=0)
    focal = OPENCV[:1] * 2 if kind == "immersive" else OPENCV[:2]
    assert views.intrinsics.focal[0].tolist() == pytest.approx(focal)
    assert views.intrinsics.centre[0].tolist() == pytest.approx(OPENCV[2:4])
    lens = zip(COEFFICIENTS, views.intrinsics.lenses.coefficients[0].tolist(), strict=True)
    known = FISHEYE if kind == "immersive" else DISTORTION
    assert {key: value for key, value in lens if value} == pytest.approx(known)


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_without_frames_are_told_of(tmp_path, kind):
    names = build(tmp_path, kind)
    (place,) = (
        path for path in (tmp_path / names[2], *tmp_path.glob(f"*/{names[2]}")) if path.is_dir()
    )
    place.rename(place.with_name("other"))
    with told(f"4 cameras have no video or folder .* left out: {names[2]}|no camera of other"):
        assert len(read(tmp_path).splits["train"]) == 9


def test_files_of_other_names_or_contents_are_no_calibrations(tmp_path):
    build(tmp_path, "immersive")
    (tmp_path / "models.json").write_text('["a/000000.png", {"camera_0001": 1}]')
    assert not MultiCameraSettings.recognises(tmp_path)
    refused(partial(read, tmp_path), "models.json cannot be read as the calibration of cameras")


@pytest.mark.parametrize(
    ("kind", "old", "new", "words"),
    [
        ("EasyMocap's vectors", "\nT_", "\nX_", r"extri.yml cannot be read .*'T', '00'"),
        ("EasyMocap's vectors", "rows: 3", "rows: 4", r"extri.yml cannot be read .*reshape"),
        ("immersive", "fisheye", "equirect", "projection_type is equirect.*write a transforms"),
        ("immersive", '"position"', '"place"', r"models.json cannot be read .*'position'.*Export"),
        ("Panoptic", '"R"', '"rot"', r"dance.json cannot be read .*'R'.*transforms.json"),
        ("Panoptic", '"00_', '"01_', "none of its cameras has a video or a folder .*01_00"),
        ("Panoptic", '{"cam', '["cam', "dance.json cannot be read as the calibration"),
        ("Panoptic", '"name": "00_00"', '"name": ["a"]', "dance.json cannot .*name is .'a'"),
        ("EasyMocap's vectors", "dist_02", "rdist_02", "02: rdist, a fisheye lens of EasyVolcap"),
        ("immersive", "-0.01]", "-0.01, 0.3]", r"camera_0000: .* after k2 are .*\[0.3\]. Undist"),
        ("Panoptic", "0.0], ", "0.0, 0, 0, 0, 0.5], ", r"00_00: .* after k6 .*\[0.5\]"),
        ("Panoptic", f'"K": [[{OPENCV[0]}, 0.0', f'"K": [[{OPENCV[0]}, 2.0', r"skew .*are \[2.0\]"),
    ],
)
def test_damaged_calibrations_are_refused_by_name(tmp_path, kind, old, new, words):
    build(tmp_path, kind)
    edit(tmp_path, re.escape(old), new)
    refused(partial(read, tmp_path), words)


@pytest.mark.parametrize(
    ("keys", "down"), [({"pixel_aspect_ratio": 1.25}, 1.25), ({"skew": 0.5}, None)], ids=str
)
def test_pixels_of_immersive_videos(tmp_path, keys, down):
    build(tmp_path, "immersive")
    path = tmp_path / "models.json"
    path.write_text(json.dumps([camera | keys for camera in json.loads(path.read_text())]))
    if down is None:
        refused(partial(read, tmp_path), r"skew .* are \[0.5\]")
        return
    focal = read(tmp_path).splits["train"].intrinsics.focal[0].tolist()
    assert focal == pytest.approx([OPENCV[0], down * OPENCV[0]])


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_whose_pose_is_not_finite_are_left_out(tmp_path, kind):
    names = build(tmp_path, kind)
    nan = ".Nan" if "EasyMocap" in kind else "NaN"  # As OpenCV writes it.
    first = r'("position": \[|"t": \[\[|T_0?0: (?s:.*?)data: \[)[^,\]]+'
    edit(tmp_path, first, rf"\g<1>{nan}", count=1)
    with told(f"1 of 4 cameras are left out:\n.*: {names[0]}: the pose|no camera of {names[0]}"):
        assert len(read(tmp_path).splits["train"]) == 9


@pytest.mark.parametrize("lost", ["K_02", "R_02", "T_02"])
def test_cameras_of_easymocap_that_saw_no_board_are_left_out(tmp_path, lost):
    build(tmp_path, "EasyMocap's vectors")
    edit(tmp_path, f"{lost}:", f"X{lost}:")
    with told("02 lack K, R or T, and are left out|no camera of 02"):
        assert len(read(tmp_path).splits["train"]) == 9


@pytest.mark.parametrize("name", ["Camera ({})", "cam-{}", "{}_K_1"])
def test_cameras_of_easymocap_have_any_names(tmp_path, name):
    names = [name.format(camera) for camera in range(4)]
    write(tmp_path, "EasyMocap's vectors", names)
    path = tmp_path / "intri.yml"  # As OpenCV writes numbers.
    path.write_text(path.read_text().replace(f": {HEIGHT}\n", f": {HEIGHT:e}\n"))
    for camera in names:
        save(tmp_path / "images" / camera / "0.png", picture(0)[::2, ::2])
    assert MultiCameraSettings.recognises(tmp_path)
    views = read(tmp_path).splits["train"]
    assert views.intrinsics.centre[0].tolist() == pytest.approx([c / 2 for c in OPENCV[2:4]])


@pytest.mark.parametrize("content", ["[]", '{"cameras": []}'])
def test_calibrations_without_cameras_are_refused(tmp_path, content):
    build(tmp_path, "immersive")
    (tmp_path / "models.json").write_text(content)
    refused(partial(read, tmp_path), r"models.json cannot .*\(it holds no camera\). Export it")


@pytest.mark.parametrize("name", ["models.json", "extri.yml", "calibration_a.json"])
def test_folders_called_like_calibrations_are_none(tmp_path, name):
    build(tmp_path, "Panoptic")
    (tmp_path / "calibration_dance.json").unlink()
    (tmp_path / name).mkdir()
    assert not MultiCameraSettings.recognises(tmp_path)
    refused(partial(read, tmp_path), "Add the calibration of the cameras")


def test_calibrations_that_may_not_be_read_are_not_recognised(tmp_path, monkeypatch):
    build(tmp_path, "immersive")
    denied = Path.read_bytes

    def read_bytes(path):
        if path.name == "models.json":
            raise PermissionError(13, "Permission denied")
        return denied(path)

    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    assert not MultiCameraSettings.recognises(tmp_path)
    refused(partial(read, tmp_path), "models.json cannot be read .*Permission denied")


@pytest.mark.parametrize("kind", ["EasyMocap's vectors", "Panoptic"])
def test_folders_of_scenes_are_no_rig(tmp_path, kind):
    for scene in "bac":
        build(tmp_path / scene, kind)
    assert not MultiCameraSettings.recognises(tmp_path)
    refused(partial(read, tmp_path), "holds neither")
    assert MultiCameraSettings.recognises(tmp_path / "a")


def test_scenes_inside_another_are_not_mixed_with_it(tmp_path):
    names = build(tmp_path, "EasyMocap's vectors")
    (tmp_path / "images").rename(tmp_path / "views")
    write(tmp_path / "images", "EasyMocap's vectors", names)
    (tmp_path / "views/link").symlink_to("..")
    for name in [*names, "07"]:
        save(tmp_path / "images" / name / "0.jpg", picture(0))
    with told(None):
        assert len(read(tmp_path).splits["train"]) == 12


def test_several_calibrations_of_panoptic_are_named(tmp_path):
    build(tmp_path, "Panoptic")
    (tmp_path / "calibration_a.json").write_text('{"cameras": []}')
    refused(partial(read, tmp_path), "2 calibrations: calibration_a.json, calibration_dance.json")


def test_recordings_without_a_calibration_are_told_of(tmp_path):
    build(tmp_path, "EasyMocap's vectors")
    save(tmp_path / "images/07/0.jpg", picture(0))
    with told("extri.yml has no camera of 07. 1 are left out"):
        assert len(read(tmp_path).splits["train"]) == 12


def test_other_panels_of_panoptic_need_not_be_there(tmp_path):
    build(tmp_path, "Panoptic")
    path = tmp_path / "calibration_dance.json"
    content = json.loads(path.read_text())
    content["cameras"] += [{**content["cameras"][0], "name": "01_01", "type": "vga"}]
    path.write_text(json.dumps(content))
    with told(None):
        assert len(read(tmp_path).splits["train"]) == 12
    (first,) = (path for path in tmp_path.rglob("00_00") if path.is_dir())
    shutil.copytree(first, first.with_name("01_01"))
    with told("HD cameras are read, and not 01_01, which have other rates|no camera of 01_01"):
        assert len(read(tmp_path).splits["train"]) == 12


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8"])
def test_calibrations_may_have_comments_and_other_encodings(tmp_path, encoding):
    build(tmp_path, "immersive")
    path = tmp_path / "models.json"
    path.write_bytes(f"// A comment\n{path.read_text()}".encode(encoding))
    assert MultiCameraSettings.recognises(tmp_path)
    assert len(read(tmp_path).splits["train"]) == 12
