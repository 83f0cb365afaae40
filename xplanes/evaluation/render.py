"""Videos along a path of cameras and times."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from xplanes.errors import ConfigError
from xplanes.files import replacing, require_empty
from xplanes.optional import require
from xplanes.rendering.base import Renderer, leave_empty
from xplanes.rendering.pictures import colour_map, to_bytes
from xplanes.scenes.cameras import PosedCamera, orbit
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene, Views
from xplanes.training.module import RadianceModule

ELEVATION = 20.0
"""Elevation of the orbiting camera, in degrees."""


def orbit_poses(views: Views, frame: Frame, count: int, elevation: float = ELEVATION) -> Tensor:
    """Poses on an orbit around the scene, at the training cameras' distance. [count, 4, 4]"""
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
        field: A field that the renderer accepts.
        renderer: The renderer.
        frame: The field's frame.
        cameras: The camera of each frame, in the world.
        times: Time of each frame, from 0 to 1. [F]
        background: Colour behind the scene. [3]
        what: ``colour``, or ``depth`` as colours on the same scale in all frames.
        shown: Mask of pixels that have a ray through the lens; the others are left empty. All
            when None. bool [rows, columns]

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
    """Depth as colours: near is light, empty is white. [H, W, 3]

    The scale is that of the field's cube seen from ``distance``. A separate scale for each frame
    would make a video flicker.
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
        ConfigError: If the suffix is unknown, the folder is not empty, or ``path`` is one image
            for several frames.
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
        # By default imageio resizes frames to multiples of 16.
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
        # Only JPEG files have a quality.
        Image.fromarray(frame.numpy()).save(temporary, format=IMAGES[path.suffix], quality=95)


IMAGES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
"""Pillow's names of the formats for single frames."""

FRAMES, FPS = 48, 16
"""Number of frames of a run's video, and frames per second."""

VIDEO_SIZE = 200
"""Maximum side length in pixels of a run's video."""


def video_size(views: Views) -> int:
    """Side length in pixels of a run's video, at most twice that of its training views."""
    return min(VIDEO_SIZE, 2 * max(views.height, views.width))


def back_and_forth(count: int) -> Tensor:
    """Times from 0 to 1 and back, so that a looped video has no jump. [count]"""
    return 1 - (2 * torch.arange(count) / max(count, 1) - 1).abs()


def write_orbit(module: RadianceModule, scene: Scene, run: Path) -> Path:
    """Write media/orbit.webp: one camera orbit while time runs from 0 to 1 and back."""
    views, frame = scene.splits["train"], module.frame
    assert frame is not None
    size = video_size(views)
    focal = views.intrinsics.focal_at(size)
    cameras = [PosedCamera(p, focal, size, size) for p in orbit_poses(views, frame, FRAMES)]
    path = cameras, back_and_forth(FRAMES)
    frames = render_path(module.field, module.renderer, frame, *path, background=scene.background)
    return write_video(run / "media" / "orbit.webp", frames, fps=FPS)
