"""The viewer: camera conventions, what browsers are sent and when, and a field that trains."""

import itertools
import math
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from tests.baselines.runs import KPLANES, PROPOSAL, baseline_config
from tests.captures import quaternion
from tests.training.runs import small_config, train_quietly
from tests.training.test_surroundings import scene
from xplanes import RadianceModule
from xplanes.cli import main
from xplanes.errors import ConfigError
from xplanes.evaluation.render import orbit_poses
from xplanes.run import run
from xplanes.tools import live
from xplanes.tools import viewer as module
from xplanes.tools.live import LiveViewer
from xplanes.tools.runs import TrainedRun
from xplanes.tools.viewer import HOST, Viewer, camera_pose, check_address
from xplanes.training.clock import TrainingClock, find_callback

pytest.importorskip("viser")


@pytest.fixture
def viewer(trained: TrainedRun) -> Iterator[Viewer]:
    found = Viewer(trained.module, trained.scene, port=18080)
    yield found
    found.close()


def rotation(pose: Tensor) -> np.ndarray:
    """The viser rotation of one of our cameras, wxyz."""
    return quaternion((pose[:3, :3].double() * torch.tensor([1.0, -1.0, -1.0])).numpy())


class Client:
    """A browser as viser hands it over, with a camera in the field's frame."""

    def __init__(self, pose: Tensor) -> None:
        self.client_id = 1
        self.shown: list[np.ndarray] = []
        self.depths: list[np.ndarray | None] = []
        self.moved: list[Callable[[Any], None]] = []
        self.camera = SimpleNamespace(
            wxyz=rotation(pose),
            position=pose[:3, 3].double().numpy(),
            fov=0.7,
            aspect=1.5,
            on_update=self.moved.append,
        )
        self.scene = SimpleNamespace(set_background_image=self.take)

    def take(self, image: np.ndarray, depth: np.ndarray | None, **others: Any) -> None:
        assert others["format"] == "jpeg"
        self.shown.append(image)
        self.depths.append(depth)

    def move(self) -> None:
        """As the mouse does."""
        self.camera.position = self.camera.position * 1.01
        for callback in self.moved:
            callback(self.camera)

    @property
    def rows(self) -> list[int]:
        """Rows of all pictures so far."""
        return [len(image) for image in self.shown]


def in_field(trained: TrainedRun, index: int) -> Tensor:
    """The pose of a training camera in the field's frame."""
    pose = trained.scene.splits["train"].camera_to_world[index].clone()
    pose[:3, :3] = trained.frame.rotation @ pose[:3, :3]
    pose[:3, 3] = trained.frame.points(pose[:3, 3])
    return pose


@pytest.fixture
def client(trained: TrainedRun, viewer: Viewer) -> Client:
    """A browser at a training camera."""
    found = Client(in_field(trained, 0))
    viewer.size.value = "64"
    viewer._connect(found)
    return found


def rest(viewer: Viewer) -> None:
    """Nothing changes until a full picture is due: the last change is long past."""
    for browser in viewer._browsers.values():
        browser.changed -= module.SETTLE_SECONDS
    viewer.catch_up()


def test_cameras_come_back_as_ours(trained):
    for pose in orbit_poses(trained.views, trained.frame, 5, elevation=35):
        back = camera_pose(torch.tensor(rotation(pose)), pose[:3, 3])
        assert torch.allclose(back, pose, atol=1e-5)


def test_frusta_stand_where_training_cameras_are(trained, viewer):
    views = trained.scene.splits["train"]
    assert len(viewer.frusta) == len(views)
    for index, frustum in enumerate(viewer.frusta):
        pose = camera_pose(torch.from_numpy(frustum.wxyz), torch.from_numpy(frustum.position))
        assert torch.allclose(pose, in_field(trained, index), atol=1e-5)
        assert (frustum.fov, frustum.aspect) == (pytest.approx(views.intrinsics.fov_y), 1)
    shades = [sum(viewer.frusta[int(i)].color) for i in views.times.argsort()[[0, -1]]]
    assert shades[0] < shades[1]


def test_pictures_are_small_while_something_changes_and_full_at_rest(viewer, client, monkeypatch):
    monkeypatch.setattr(module, "MOVING_SECONDS", 0.0)
    for change in (lambda: None, client.move, lambda: setattr(viewer.time, "value", 0.3)):
        before = len(client.rows)
        change()
        viewer.catch_up()
        assert client.rows[before:] == [module.FEWEST]
        assert client.shown[-1].shape == (16, 24, 3)
        rest(viewer)
        assert client.rows[before:] == [module.FEWEST, 64]
        assert client.shown[-1].shape == (64, 96, 3)
        viewer.catch_up()
        assert len(client.rows) == before + 2


def test_a_full_picture_is_given_up_when_the_camera_moves(viewer, client, monkeypatch):
    monkeypatch.setattr(module, "MOVING_SECONDS", 0.0)
    viewer.catch_up()
    draw, moves = module.draw, iter([client.move])

    def moving(*parts: Any, **options: Any) -> Any:
        next(moves, lambda: None)()
        return draw(*parts, **options)

    monkeypatch.setattr(module, "draw", drawing := Mock(side_effect=moving))
    rest(viewer)
    assert drawing.call_count == 2  # The full one was begun.
    assert client.rows == [module.FEWEST] * 2


def test_controls_change_the_picture(viewer, client):
    def picture() -> np.ndarray:
        viewer.catch_up()
        rest(viewer)
        return client.shown[-1].astype(int)

    shown = {"colour": picture()}
    for mode in ("depth", "opacity", "floaters"):
        viewer.mode.value = mode
        shown[mode] = picture()
    viewer.mode.value = "colour"
    viewer.crop[0].value = (-1.0, 0.0)
    shown["cropped"] = picture()
    assert viewer.outline.visible
    assert viewer.outline.scale == (1, 2, 2)
    assert viewer.outline.position.tolist() == [-0.5, 0, 0]
    for first, second in itertools.combinations(shown, 2):
        assert np.abs(shown[first] - shown[second]).mean() > 1, (first, second)
    viewer._uncrop()
    assert np.array_equal(picture(), shown["colour"])
    assert not viewer.outline.visible
    assert client.depths[-1] is not None
    viewer.cameras.value = False
    picture()
    assert not any(frustum.visible for frustum in viewer.frusta)
    assert client.depths[-1] is None


def test_time_passes_while_it_plays(viewer, client):
    viewer.speed.value = "2"
    viewer._toggle_play()
    times, end = [], time.monotonic() + 0.6
    while time.monotonic() < end:
        viewer.catch_up(0)
        times.append(viewer.time.value)
    passed = times[-1] * module.LOOP_SECONDS / 2
    assert passed == pytest.approx(0.6, abs=0.2)
    assert len(client.rows) > 2
    viewer._toggle_play()
    stopped = viewer.time.value
    viewer.catch_up(0)
    assert viewer.time.value == stopped


def test_nobody_is_drawn_for_once_the_browser_has_left(viewer, client):
    viewer.catch_up()
    count = len(client.rows)
    assert viewer.is_watched
    viewer._disconnect(client)
    client.move()
    viewer.catch_up()
    assert not viewer.is_watched
    assert len(client.rows) == count


def test_addresses_that_cannot_be_served_are_refused(trained_run, monkeypatch, capsys):
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"port={port}: .*viewer\.port=0 for any free"):
            LiveViewer(port=port)
        assert main(["view", str(trained_run), "--port", str(port)]) == 1
        assert f"--port {port}: it cannot be served" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="port 70000: must lie between 0 and 65535"):
        check_address(HOST, 70000, key="{} ")
    with pytest.raises(ConfigError, match=r"viewer\.host=nowhere\.invalid: no such"):
        LiveViewer(host="nowhere.invalid")
    monkeypatch.setitem(sys.modules, "viser", None)
    LiveViewer(enabled=False)


class Watched(Viewer):
    """A viewer with a browser whose camera never rests."""

    made: "list[Watched]" = []  # noqa: RUF012

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        pose = torch.eye(4)
        pose[2, 3] = 4.0
        self.client = Client(pose)
        self._connect(self.client)
        self.steps: list[int] = []
        self.served = self.port
        Watched.made.append(self)

    def catch_up(self, seconds: float = math.inf) -> None:
        self.client.move()
        super().catch_up(seconds)
        self.steps.append(self.step)


@pytest.fixture
def watched(monkeypatch) -> list[Watched]:
    monkeypatch.setattr(Watched, "made", [])
    monkeypatch.setattr(live, "Viewer", Watched)
    return Watched.made


FIELDS = {
    "six_planes": (small_config, "alpha", ()),
    "six_planes with a background": (small_config, "world", ("model.rays.per_batch=512",)),
    "kplanes": (baseline_config, "alpha", ("model=kplanes", *KPLANES, *PROPOSAL)),
}


def fitted(name: str, folder: Path, *callbacks: Callback, steps: int = 12) -> RadianceModule:
    """A small field of a ball, trained for some steps."""
    config, kind, overrides = FIELDS[name]
    found = RadianceModule(config(Path(), *overrides))
    found.build(scene(kind))
    train_quietly(found, scene(kind), folder, steps, callbacks=callbacks)
    return found


@pytest.mark.parametrize(
    "name", ["six_planes with a background", pytest.param("kplanes", marks=pytest.mark.slow)]
)
def test_training_is_the_same_with_a_viewer_to_the_last_bit(name, tmp_path, watched):
    plain = fitted(name, tmp_path)
    assert not watched
    seen = fitted(name, tmp_path, LiveViewer(port=0))
    (viewer,) = watched
    assert viewer.steps == list(range(12))
    assert len(viewer.client.rows) >= 12
    sizes = {len(image) for image in viewer.client.shown}
    first, last = viewer.client.shown[0], viewer.client.shown[-1]
    assert len(sizes) > 1 or np.abs(first.astype(int) - last).max() > 1
    assert viewer.client.shown[-1].std() > 0
    assert (getattr(seen.field, "background", None) is not None) == ("background" in name)
    for key, value in plain.state_dict().items():
        assert torch.equal(value, seen.state_dict()[key]), key
    assert plain.tally.counts == seen.tally.counts
    assert plain.tally.last == pytest.approx(seen.tally.last, abs=0, nan_ok=True)


def test_a_run_has_a_viewer_when_asked_to(scenes, tmp_path, watched, capsys):
    short = ("trainer.max_steps=2", "callbacks.evaluation.at=[1]", "callbacks.viewer.port=0")
    run(small_config(scenes, *short), tmp_path / "plain", [], resume=False)
    assert not watched
    run(small_config(scenes, *short, "viewer=true"), tmp_path / "seen", [], resume=False)
    (viewer,) = watched
    assert f"viewer      http://localhost:{viewer.served}" in capsys.readouterr().out
    with socket.socket() as free:  # It is closed.
        free.bind((HOST, viewer.served))


def test_a_pause_stops_training_and_its_clock(tmp_path, watched):
    class Pausing(LiveViewer):
        """Someone pauses training for a while, some steps on."""

        seconds = 0.0

        def _serve(self, viewer: Viewer, trainer: Any, of: Any) -> None:
            if trainer.global_step != 5:
                super()._serve(viewer, trainer, of)
                return
            viewer._toggle_pause()
            assert viewer.pause.label == "Continue training"
            threading.Timer(0.4, viewer._toggle_pause).start()
            began = time.monotonic()
            super()._serve(viewer, trainer, of)
            self.seconds = time.monotonic() - began

        def on_train_end(self, trainer: Any, pl_module: Any) -> None:
            clock = find_callback(trainer, TrainingClock)
            assert clock is not None
            self.counted = clock.seconds
            super().on_train_end(trainer, pl_module)

    pausing = Pausing(port=0)
    began = time.monotonic()
    fitted("six_planes", tmp_path, pausing)
    assert pausing.seconds >= 0.4
    assert 0 < pausing.counted < time.monotonic() - began - pausing.seconds
    (viewer,) = watched
    assert viewer.steps.count(5) > 2  # It goes on to draw.
    assert viewer.pause.label == "Pause training"
    assert "** of 12, " in viewer.status.content
    assert " dB" in viewer.status.content


def test_a_picture_that_fails_ends_the_viewer_and_not_training(
    tmp_path, watched, monkeypatch, caplog
):
    monkeypatch.setattr(module, "draw", Mock(side_effect=RuntimeError("out of memory")))
    found = fitted("six_planes", tmp_path, LiveViewer(port=0))
    assert found.batches == 12
    assert "the viewer is closed, training goes on: out of memory" in caplog.text
    assert not watched[0].is_watched
