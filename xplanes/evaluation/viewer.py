"""Interactive viewer in the browser: free camera and time slider."""

import math
import threading
import time
from typing import Any

import torch
from torch import Tensor

from xplanes.evaluation.render import orbit_poses
from xplanes.evaluation.runs import TrainedRun
from xplanes.optional import require
from xplanes.rendering.pictures import depth_picture, to_bytes
from xplanes.scenes.views import PosedCamera

HOST = "127.0.0.1"
SIZES = ("64", "96", "128", "200", "320", "480", "720")
LOOP_SECONDS = 4.0
"""Duration of one playback from time 0 to 1."""
TICK_SECONDS = 0.04
SETTLE_SECONDS = 0.25
"""How long a camera must rest before the picture is drawn in full."""
MOVING_SECONDS = 0.1
"""What a picture may take while the camera moves or time plays."""


def camera_pose(wxyz: Tensor, position: Tensor) -> Tensor:
    """Pose of a viser camera (x right, y down, looking along +z) in our axes. [4], [3] -> [4, 4]"""
    w, x, y, z = (wxyz / wxyz.norm()).tolist()
    pose = torch.eye(4)
    # The second and third column change sign: our y is up, and we look along -z.
    pose[:3, :3] = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), -2 * (x * y - w * z), -2 * (x * z + w * y)],
            [2 * (x * y + w * z), -(1 - 2 * (x * x + z * z)), -2 * (y * z - w * x)],
            [2 * (x * z - w * y), -2 * (y * z + w * x), -(1 - 2 * (x * x + y * y))],
        ]
    )
    pose[:3, 3] = position
    return pose


def draw(
    trained: TrainedRun,
    pose: Tensor,
    *,
    timestep: float,
    fov: float,
    height: int,
    aspect: float,
    what: str = "colour",
) -> Tensor:
    """Render one picture.

    Args:
        trained: The run.
        pose: Camera-to-world matrix. [4, 4]
        timestep: Time, from 0 to 1.
        fov: Vertical field of view, in radians.
        height: Rows.
        aspect: Columns per row.
        what: ``colour`` or ``depth``.

    Returns:
        The picture. uint8 [height, width, 3]
    """
    width = max(1, round(height * aspect))
    focal = 0.5 * height / math.tan(0.5 * fov)
    image = trained.module.renderer.view(
        trained.module.field,
        trained.frame,
        PosedCamera(pose, focal, height, width),
        timestep,
        trained.scene.background,
    )
    if what == "depth":
        return to_bytes(depth_picture(image["depth"], image["opacity"]))
    return to_bytes(image["colour"])


class Viewer:
    """Serves one run; every browser has its own camera, time and size are shared.

    Args:
        trained: The run.
        port: Port to listen on, on this machine alone; the next free one if it is taken.

    Raises:
        ImportError: Without the extra ``viewer``.
    """

    def __init__(self, trained: TrainedRun, port: int) -> None:
        viser: Any = require("viser", extra="viewer")
        self.trained = trained
        self.playing = False
        self._busy = threading.Lock()
        self._watchers: dict[int, _Watcher] = {}
        self.server = viser.ViserServer(host=HOST, port=port, verbose=False)
        self._place_camera()
        gui = self.server.gui
        static = trained.is_static
        self.time = gui.add_slider("time", 0.0, 1.0, 0.005, 0.0, disabled=static)
        self.play = gui.add_button("play", disabled=static)
        size = min(SIZES, key=lambda text: abs(int(text) - trained.views.height))
        self.size = gui.add_dropdown("resolution", SIZES, initial_value=size)
        self.what = gui.add_dropdown("show", ("colour", "depth"))
        self.play.on_click(lambda _: self._toggle())
        for control in (self.time, self.size, self.what):
            control.on_update(lambda _: self._refresh())
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(self._disconnect)

    @property
    def port(self) -> int:
        """The port that is served."""
        return self.server.get_port()

    def run(self) -> None:
        """Let time pass while it plays, until interrupted."""
        while True:
            time.sleep(TICK_SECONDS)
            if self.playing:
                self.time.value = round((self.time.value + TICK_SECONDS / LOOP_SECONDS) % 1.0, 3)
                self._refresh()

    def close(self) -> None:
        """Stop serving."""
        for watcher in list(self._watchers.values()):
            watcher.stop()
        self.server.stop()

    def show(self, camera: Any, height: int) -> Tensor:
        """What a viser camera sees now. uint8 [height, width, 3]"""
        pose = camera_pose(torch.from_numpy(camera.wxyz), torch.from_numpy(camera.position))
        with self._busy:
            return draw(
                self.trained,
                pose,
                timestep=float(self.time.value),
                fov=camera.fov,
                height=height,
                aspect=camera.aspect,
                what=self.what.value,
            )

    def _place_camera(self) -> None:
        views, frame = self.trained.scene.splits["train"], self.trained.frame
        self.server.scene.set_up_direction("+z")
        start = self.server.initial_camera
        start.position = tuple(orbit_poses(views, frame, 1)[0, :3, 3].tolist())
        start.look_at = tuple(frame.centre.tolist())
        start.fov = views.intrinsics.fov_y

    def _toggle(self) -> None:
        self.playing = not self.playing
        self.play.label = "pause" if self.playing else "play"

    def _refresh(self) -> None:
        for watcher in list(self._watchers.values()):
            watcher.wake()

    def _connect(self, client: Any) -> None:
        watcher = _Watcher(self, client)
        self._watchers[client.client_id] = watcher
        client.camera.on_update(lambda _: watcher.wake())
        watcher.start()

    def _disconnect(self, client: Any) -> None:
        watcher = self._watchers.pop(client.client_id, None)
        if watcher is not None:
            watcher.stop()


class _Watcher(threading.Thread):
    """Draws for one browser: small pictures while anything changes, a full one at rest."""

    def __init__(self, viewer: Viewer, client: Any) -> None:
        super().__init__(daemon=True)
        self.viewer, self.client = viewer, client
        self._changed = threading.Event()
        self._changed.set()
        self._stopped = False
        self._pixels_per_second = 1e5

    def wake(self) -> None:
        """Something has changed."""
        self._changed.set()

    def stop(self) -> None:
        """End the thread after its present picture."""
        self._stopped = True
        self._changed.set()

    def run(self) -> None:
        while True:
            self._changed.wait()
            if self._stopped:
                return
            self._changed.clear()
            full = int(self.viewer.size.value)
            small = self._affordable(full)
            self._draw(small)
            if small < full and not self._changed.wait(SETTLE_SECONDS):
                self._draw(full)

    def _affordable(self, full: int) -> int:
        pixels = self._pixels_per_second * MOVING_SECONDS
        height = int(math.sqrt(pixels / max(self.client.camera.aspect, 0.1)))
        return max(24, min(full, height))

    def _draw(self, height: int) -> None:
        began = time.perf_counter()
        picture = self.viewer.show(self.client.camera, height)
        spent = time.perf_counter() - began
        rate = picture.shape[0] * picture.shape[1] / max(spent, 1e-6)
        self._pixels_per_second = 0.5 * (self._pixels_per_second + rate)
        if not self._stopped:
            self.client.scene.set_background_image(picture.numpy(), format="jpeg")
