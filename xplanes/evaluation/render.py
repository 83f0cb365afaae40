"""Videos along a path of cameras and times: `xplanes render`."""

import difflib
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from xplanes.errors import ConfigError, require_between
from xplanes.evaluation.camera_path import CameraPath, read_camera_path
from xplanes.evaluation.runs import TrainedRun
from xplanes.files import replacing, require_empty, require_writable
from xplanes.optional import require
from xplanes.rendering.base import Renderer, leave_empty
from xplanes.rendering.pictures import colour_map, to_bytes
from xplanes.scenes.cameras import PosedCamera, orbit
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene, Views
from xplanes.training.module import RadianceModule

ELEVATION = 20.0
"""Height angle of the turning camera, in degrees."""


def orbit_poses(views: Views, frame: Frame, count: int, elevation: float = ELEVATION) -> Tensor:
    """Cameras around the scene, as far from it as the training cameras are. [count, 4, 4]"""
    distance = (views.camera_to_world[:, :3, 3] - frame.centre).norm(dim=-1).median()
    return orbit(count, radius=float(distance), elevation=elevation, target=frame.centre)


def render_path(
    field: Any,
    renderer: Renderer,
    frame: Frame,
    cameras: Iterable[PosedCamera],
    times: Tensor,
    *,
    background: Tensor,
    what: str = "colour",
    shown: Tensor | None = None,
) -> Iterator[Tensor]:
    """Render frames along a path of cameras and times, one at a time.

    Args:
        field: What the renderer takes as a field.
        renderer: Renders it.
        frame: The field's frame.
        cameras: The camera of each frame, in the world.
        times: Time of each frame, from 0 to 1. [F]
        background: Colour behind the scene. [3]
        what: ``colour``, or ``depth`` as colours whose scale is the same in all frames.
        shown: Pixels that the lens has rays for, the others stay empty; all when None. bool
            [rows, columns]

    Yields:
        Pictures. uint8 [rows, columns, 3]
    """
    for camera, time in zip(cameras, times.tolist(), strict=True):
        image = renderer.view(field, frame, camera, time, background)
        if shown is not None:
            leave_empty(image, ~shown, background)
        picture = image["colour"]
        if what == "depth":
            picture = _depth(image, float(frame.points(camera.camera_to_world[:3, 3]).norm()))
        yield to_bytes(picture)


def _depth(image: dict[str, Tensor], distance: float) -> Tensor:
    """Depth as colours, near is light; white where there is nothing. [H, W, 3]

    The scale is that of the field's cube seen from ``distance``. A scale of each frame's own would
    make a video flicker.
    """
    colours = colour_map(0.5 + 0.5 * (distance - image["depth"]))
    return torch.lerp(torch.ones_like(colours), colours, image["opacity"][..., None])


def check_video(path: Path, *, frames: int, folder: bool = False) -> None:
    """Refuse what `write_video` cannot write, before anything is rendered.

    Args:
        path: The video file, or the folder for its frames.
        frames: Number of frames.
        folder: Whether ``path`` is a folder for one PNG per frame.

    Raises:
        ConfigError: If the suffix is unknown, the folder is not empty, or an image would get
            several frames.
        ImportError: For .mp4 without the extra ``video``, naming it.
    """
    if folder:
        require_empty(path)
    elif path.suffix == ".mp4":
        require("imageio_ffmpeg", extra="video")
        require("imageio.v2", extra="video")
    elif path.suffix in IMAGES and frames > 1:
        raise ConfigError(
            f"{path} is one image, not {frames}: to write one PNG per frame, name a folder "
            f"with / at its end ({path.with_suffix('')}/)"
        )
    elif path.suffix not in (".webp", *IMAGES):
        raise ConfigError(
            f"{path}: a video must end in .webp or .mp4, an image in .png or .jpg, a folder in /"
        )


def write_video(path: Path, frames: Iterable[Tensor], *, fps: int, folder: bool = False) -> Path:
    """Write frames as a video, atomically.

    Args:
        path: Its suffix sets the format: .webp, .mp4 (extra ``video``), or .png and .jpg (one
            frame).
        frames: uint8 [H, W, 3] each.
        fps: Frames per second.
        folder: Write one PNG per frame into the folder ``path`` instead.

    Raises:
        ConfigError: For another suffix.
        ImportError: For .mp4 without the extra, naming it.
    """
    check_video(path, frames=1, folder=folder)
    if folder:
        for number, frame in enumerate(frames):
            _write_image(path / f"frame_{number:04d}.png", frame)
    elif path.suffix in IMAGES:
        _write_image(path, next(iter(frames)))
    elif path.suffix == ".mp4":
        imageio = require("imageio.v2", extra="video")
        # imageio would resize frames to multiples of 16 if it were not told otherwise.
        options = {"fps": fps, "macro_block_size": 2, "quality": 8}
        with replacing(path) as temporary, imageio.get_writer(temporary, **options) as writer:
            for frame in frames:
                height, width = (side // 2 * 2 for side in frame.shape[:2])
                writer.append_data(frame[:height, :width].numpy())
    else:
        first, *rest = [Image.fromarray(frame.numpy()) for frame in frames]
        video = {"save_all": True, "append_images": rest, "duration": round(1000 / fps), "loop": 0}
        with replacing(path) as temporary:
            first.save(temporary, format="WEBP", quality=85, method=2, **video)
    return path


def _write_image(path: Path, frame: Tensor) -> None:
    with replacing(path) as temporary:
        # The quality is that of JPEG files.
        Image.fromarray(frame.numpy()).save(temporary, format=IMAGES[path.suffix], quality=95)


IMAGES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
"""Formats of files with one frame, as Pillow calls them."""

OWN = "own"
"""The time of a view, for its camera."""

FRAMES, FPS = 48, 16
LARGEST = 8192
"""Pixels per side; WebP ends at twice as many."""


@dataclass(frozen=True)
class VideoOptions:
    """What to render.

    Attributes:
        path: Camera: ``orbit``, ``fixed`` (the first camera of the orbit), ``view:FILE``, or a
            camera path, FILE.json.
        time: ``sweep`` (from 0 to 1), ``back-and-forth``, ``own`` (that of ``view:FILE``), or a
            number from 0 to 1; None for back-and-forth, or the times of a camera path.
        frames: Number of frames; None for 48, for 1 where neither camera nor time moves, or for
            those of a camera path.
        fps: Frames per second; None for 16, or as a camera path says.
        size: Pixels of the longer side; None for those of the training views, of the view that
            ``path`` names, or as a camera path says. Frames of an orbit or a fixed camera are
            square.
        elevation: Height angle of orbit and fixed camera, in degrees.
        what: ``colour`` or ``depth``.
    """

    path: str = "orbit"
    time: str | None = None
    frames: int | None = None
    fps: int | None = None
    size: int | None = None
    elevation: float = ELEVATION
    what: str = "colour"

    def written_to(self, out: str | None) -> "VideoOptions":
        """These options where the frames go to ``out``: an image of a view shows its own time."""
        one = self.frames in (None, 1) and self.path.startswith("view:") and self.time is None
        image = out is not None and Path(out).suffix in IMAGES and not Path(out).is_dir()
        return replace(self, time=OWN) if one and image else self

    @cached_property
    def cameras(self) -> CameraPath | None:
        """The camera path that is named, read from its file; None where none is.

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
        frozen = self.path != "orbit" and self.time not in (None, "sweep", "back-and-forth")
        return 1 if frozen else FRAMES

    @property
    def rate(self) -> int:
        """Frames per second."""
        written = None if self.cameras is None else self.cameras.fps
        return self.fps or written or FPS

    @property
    def times(self) -> Tensor:
        """Time of each frame, from 0 to 1. [F]

        Raises:
            ConfigError: As `times`, and for ``own``, which only a scene can tell.
        """
        if self.cameras is not None and self.time is None:
            return self.cameras.times
        return times(self.time or "back-and-forth", self.count)

    def shape(self, splits: dict[str, Views]) -> tuple[int, int]:
        """Rows and columns of a frame of a scene with these splits.

        Raises:
            ConfigError: As `find_view`.
        """
        height = width = max(splits["train"].height, splits["train"].width)
        if (found := self.view(splits)) is not None:
            views, index = found
            height, width = views.size(index)
        elif self.cameras is not None:
            height = self.cameras.height or self.cameras.width or height
            width = self.cameras.width or height
        scale = 1 if self.size is None else self.size / max(height, width)
        return max(1, round(height * scale)), max(1, round(width * scale))

    def view(self, splits: dict[str, Views]) -> tuple[Views, int] | None:
        """The view that is named, as `find_view` gives it; None where none is."""
        name = self.path.removeprefix("view:")
        return None if name == self.path else find_view(splits, name)

    def check(self) -> None:
        """Refuse options that cannot be rendered.

        Raises:
            ConfigError: With the option, its value and what is allowed.
            SceneError: If a camera path cannot be used.
        """
        views = self.path.startswith("view:")
        if self.time != OWN:
            times(self.time or "back-and-forth", 1)
        elif not views:
            raise ConfigError(f"--time {OWN}: only the camera of a view has one, --path view:FILE")
        if self.path not in ("orbit", "fixed") and not views and self.cameras is None:
            raise ConfigError(
                f"--path {self.path}: must be orbit, fixed, view:FILE or a camera path, FILE.json"
            )
        if self.cameras is not None and self.frames is not None:
            raise ConfigError(
                f"--frames {self.frames}: {self.path} has {self.count} cameras, and each of them "
                "is one frame; leave --frames out"
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


def render_video(trained: TrainedRun, options: VideoOptions, out: str | None = None) -> Path:
    """Render and write a video.

    Args:
        trained: The run.
        options: What to render.
        out: A file (.webp, .mp4, .png, .jpg), or a folder if it ends in /; by default a file in the
            run's media/ that is named after the paths.

    Returns:
        The file or folder that was written.

    Raises:
        ConfigError: If options are out of range or contradict one another.
        ImportError: For .mp4 without the extra ``video``.
    """
    options = options.written_to(out)
    options.check()
    check_out(out, options)
    target, folder = destination(trained.path, options, out, trained.checkpoint)
    require_writable(target.parent)
    if options.time == OWN and (found := options.view(trained.scene.splits)) is not None:
        views, index = found
        options = replace(options, time=str(float(views.times[index])))
    frames = _frames(trained.module, trained.scene, options)
    counted = tqdm(frames, "frames", options.count, leave=False, delay=2, disable=None)
    return write_video(target, counted, fps=options.rate, folder=folder)


def _frames(module: RadianceModule, scene: Scene, options: VideoOptions) -> Iterator[Tensor]:
    frame, splits = module.frame, scene.splits
    assert frame is not None
    path = cameras(options, splits, frame), options.times
    shown = pixels_with_rays(options, splits)
    how: Any = {"background": scene.background, "what": options.what, "shown": shown}
    return render_path(module.field, module.renderer, frame, *path, **how)


def check_out(out: str | None, options: VideoOptions) -> None:
    """Refuse an ``--out`` that could not be written, before the run is loaded.

    Raises:
        ConfigError: As `xplanes.evaluation.render.check_video`.
        ImportError: For .mp4 without the extra ``video``.
    """
    options = options.written_to(out)
    target, folder = destination(Path(), options, out, "last")
    check_video(target, frames=options.count, folder=folder)


def destination(
    run: Path, options: VideoOptions, out: str | None, checkpoint: str
) -> tuple[Path, bool]:
    """The file or folder to write, and whether it is a folder."""
    if out is not None:
        return Path(out), out.endswith("/") or Path(out).is_dir()
    if options.cameras is not None:
        parts = ["render", Path(options.path).stem, *([options.time] if options.time else [])]
    else:
        camera = options.path.replace(":", "_").replace("/", "_").removesuffix(".png")
        parts = ["render", camera, options.time or "back-and-forth"]
    parts += [part for part in (options.what, checkpoint) if part not in ("colour", "last")]
    ending = ".png" if options.count == 1 else ".webp"
    return run / "media" / ("_".join(parts) + ending), False


def cameras(options: VideoOptions, splits: dict[str, Views], frame: Frame) -> list[PosedCamera]:
    """The camera of each frame.

    That of a view shows exactly what the view shows; the others show as much as the training views.
    """
    rows, columns = options.shape(splits)
    if (path := options.cameras) is not None:
        focal = path.focal(rows, columns).tolist()
        return [PosedCamera(p, f, rows, columns) for p, f in zip(path.poses, focal, strict=True)]
    if (found := options.view(splits)) is not None:
        views, index = found
        own, intrinsics = views.camera(index), views.intrinsics
        scale = torch.tensor([columns / own.width, rows / own.height])
        lens = None if own.lens is None else replace(own.lens, skew=own.lens.skew * scale[0])
        focal, centre = intrinsics.focal[index] * scale, intrinsics.centre[index] * scale
        camera = PosedCamera(own.camera_to_world, focal, rows, columns, centre, lens)
        return [camera] * options.count
    views, count = splits["train"], options.count
    poses = orbit_poses(views, frame, count if options.path == "orbit" else 1, options.elevation)
    focal = views.intrinsics.focal_at(max(rows, columns))
    return [PosedCamera(pose, focal, rows, columns) for pose in poses.expand(count, 4, 4)]


def pixels_with_rays(options: VideoOptions, splits: dict[str, Views]) -> Tensor | None:
    """Pixels of a frame that its lens has rays for; None for all. bool [rows, columns]"""
    if (found := options.view(splits)) is None:
        return None
    views, index = found
    if (known := views.intrinsics.has_ray(index)) is None:
        return None
    size = options.shape(splits)
    return F.interpolate(known[None, None].float(), size, mode="nearest-exact")[0, 0] > 0


def find_view(splits: dict[str, Views], name: str) -> tuple[Views, int]:
    """The view whose file is called ``name``, with or without ending: its split and its number.

    Raises:
        ConfigError: If there is none, with similar names.
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
    if name == "back-and-forth":  # So that a looped video has no jump.
        return 1 - (2 * torch.arange(count) / max(count, 1) - 1).abs()
    try:
        time = float(name)
    except ValueError:
        time = math.nan
    if not 0 <= time <= 1:
        raise ConfigError(f"--time {name}: must be sweep, back-and-forth or a number from 0 to 1")
    return torch.full((count,), time)


VIDEO_SIZE = 200
"""Pixels of the longer side of a run's own video."""


def write_orbit(module: RadianceModule, scene: Scene, run: Path) -> Path:
    """Write media/orbit.webp: one camera orbit while time runs from 0 to 1 and back."""
    views = scene.splits["train"]
    options = VideoOptions(frames=FRAMES, size=min(VIDEO_SIZE, max(views.height, views.width)))
    frames = _frames(module, scene, options)
    return write_video(run / "media" / "orbit.webp", frames, fps=options.rate)
