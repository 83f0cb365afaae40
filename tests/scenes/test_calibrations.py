"""Rigs with calibrations of EasyMocap, of Google's immersive videos, and of CMU Panoptic."""

import json
from functools import partial

import numpy as np
import pytest
import torch

from tests.captures import HEIGHT, WIDTH, picture, poses, save, settings
from tests.scenes.common import refused, told
from tests.scenes.test_colmap import OPENCV
from xplanes.scenes.lenses import COEFFICIENTS
from xplanes.scenes.multicamera import MultiCameraSettings

POSES = poses(4)
K = [[OPENCV[0], 0, OPENCV[2]], [0, OPENCV[1], OPENCV[3]], [0, 0, 1]]
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
        own = [matrix(f"K_{n}", K) + matrix(f"dist_{n}", lens) for n in names]
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
                **{"name": name, "resolution": [WIDTH, HEIGHT], "K": K, "type": "hd"},
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
    with told(f"1 of 4 cameras have no video or folder .* left out: {names[2]}"):
        assert len(read(tmp_path).splits["train"]) == 9


def test_files_of_other_names_or_contents_are_no_calibrations(tmp_path):
    build(tmp_path, "immersive")
    (tmp_path / "models.json").write_text('["a/000000.png", {"camera_0001": 1}]')
    assert not MultiCameraSettings.recognises(tmp_path)
    refused(partial(read, tmp_path), "models.json cannot be read as the calibration of cameras")


@pytest.mark.parametrize(
    ("kind", "old", "new", "words"),
    [
        ("EasyMocap's vectors", "T_02", "X_02", r"extri.yml cannot be read .*'T', '02'"),
        ("EasyMocap's vectors", "rows: 3", "rows: 4", r"extri.yml cannot be read .*reshape"),
        ("immersive", "fisheye", "equirect", "projection_type is equirect.*write a transforms"),
        ("immersive", '"position"', '"place"', r"models.json cannot be read .*'position'.*Export"),
        ("Panoptic", '"R"', '"rot"', r"dance.json cannot be read .*'R'.*transforms.json"),
        ("Panoptic", '"00_', '"01_', "none of its cameras has a video or a folder .*01_00"),
        ("Panoptic", '{"cam', '["cam', "dance.json cannot be read as the calibration"),
    ],
)
def test_damaged_calibrations_are_refused_by_name(tmp_path, kind, old, new, words):
    build(tmp_path, kind)
    for path in [*tmp_path.glob("extri.yml"), *tmp_path.glob("*.json")]:
        path.write_text(path.read_text().replace(old, new))
    refused(partial(read, tmp_path), words)
