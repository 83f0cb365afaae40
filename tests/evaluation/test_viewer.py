"""The viewer: camera conventions, and images sent to the browser."""

import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from xplanes.evaluation.render import orbit_poses
from xplanes.evaluation.runs import TrainedRun, load_run
from xplanes.evaluation.viewer import HOST, Viewer, camera_pose, draw
from xplanes.rendering.pictures import to_bytes
from xplanes.training.evaluation import render_view


@pytest.fixture(scope="module")
def trained(trained_run: Path) -> TrainedRun:
    return load_run(trained_run)


def quaternion(pose: torch.Tensor) -> torch.Tensor:
    """The viser rotation of one of our cameras, wxyz: an eigenvector of Bar-Itzhack's matrix."""
    r = pose[:3, :3].double() * torch.tensor([1.0, -1.0, -1.0])
    k = torch.tensor(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], 0, 0, 0],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], 0, 0],
            [r[0, 2] - r[2, 0], r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0],
            [r[1, 0] - r[0, 1], r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1]],
        ],
        dtype=torch.float64,
    )
    return torch.linalg.eigh(k)[1][:, -1]


def test_cameras_come_back_as_ours(trained: TrainedRun):
    for pose in orbit_poses(trained.views, trained.frame, 5, elevation=35):
        back = camera_pose(quaternion(pose), pose[:3, 3])
        assert torch.allclose(back, pose, atol=1e-5)


def test_an_image_from_a_view_is_that_view(trained: TrainedRun):
    views = trained.views
    fov = 2 * float(torch.atan(0.5 * views.height / views.intrinsics.focal[0, 1]))
    picture = draw(
        trained,
        views.camera_to_world[2],
        timestep=float(views.times[2]),
        fov=fov,
        height=views.height,
        aspect=1.0,
    )
    expected = render_view(
        trained.module.field, trained.module.renderer, trained.frame, views, 2, torch.ones(3)
    )
    assert (picture.int() - to_bytes(expected["colour"]).int()).abs().max() <= 1


def test_a_browser_gets_an_image_and_more_while_time_plays(trained: TrainedRun):
    pytest.importorskip("viser")
    viewer = Viewer(trained, 18080)
    try:
        assert viewer.server.get_host() == HOST == "127.0.0.1"
        pose = trained.views.camera_to_world[0]
        shown: list[np.ndarray] = []
        client = SimpleNamespace(
            client_id=1,
            camera=SimpleNamespace(
                wxyz=quaternion(pose).numpy(),
                position=pose[:3, 3].double().numpy(),
                fov=0.7,
                aspect=1.5,
                on_update=lambda callback: callback,
            ),
            scene=SimpleNamespace(set_background_image=lambda image, format: shown.append(image)),
        )
        viewer.size.value = "64"
        viewer._connect(client)
        until(lambda: any(image.shape == (64, 96, 3) for image in shown))
        count = len(shown)
        viewer.what.value = "depth"
        until(lambda: len(shown) > count)
        viewer._disconnect(client)
    finally:
        viewer.close()


def until(condition, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)
