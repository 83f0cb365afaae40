"""Interactive viewer in the browser, for a trained field or one in training."""

import contextlib
import io
import math
import socket
import threading
import time
import warnings
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from xplanes.errors import ConfigError
from xplanes.evaluation.render import orbit_poses
from xplanes.optional import require
from xplanes.rendering.pictures import colour_map, to_bytes
from xplanes.scenes.views import Scene, spread
from xplanes.tools.drawing import MODES, Picture, Shot, draw
from xplanes.training.module import RadianceModule

HOST, PORT = "127.0.0.1", 8080
SIZES = ("64", "96", "128", "200", "320", "480", "720", "1080")
SPEEDS = {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
LOOP_SECONDS = 4.0  # Duration of one playback from time 0 to 1, at speed 1.
TICK_SECONDS = 0.04
SETTLE_SECONDS = 0.25  # Seconds without camera motion before the picture is rendered at full size.
MOVING_SECONDS = 0.08
"""Rendering time of a picture, in seconds, while the camera moves or time plays."""
FEWEST = 16  # Least number of rows of a picture.
REFRESH_SECONDS, SHARE = 0.5, 3
"""A picture of a field in training is refreshed after this number of seconds, but not before this
multiple of its rendering time."""
AWAY = 1.4  # Initial camera distance from the scene, relative to that of the training cameras.
FRUSTUM = 0.04  # Size of the cameras' frusta, relative to their median distance from the scene.
MOST_CAMERAS = 100  # Most training cameras that are drawn.
LARGEST_DEPTH = 160.0
"""Depth is clamped to this value, just below the largest that viser can encode."""
GREY = (120, 120, 120)
ABOUT_CAMERAS = "Training cameras, from dark to light in the order of their times."


def camera_pose(wxyz: Tensor, position: Tensor) -> Tensor:
    """Camera-to-world matrix, OpenGL axes, of a viser camera (OpenCV axes). [4], [3] -> [4, 4]"""
    rotation = require("viser.transforms", extra="viewer").SO3(wxyz.numpy()).normalize()
    pose = torch.eye(4)
    # OpenCV to OpenGL axes: y and z change sign.
    pose[:3, :3] = torch.from_numpy(rotation.as_matrix()) * torch.tensor([1, -1, -1])
    pose[:3, 3] = position
    return pose


def check_address(host: str, port: int, *, key: str) -> None:
    """Check that an address can be served.

    Args:
        host: Name or address of this machine.
        port: From 0 to 65535; 0 for any free one.
        key: Name of the settings in messages; ``host`` or ``port`` replaces the braces.

    Raises:
        ConfigError: If the port is taken or out of range, or the host is not this machine.
        MissingExtraError: Without the extra ``viewer``.
    """
    require("viser", extra="viewer")
    if not 0 <= port <= 65535:
        raise ConfigError(f"{key.format('port')}{port}: must lie between 0 and 65535")
    try:
        family, kind, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as trial:
            # Without this option, a port that was recently closed counts as taken.
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
    except socket.gaierror as error:
        raise ConfigError(f"{key.format('host')}{host}: no such machine ({error})") from error
    except PermissionError as error:
        raise ConfigError(
            f"{key.format('port')}{port}: needs administrator rights; choose one from 1024 on"
        ) from error
    except OSError as error:
        raise ConfigError(
            f"{key.format('port')}{port}: it cannot be served at {host} ({error.strerror}); choose "
            f"another, or {key.format('port')}0 for any free one"
        ) from error


def _silence() -> contextlib.AbstractContextManager[Any]:
    return contextlib.redirect_stdout(io.StringIO())


class Viewer:
    """Serves one field; every browser has its own camera, the controls are shared.

    Pictures are rendered in the thread that calls `catch_up`, never in the server's threads, so a
    field in training is rendered between steps.

    Args:
        module: The module with its field built.
        scene: The scene.
        host: Address to listen on.
        port: Port to listen on; the next free one if it is taken.
        trains: Whether the field is in training, which can then be paused.

    Attributes:
        patience: Longest rendering time of a picture at rest, in seconds; limits its size.
        step: Training step of the field; pictures are rendered again when it changes.
        paused: Whether training is paused.

    Raises:
        MissingExtraError: Without the extra ``viewer``.
    """

    def __init__(
        self,
        module: RadianceModule,
        scene: Scene,
        *,
        host: str = HOST,
        port: int = PORT,
        trains: bool = False,
    ) -> None:
        viser: Any = require("viser", extra="viewer")
        assert module.frame is not None
        self.module, self.scene = module, scene
        self.frame, self.views = module.frame, scene.splits["train"]
        self.patience, self.trains = math.inf, trains
        self.step, self.paused, self.playing = 0, False, False
        self._browsers: dict[int, _Browser] = {}
        self._wake = threading.Event()
        self._ticked = time.monotonic()
        # A browser may disconnect while its picture is rendered.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        with _silence():  # viser prints its own message.
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.set_panel_label("X-Planes")
        self._place_camera()
        self._add_controls()
        self._add_cameras()
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(self._disconnect)

    @property
    def port(self) -> int:
        """The port of the server."""
        return self.server.get_port()

    @property
    def is_watched(self) -> bool:
        """Whether a browser is connected."""
        return bool(self._browsers)

    def run(self) -> None:
        """Serve browsers until interrupted."""
        while True:
            self.catch_up()
            self.wait()

    def wait(self) -> None:
        """Wait for a change in a browser, for at most `TICK_SECONDS`."""
        self._wake.wait(TICK_SECONDS)
        self._wake.clear()

    def catch_up(self, seconds: float = math.inf) -> None:
        """Render all pictures that are due; no new one is begun after ``seconds``."""
        end = time.monotonic() + seconds
        while True:
            self._play()
            now = time.monotonic()
            waiting = sorted(self._browsers.values(), key=lambda browser: browser.began)
            due = [(browser, height) for browser in waiting if (height := browser.wanted(now))]
            for browser, height in due[:1]:
                browser.draw(height, now)
            if not due or time.monotonic() >= end:
                return

    def tell(self, text: str) -> None:
        """Show a line of text above the controls."""
        if self.status.content != text:
            self.status.content = text

    def close(self) -> None:
        """Stop serving."""
        self._browsers.clear()
        with _silence():
            self.server.stop()

    def shot(self, camera: Any, height: int) -> Shot:
        """The picture to render for a viser camera, with the current controls."""
        pose = camera_pose(torch.from_numpy(camera.wxyz), torch.from_numpy(camera.position))
        view = float(self.time.value), camera.fov, height, camera.aspect
        return Shot(pose, *view, mode=self.mode.value, box=self.box)

    @property
    def box(self) -> Tensor | None:
        """Least and largest corner of the crop; None for the whole cube. [2, 3]"""
        ends = torch.tensor([slider.value for slider in self.crop], dtype=torch.float32).T
        return None if bool((ends.abs() == 1).all()) else ends

    def _place_camera(self) -> None:
        """Place the initial camera behind the training camera nearest to the start of the orbit."""
        cameras = self.views.camera_to_world[:, :3, 3]
        begin = orbit_poses(self.views, self.frame, 1)[0, :3, 3]
        nearest = cameras[(cameras - begin).norm(dim=-1).argmin()]
        self.server.scene.set_up_direction(tuple(self.frame.rotation[:, 2].tolist()))
        start = self.server.initial_camera
        start.position = tuple((AWAY * self.frame.points(nearest)).tolist())
        start.look_at = (0.0, 0.0, 0.0)
        start.fov = self.views.intrinsics.fov_y

    def _add_controls(self) -> None:
        gui, static = self.server.gui, not self.module.field.moves
        self.status = gui.add_markdown("")
        if self.trains:
            self.pause = gui.add_button("Pause training")
            self.pause.on_click(lambda _: self._toggle_pause())
        with gui.add_folder("Time"):
            self.time = gui.add_slider("time", 0.0, 1.0, 0.005, 0.0, disabled=static)
            self.play = gui.add_button("Play", disabled=static)
            self.speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1")
        with gui.add_folder("Picture"):
            # Opaque images have no silhouettes, so they cannot reveal floaters.
            modes = [mode for mode in MODES if mode != "floaters" or not self.views.is_opaque]
            self.mode = gui.add_dropdown("show", tuple(modes))
            size = min(SIZES, key=lambda text: abs(int(text) - self.views.height))
            self.size = gui.add_dropdown("rows", SIZES, initial_value=size)
            self.cameras = gui.add_checkbox("cameras", True, hint=ABOUT_CAMERAS)
        with gui.add_folder("Crop"):
            self.crop = [
                gui.add_multi_slider(axis, -1.0, 1.0, 0.02, (-1.0, 1.0), min_range=0.02)
                for axis in "xyz"
            ]
            self.uncrop = gui.add_button("Show everything")
        self.play.on_click(lambda _: self._toggle_play())
        self.uncrop.on_click(lambda _: self._uncrop())
        for control in (self.time, self.mode, self.size):
            control.on_update(lambda _: self._refresh())
        for control in self.crop:
            control.on_update(lambda _: self._show_box())
        self.cameras.on_update(lambda _: self._show_cameras())

    def _add_cameras(self) -> None:
        views, scene = self.views, self.server.scene
        lines: Any = {"thickness": 1.5, "thickness_units": "screen"}
        places = self.frame.points(views.camera_to_world[:, :3, 3])
        # To the field's frame, and from OpenGL to OpenCV axes.
        turns = self.frame.rotation @ views.camera_to_world[:, :3, :3] * torch.tensor([1, -1, -1])
        turns = require("viser.transforms", extra="viewer").SO3.from_matrix(turns.numpy()).wxyz
        size, pinhole = views.intrinsics.size, views.intrinsics.pinhole
        heights = 2 * (0.5 * size[:, 0] / pinhole[:, 1]).atan()
        colours = to_bytes(colour_map(views.times)).numpy()
        self.frusta = [
            scene.add_camera_frustum(
                f"/cameras/{index}",
                fov=float(heights[index]),
                aspect=float(size[index, 1] / size[index, 0]),
                scale=FRUSTUM * float(places.norm(dim=-1).median()),
                color=colours[index],
                wxyz=turns[index],
                position=places[index].numpy(),
                **lines,
            )
            for index in spread(MOST_CAMERAS, len(views))
        ]
        corners = torch.cartesian_prod(*3 * [torch.tensor([-0.5, 0.5])])
        pairs = torch.combinations(torch.arange(8))
        edges = corners[pairs[(corners[pairs].diff(dim=1)[:, 0] != 0).sum(dim=1) == 1]]
        self.outline = scene.add_line_segments("/crop", edges.numpy(), GREY, visible=False, **lines)

    def _toggle_play(self) -> None:
        self.playing = not self.playing
        self.play.label = "Stop" if self.playing else "Play"
        self._ticked = time.monotonic()
        self._wake.set()

    def _toggle_pause(self) -> None:
        self.paused = not self.paused
        self.pause.label = "Continue training" if self.paused else "Pause training"
        self._refresh()
        self._wake.set()

    def _play(self) -> None:
        """Advance the time slider while it plays."""
        now = time.monotonic()
        passed, self._ticked = now - self._ticked, now
        if self.playing:
            share = passed * SPEEDS[self.speed.value] / LOOP_SECONDS
            self.time.value = round((self.time.value + share) % 1.0, 4)

    def _uncrop(self) -> None:
        for slider in self.crop:
            slider.value = (-1.0, 1.0)

    def _show_box(self) -> None:
        if (box := self.box) is not None:
            self.outline.scale = tuple((box[1] - box[0]).tolist())
            self.outline.position = tuple(box.mean(dim=0).tolist())
        self.outline.visible = box is not None
        self._refresh()

    def _show_cameras(self) -> None:
        for frustum in self.frusta:
            frustum.visible = self.cameras.value
        self._refresh()

    def _refresh(self) -> None:
        for browser in list(self._browsers.values()):
            browser.change()

    def _connect(self, client: Any) -> None:
        browser = _Browser(self, client)
        self._browsers[client.client_id] = browser
        client.camera.on_update(lambda _: browser.change())
        browser.change()

    def _disconnect(self, client: Any) -> None:
        self._browsers.pop(client.client_id, None)


@dataclass
class _Browser:
    """State of one connected browser.

    Attributes:
        viewer: The viewer.
        client: Viser's handle of the browser.
        version: Number of changes of its camera and the controls.
        changed: Time of the last change.
        drawn: ``version`` of its last picture.
        step: Training step of its last picture.
        sharp: Whether its last picture has the full size.
        began: Time at which rendering of its last picture began.
        again: Earliest time of the next picture, if only the field has changed.
        rate: Rendering speed in pixels per second.
    """

    viewer: Viewer
    client: Any
    version: int = 0
    changed: float = 0.0
    drawn: int = 0
    step: int = 0
    sharp: bool = False
    began: float = 0.0
    again: float = 0.0
    rate: float = 1e4

    def change(self) -> None:
        """Record a change; called by the server's threads."""
        self.changed = time.monotonic()
        self.version += 1
        self.viewer._wake.set()

    def wanted(self, now: float) -> int:
        """Rows of the picture that is due; 0 for none."""
        if self.version != self.drawn:
            return self._affordable(MOVING_SECONDS)
        rested = not self.sharp and now - self.changed > SETTLE_SECONDS
        if rested or (self.viewer.step != self.step and now >= self.again):
            return self._affordable(self.viewer.patience)
        return 0

    def _affordable(self, seconds: float) -> int:
        """Rows of a picture that can be rendered in a given time."""
        full = int(self.viewer.size.value)
        pixels = min(self.rate * seconds / max(self.client.camera.aspect, 0.1), full * full)
        return max(FEWEST, min(full, int(math.sqrt(pixels))))

    def draw(self, height: int, now: float) -> None:
        """Render and send a picture; unless it shows a change itself, a new change abandons it."""
        viewer, version = self.viewer, self.version
        resting = version == self.drawn
        shot = viewer.shot(self.client.camera, height)
        picture = draw(
            viewer.module.field,
            viewer.module.renderer,
            shot,
            views=viewer.views,
            frame=viewer.frame,
            background=viewer.scene.background,
            at_once=max(256, int(self.rate * MOVING_SECONDS / 2)),
            stop=lambda: resting and self.version != version,
        )
        if picture is None:
            return
        self.drawn, self.step, self.began = version, viewer.step, now
        self.sharp = resting or height >= int(viewer.size.value)
        self._send(picture)
        spent = max(time.monotonic() - now, 1e-6)
        self.rate = 0.5 * (self.rate + shot.height * shot.width / spent)
        self.again = now + max(REFRESH_SECONDS, SHARE * spent)

    def _send(self, picture: Picture) -> None:
        # The scene may occlude the lines of cameras and crop.
        has_lines = self.viewer.cameras.value or self.viewer.outline.visible
        self.client.scene.set_background_image(
            to_bytes(picture.colours).numpy(),
            format="jpeg",
            jpeg_quality=92 if self.sharp else 75,
            depth=picture.depth.clamp_max(LARGEST_DEPTH).numpy() if has_lines else None,
        )
