"""Videos along a path of cameras and times."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
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

if TYPE_CHECKING:
    from xplanes.training.module import RadianceModule

ELEVATION = 20.0  # Elevation of the orbiting camera, in degrees.


def orbit_poses(views: Views, frame: Frame, count: int, elevation: float = ELEVATION) -> Tensor:
    """Poses on an orbit around the scene, at the training cameras' distance. [count, 4, 4]"""
    distance = (views.camera_to_world[:, :3, 3] - frame.centre).norm(dim=-1).median()
    return orbit(count, radius=float(distance), elevation=elevation, target=frame.centre)


@dataclass(frozen=True)
class Track:
    """Cameras and times of a video.

    Attributes:
        cameras: The camera of each frame, in the world.
        times: Time of each frame, from 0 to 1. [F]
        shown: For each frame the pixels that have a ray through the lens, all if None; the others
            are left empty. None for cameras that are no views. bool [rows, columns] each
    """

    cameras: list[PosedCamera]
    times: Tensor
    shown: list[Tensor | None] | None = None

    @classmethod
    def orbit(
        cls,
        views: Views,
        frame: Frame,
        times: Tensor,
        size: tuple[int, int],
        elevation: float = ELEVATION,
        *,
        fixed: bool = False,
    ) -> "Track":
        """An orbit with the views' field of view, or its first camera; size: rows and columns."""
        poses = orbit_poses(views, frame, 1 if fixed else len(times), elevation)
        focal = views.intrinsics.focal_at(max(size))
        return cls([PosedCamera(p, focal, *size) for p in poses.expand(len(times), 4, 4)], times)

    @classmethod
    def of_views(
        cls, views: Views, indices: list[int], times: Tensor, size: tuple[int, int]
    ) -> "Track":
        """Cameras of views, which keep distortion and principal point, at another size."""
        known = {index: pixels_with_rays(views, index, *size) for index in set(indices)}
        cameras = [views.camera(index).resized(*size) for index in indices]
        return cls(cameras, times, [known[index] for index in indices])


def render_path(
    field: Any,
    renderer: Renderer,
    frame: Frame,
    track: Track,
    *,
    background: Tensor,
    what: str = "colour",
) -> Iterator[Tensor]:
    """Render the frames of a video, one at a time.

    Args:
        field: A field that the renderer accepts.
        renderer: The renderer.
        frame: The field's frame.
        track: Cameras and times.
        background: Colour behind the scene. [3]
        what: ``colour``, or ``depth`` as colours on the same scale in all frames.

    Yields:
        Pictures. uint8 [rows, columns, 3]
    """
    masks = track.shown or [None] * len(track.cameras)
    for camera, time, mask in zip(track.cameras, track.times.tolist(), masks, strict=True):
        image = renderer.view(field, frame, camera, time, background)
        if mask is not None:
            leave_empty(image, ~mask, background)
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
            f"{path} is a single image, but there are {frames} frames: to write one PNG per frame, "
            f"name a folder with / at its end ({path.with_suffix('')}/)"
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
        # Whole milliseconds, which add up to the duration of all frames.
        ends = [round(1000 * number / fps) for number in range(len(rest) + 2)]
        durations = [end - start for start, end in pairwise(ends)]
        video = {"save_all": True, "append_images": rest, "duration": durations, "loop": 0}
        with replacing(path) as temporary:
            first.save(temporary, format="WEBP", quality=85, method=2, **video)
    return path


def _write_image(path: Path, frame: Tensor) -> None:
    with replacing(path) as temporary:
        # Only JPEG files have a quality.
        Image.fromarray(frame.numpy()).save(temporary, format=IMAGES[path.suffix], quality=95)


IMAGES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
"""Pillow's names of the formats for single frames."""

FRAMES, FPS = 48, 16  # Number of frames of a run's video, and frames per second.
VIDEO_SIZE = 200  # Maximum side length in pixels of a run's video.
SHOWN = 0.5  # Share of the timesteps that a camera must show for a video to stay with it.
FEW_CAMERAS = 4  # Largest number of calibrations for which each is assumed to be a separate camera.


def training_path(views: Views, count: int) -> tuple[list[int], Tensor]:
    """Cameras of a video at training views, and the time of each frame.

    If a fixed camera shows most timesteps, the video stays with it while time runs from 0 to 1.
    Otherwise it follows the views of one moving camera in temporal order, with the nearest view of
    each timestep.

    Args:
        views: Training views.
        count: Number of frames; views repeat if there are fewer.

    Returns:
        Index of the view whose camera takes each frame, and its time from 0 to 1. [F]
    """
    poses, place = views.camera_to_world.flatten(1).unique(dim=0, return_inverse=True)
    timesteps = len(views.times.unique())
    shown = [len(views.times[place == pose].unique()) for pose in range(len(poses))]
    if not views.is_static and max(shown) >= max(2, SHOWN * timesteps):
        index = int((place == shown.index(max(shown))).nonzero()[0])
        return [index] * count, torch.linspace(0, 1, count)
    order = _one_camera(views)
    order = order[views.times[order].argsort(stable=True)]
    if not views.is_static:
        order = _nearest_of_each_timestep(views, order)
    chosen = order[torch.linspace(0, len(order) - 1, count).round().long()]
    return chosen.tolist(), views.times[chosen]


def _one_camera(views: Views) -> Tensor:
    """Views of the most common image size, and calibration if there are few. int64 [N]"""
    known = views.intrinsics
    sizes = known.size.unique(dim=0, return_inverse=True)[1]
    kept = (sizes == sizes.mode().values).nonzero()[:, 0]
    numbers = torch.cat([known.focal, known.centre], dim=1)[kept]
    different, cameras = numbers.unique(dim=0, return_inverse=True)
    return kept[cameras == cameras.mode().values] if len(different) <= FEW_CAMERAS else kept


def _nearest_of_each_timestep(views: Views, order: Tensor) -> Tensor:
    """One view of each timestep, the nearest to the one before. int64 [N] -> [T]"""
    positions, found = views.camera_to_world[:, :3, 3], order[:1]
    for same in order.split(views.times[order].unique_consecutive(return_counts=True)[1].tolist()):
        distances = (positions[same] - positions[found[-1]]).norm(dim=1)
        found = torch.cat([found, same[distances.argmin()][None]])
    return found[1:]


def pixels_with_rays(views: Views, index: int, height: int, width: int) -> Tensor | None:
    """Pixels of an image of another size for which a view's lens has rays; None for all.

    Returns:
        bool [height, width]
    """
    if (known := views.intrinsics.has_ray(index)) is None:
        return None
    size = height, width
    return F.interpolate(known[None, None].float(), size, mode="nearest-exact")[0, 0] > 0


def fitting(height: int, width: int, longest: int) -> tuple[int, int]:
    """Rows and columns of an image whose longer side is changed to ``longest`` pixels."""
    scale = longest / max(height, width)
    return max(1, round(height * scale)), max(1, round(width * scale))


def run_track(scene: Scene, frame: Frame) -> Track:
    """A run's video: an orbit of an object; with surroundings, a `training_path`."""
    views = scene.splits["train"]
    size = min(VIDEO_SIZE, 2 * max(views.height, views.width))
    if not scene.is_surrounded:
        return Track.orbit(views, frame, back_and_forth(FRAMES), (size, size))
    path, times = training_path(views, min(FRAMES // 2, len(views)))
    return Track.of_views(views, path, times, fitting(*views.size(path[0]), size))


def back_and_forth(count: int) -> Tensor:
    """Times from 0 to 1 and back, so that a looped video has no jump. [count]"""
    return 1 - (2 * torch.arange(count) / max(count, 1) - 1).abs()


def write_run_video(module: "RadianceModule", scene: Scene, run: Path) -> Path:
    """Write media/video.webp: a `run_track`, which goes back to its start if it is no orbit."""
    assert module.frame is not None
    track = run_track(module.corrected_scene(scene), module.frame)
    parts = module.field, module.renderer, module.frame, track
    frames = list(render_path(*parts, background=scene.background))
    if track.shown is not None:
        frames += frames[-2:0:-1]
    return write_video(run / "media" / "video.webp", frames, fps=FPS)
