"""`xplanes render`: the camera and the time of each frame, and the output file."""

import difflib
import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from xplanes.errors import ConfigError, require_between
from xplanes.evaluation.render import (
    ELEVATION,
    FPS,
    FRAMES,
    IMAGES,
    Track,
    back_and_forth,
    check_video,
    fitting,
    render_path,
    training_path,
    write_video,
)
from xplanes.files import require_writable
from xplanes.process import say
from xplanes.scenes.cameras import PosedCamera
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene, Views
from xplanes.tools.camera_path import CameraPath, read_camera_path
from xplanes.tools.runs import TrainedRun

OWN = "own"  # Value of ``--time`` for the time of the view that ``--path`` names.

PATHS = ("auto", "orbit", "fixed", "cameras")
"""Values of ``--path`` other than names of views or files."""

LARGEST = 8192  # Most pixels per side; WebP allows twice as many.


@dataclass(frozen=True)
class VideoOptions:
    """Options of `xplanes render`.

    Attributes:
        path: Camera: ``orbit``, ``fixed`` (the first camera of the orbit), ``cameras`` (those of
            the training views, see `training_path`), ``view:FILE``, a camera path, FILE.json, or
            ``auto``, see `chosen_for`.
        time: ``sweep`` (from 0 to 1), ``back-and-forth``, ``own`` (that of ``view:FILE``), or a
            number from 0 to 1; None for ``own`` in a single image of a view, for the times of a
            camera path or of ``cameras``, or for back-and-forth.
        frames: Number of frames; None for 48, for 1 if a fixed camera or a view shows one time, or
            for one per camera of a camera path.
        fps: Frames per second; None for 16, or the rate in the camera path.
        size: Pixels of the longer side; None for the size of the training views, of the view that
            ``path`` names, or the size in the camera path. Frames of an orbit or a fixed camera
            are square.
        elevation: Elevation of orbit and fixed camera, in degrees.
        what: ``colour`` or ``depth``.
        out: A file (.webp, .mp4, .png, .jpg), or a folder if it ends in /; None for a file in the
            run's media/ that is named after the options.
    """

    path: str = "auto"
    time: str | None = None
    frames: int | None = None
    fps: int | None = None
    size: int | None = None
    elevation: float = ELEVATION
    what: str = "colour"
    out: str | None = None

    def __post_init__(self) -> None:
        out = Path(self.out or "")
        one_image = out.suffix in IMAGES and not out.is_dir() and self.frames in (None, 1)
        if one_image and self.path.startswith("view:") and self.time is None:
            object.__setattr__(self, "time", OWN)

    def chosen_for(self, scene: Scene) -> "VideoOptions":
        """The options with a path: by default an orbit, or cameras in a scene with surroundings."""
        if self.path != "auto":
            return self
        stays = scene.is_surrounded and self.elevation == ELEVATION
        return replace(self, path="cameras" if stays else "orbit")

    @cached_property
    def cameras(self) -> CameraPath | None:
        """The camera path, read from its file; None if ``path`` is another kind of camera.

        Raises:
            SceneError: If it cannot be used.
        """
        return read_camera_path(Path(self.path)) if self.path.endswith(".json") else None

    @property
    def count(self) -> int:
        """Number of frames."""
        if self.cameras is not None:
            return len(self.cameras)
        if self.frames is not None:
            return self.frames
        moves = self.path in PATHS and self.path != "fixed"
        passes = self.time in (None, "sweep", "back-and-forth")
        return FRAMES if moves or passes else 1

    @property
    def rate(self) -> int:
        """Frames per second."""
        written = None if self.cameras is None else self.cameras.fps
        return self.fps or written or FPS

    def track(self, scene: Scene, frame: Frame) -> Track:
        """Camera and time of each frame; `ConfigError` if there is no such view."""
        views, count, time = scene.splits["train"], self.count, self.time
        side = max(views.height, views.width)
        if (path := self.cameras) is not None:
            height = path.height or path.width or side
            size = self._sized(height, path.width or height)
            pairs = zip(path.poses, path.focal(*size).tolist(), strict=True)
            seen_at = path.times if time is None else times(time, count)
            return Track([PosedCamera(pose, focal, *size) for pose, focal in pairs], seen_at)
        if self.path in ("orbit", "fixed"):
            seen_at = times(time or "back-and-forth", count)
            parts = views, frame, seen_at, self._sized(side, side), self.elevation
            return Track.orbit(*parts, fixed=self.path == "fixed")
        if self.path == "cameras":
            time = time or OWN
            indices, seen_at = training_path(views, count)
        else:
            views, index = find_view(scene.splits, self.path.removeprefix("view:"))
            indices = [index] * count
            seen_at = views.times[indices]
        if time != OWN:
            seen_at = times(time or "back-and-forth", count)
        return Track.of_views(views, indices, seen_at, self._sized(*views.size(indices[0])))

    def _sized(self, height: int, width: int) -> tuple[int, int]:
        return (height, width) if self.size is None else fitting(height, width, self.size)

    def destination(self, run: Path, checkpoint: str) -> tuple[Path, bool]:
        """The file or folder to write, and whether it is a folder."""
        if self.out is not None:
            return Path(self.out), self.out.endswith("/") or Path(self.out).is_dir()
        if self.cameras is not None:
            parts = ["render", Path(self.path).stem, *([self.time] if self.time else [])]
        else:
            camera = self.path.replace(":", "_").replace("/", "_").removesuffix(".png")
            own = "own" if self.path == "cameras" else "back-and-forth"
            parts = ["render", camera, self.time or own]
        parts += [part for part in (self.what, checkpoint) if part not in ("colour", "last")]
        ending = ".png" if self.count == 1 else ".webp"
        return run / "media" / ("_".join(parts) + ending), False

    def check(self) -> None:
        """Check the options without a run.

        Raises:
            ConfigError, SceneError: If an option is invalid, or a camera path cannot be used.
            ImportError: For .mp4 without the extra ``video``.
        """
        views = self.path.startswith("view:")
        if self.time != OWN:
            times(self.time or "back-and-forth", 1)
        elif not views and self.path != "cameras":
            raise ConfigError(
                f"--time {OWN}: is a view's own time and needs --path view:FILE or cameras"
            )
        if self.path not in PATHS and not views and self.cameras is None:
            raise ConfigError(
                f"--path {self.path}: must be auto, orbit, fixed, cameras, view:FILE or a camera "
                "path, FILE.json"
            )
        if self.cameras is not None and self.frames is not None:
            raise ConfigError(
                f"--frames {self.frames}: {self.path} has {self.count} cameras, and each of them "
                "gives one frame; leave --frames out"
            )
        require_between("--frames", self.count, 1, 100_000)
        require_between("--fps", self.fps, 1, 240)
        require_between("--size", self.size, 1, LARGEST)
        require_between("--elevation", self.elevation, -90, 90)
        if self.cameras is not None and self.size is None:
            longer = max(self.cameras.height or 1, self.cameras.width or 1)
            if longer > LARGEST:
                raise ConfigError(
                    f"{self.path} asks for frames of {longer} px: set --size to at most {LARGEST}"
                )
        target, folder = self.destination(Path(), "last")
        check_video(target, frames=self.count, folder=folder)


def render_video(trained: TrainedRun, options: VideoOptions) -> Path:
    """Render and write a video.

    Args:
        trained: The run.
        options: Cameras, times and size of the frames, and where to write them.

    Returns:
        The file or folder that was written.

    Raises:
        ConfigError: If options are out of range or contradict one another.
        ImportError: For .mp4 without the extra ``video``.
    """
    options.check()
    options = options.chosen_for(trained.scene)
    track = options.track(trained.scene, trained.frame)
    name, written = f"{options.path} camera", "back-and-forth"
    if options.path == "cameras":
        name, written = "training cameras", "their own"
    elif options.cameras is not None:
        written = "as in the file"
    camera = f"{name}, time {options.time or written}"
    size = f"{track.cameras[0].width}x{track.cameras[0].height}"
    say(f"frames      {options.count} of {size} px, {options.what}, {camera}\n")
    target, folder = options.destination(trained.path, trained.checkpoint)
    require_writable(target.parent)
    frames = render_path(
        trained.module.field,
        trained.module.renderer,
        trained.frame,
        track,
        background=trained.scene.background,
        what=options.what,
    )
    counted = tqdm(frames, "frames", options.count, leave=False, delay=2, disable=None)
    return write_video(target, counted, fps=options.rate, folder=folder)


def find_view(splits: dict[str, Views], name: str) -> tuple[Views, int]:
    """Find a view by file name, with or without extension; returns its split and its index there.

    Raises:
        ConfigError: If there is no such view; the message lists similar names.
    """
    known = {file: (v, index) for v in splits.values() for index, file in enumerate(v.files)}
    for file, found in known.items():
        if name in (file, file.rsplit(".", 1)[0]):
            return found
    near = difflib.get_close_matches(name, list(known), n=3, cutoff=0.3) or list(known)[:3]
    raise ConfigError(
        f"--path view:{name}: no such view in {' or '.join(splits)}. Views are called "
        f"{', '.join(near)}"
    )


def times(name: str, count: int) -> Tensor:
    """Time of each frame, from 0 to 1. [F]

    Raises:
        ConfigError: If ``name`` is neither ``sweep``, ``back-and-forth`` nor a number from 0 to 1.
    """
    if name == "sweep":
        return torch.linspace(0, 1, count)
    if name == "back-and-forth":
        return back_and_forth(count)
    try:
        time = float(name)
    except ValueError:
        time = math.nan
    if not 0 <= time <= 1:
        raise ConfigError(f"--time {name}: must be sweep, back-and-forth or a number from 0 to 1")
    return torch.full((count,), time)
