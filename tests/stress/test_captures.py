"""Files of COLMAP and Nerfies with damaged bytes and extreme numbers."""

import math
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.captures import NerfiesFolder, picture, poses, save, settings, write_colmap
from xplanes.errors import SceneError
from xplanes.scenes.colmap import ColmapSettings
from xplanes.scenes.colmap_model import read_model
from xplanes.scenes.nerfies import NerfiesSettings

pytestmark = pytest.mark.stress

PYCOLMAP = Path(__file__).parents[1] / "data" / "colmap"
EXTREMES = (1e300, -1e300, 1e-300, 1e38, 1e30, -1e-30, 1e6, 0.0, 10**400)


def test_every_truncated_model(tally, tmp_path) -> None:
    """COLMAP's binary files, cut after every byte"""
    shutil.copytree(PYCOLMAP, tmp_path / "model")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        path = tmp_path / "model" / name
        whole = path.read_bytes()
        for length in range(len(whole)):
            path.write_bytes(whole[:length])
            model, message = _outcome(partial(read_model, tmp_path / "model"))
            assert model is None, (name, length)
            tally.diagnosed(message, f"{name} is truncated")
        path.write_bytes(whole)


def test_models_with_wrong_bytes(tally, tmp_path) -> None:
    """COLMAP's binary files with bytes replaced one by one: finite numbers, or words"""
    shutil.copytree(PYCOLMAP, tmp_path / "model")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        path = tmp_path / "model" / name
        whole = path.read_bytes()
        for place in range(len(whole)):
            value = (0, 0x7F, 0xFF)[place % 3]
            path.write_bytes(whole[:place] + bytes([value]) + whole[place + 1 :])
            _read(tally, tmp_path / "model", (name, place, value))
        path.write_bytes(whole)


def test_text_models_with_wrong_characters(tally, tmp_path) -> None:
    """COLMAP's text files with pieces cut out and characters replaced"""
    camera = {1: ("OPENCV", 40, 30, (36.0, 34.0, 20.5, 14.25, -0.11, 0.03, 0.004, -0.003))}
    images = [(f"{index}.png", pose, 1, 2) for index, pose in enumerate(poses(3))]
    write_colmap(tmp_path / "model", camera, images, [[1.0, 2.0, 3.0]] * 3, text=True)
    random = np.random.default_rng(0)
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        path = tmp_path / "model" / name
        whole = path.read_text()
        for case in range(600):
            start, length = random.integers(len(whole)), random.integers(1, 40)
            piece = random.choice(["", "\n", " ", "#", "\0", "e999", "nan", "-", "\u0663", "1_0"])
            path.write_text(whole[:start] + piece + whole[start + length :])
            _read(tally, tmp_path / "model", (name, case))
        path.write_text(whole)


def _read(tally, folder, case) -> None:
    """A model is read with finite numbers, or refused in words that name a file of it."""
    model, message = _outcome(partial(read_model, folder))
    if model is None:
        tally.diagnosed(message, str(folder))
        return
    for camera in model.calibrations:
        numbers = (camera.fl_x, camera.fl_y, camera.cx, camera.cy, *camera.distortion)
        assert all(math.isfinite(number) for number in numbers), case
    tally.finite(torch.from_numpy(model.camera_to_world), torch.from_numpy(model.points))


def test_extreme_numbers_in_cameras(tally, tmp_path) -> None:
    """Extreme focal lengths, positions, scales and coefficients: finite rays, or words"""
    capture = NerfiesFolder(tmp_path / "room", 3)
    whole = {
        file: (capture.path / file).read_text() for file in ("camera/000000.json", "scene.json")
    }
    for value in EXTREMES:
        for file, changes in (
            ("camera/000000.json", {"focal_length": value}),
            ("camera/000000.json", {"pixel_aspect_ratio": value}),
            ("camera/000000.json", {"skew": value}),
            ("camera/000000.json", {"principal_point": [value, 14]}),
            ("camera/000000.json", {"position": [0, value, 0]}),
            ("camera/000000.json", {"image_size": [value, value]}),
            ("camera/000000.json", {"radial_distortion": [0, 0, value]}),
            ("camera/000000.json", {"tangential": [value, 0]}),
            ("scene.json", {"scale": value}),
            ("scene.json", {"center": [value, 0, 0]}),
        ):
            capture.change(file, **changes)
            _cast(tally, settings(NerfiesSettings, "nerfies", capture.path), (value, changes))
            capture.write(file, whole[file])


def test_extreme_numbers_in_models(tally, tmp_path) -> None:
    """Extreme parameters and translations of COLMAP's cameras: finite rays, or words"""
    folder = tmp_path / "room"
    for index in range(3):
        save(folder / "images" / f"{index}.png", picture(index))
    plain = (36.0, 34.0, 20.5, 14.25, -0.11, 0.03, 0.004, -0.003)
    for value in map(float, EXTREMES[:-1]):
        for place in range(len(plain) + 1):
            params, cameras = list(plain), poses(3)
            if place < len(plain):
                params[place] = value
            else:
                cameras[1, 0, 3] = value
            images = [(f"{index}.png", pose, 1, 0) for index, pose in enumerate(cameras)]
            write_colmap(folder / "sparse", {1: ("OPENCV", 40, 30, tuple(params))}, images)
            _cast(tally, settings(ColmapSettings, "colmap", folder), (value, place))


def _cast(tally, made, case) -> None:
    """Rays of the first view are finite unit vectors, or the capture is refused in words."""
    scene, message = _outcome(partial(made.load, ["train"]))
    if scene is None:
        tally.diagnosed(message, str(made.folder))
        return
    views = scene.splits["train"]
    for index in range(len(views)):
        origins, directions = views.image_rays(index)
        tally.finite(origins, directions)
        assert (directions.norm(dim=-1) - 1).abs().max() < 1e-5, case


def _outcome(call):
    """What a call returns, or None, and the message of the error."""
    try:
        return call(), ""
    except SceneError as error:
        return None, str(error)
