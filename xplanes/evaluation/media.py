"""Films of a trained scene: frames along a path, and the files they go to."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from xplanes.config import ConfigError
from xplanes.files import replacing
from xplanes.optional import require
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.box import Field
from xplanes.rendering.pictures import colour_map, to_bytes
from xplanes.scenes.cameras import orbit
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views, camera_rays

ELEVATION = 20.0
"""Height angle of the turning camera, in degrees."""


def orbit_poses(views: Views, frame: Frame, count: int, elevation: float = ELEVATION) -> Tensor:
    """Cameras around the scene, as far from it as the training cameras are. [count, 4, 4]"""
    distance = (views.camera_to_world[:, :3, 3] - frame.centre).norm(dim=-1).median()
    return orbit(count, radius=float(distance), elevation=elevation, target=frame.centre)


def film_times(frames: int) -> Tensor:
    """Times that run forth and back once, so that a repeated film does not jump. [frames]"""
    phase = torch.arange(frames) / max(frames, 1)
    return 1 - (2 * phase - 1).abs()


def render_path(
    field: Field,
    renderer: RayRenderer,
    frame: Frame,
    poses: Tensor,
    times: Tensor,
    *,
    focal: float,
    size: int,
    background: Tensor,
    what: str = "colour",
) -> Iterator[Tensor]:
    """Render square frames along a path of cameras and times, one at a time.

    Args:
        field: The field.
        renderer: Renders it.
        frame: The field's frame.
        poses: Camera-to-world matrices. [F, 4, 4]
        times: Time of each frame, from 0 to 1. [F]
        focal: Focal length in pixels of these frames.
        size: Pixels per side.
        background: Colour behind the scene. [3]
        what: ``colour``, or ``depth`` as colours whose scale is the same in all frames.

    Yields:
        Pictures. uint8 [size, size, 3]
    """
    device = renderer.device
    for pose, time in zip(poses, times.tolist(), strict=True):
        origins, directions = frame.rays(*camera_rays(pose, focal, size, size))
        rays = origins.to(device), directions.to(device)
        image = renderer.image(field, *rays, time, background.to(device))
        picture = image["colour"]
        if what == "depth":
            picture = _depth(image, float(origins[0].norm()))
        yield to_bytes(picture.view(size, size, 3))


def _depth(image: dict[str, Tensor], distance: float) -> Tensor:
    """Depth as colours, near is light; white where there is nothing. [R, 3]

    The scale is the field's cube as seen from ``distance``, not what a frame happens to show: a
    film would flicker.
    """
    colours = colour_map(0.5 + 0.5 * (distance - image["depth"]))
    return torch.lerp(torch.ones_like(colours), colours, image["opacity"][:, None])


def check_film(path: Path, *, frames: int, folder: bool = False) -> None:
    """Refuse what `write_film` could not write, before anything is rendered.

    Args:
        path: Where the film is to go.
        frames: Number of frames.
        folder: Whether ``path`` is a folder for one PNG per frame.

    Raises:
        ConfigError: If the ending stands for no format, or files would be mixed.
        ImportError: For .mp4 without the extra ``video``, naming it.
    """
    if folder:
        if path.is_dir() and any(path.iterdir()):
            raise ConfigError(f"{path} holds files already: empty it, or name another folder")
    elif path.suffix == ".mp4":
        require("imageio_ffmpeg", extra="video")
        require("imageio.v2", extra="video")
    elif path.suffix == ".png" and frames > 1:
        raise ConfigError(
            f"{path} holds one picture, not {frames}: a folder takes one PNG per frame if its name "
            f"ends in / ({path.with_suffix('')}/)"
        )
    elif path.suffix not in (".webp", ".png"):
        raise ConfigError(f"{path}: films end in .webp or .mp4, pictures in .png, folders in /")


def write_film(path: Path, frames: Iterable[Tensor], *, fps: int, folder: bool = False) -> Path:
    """Write frames as a film, whole or not at all.

    Args:
        path: Its ending decides: .webp needs nothing more, .mp4 the extra ``video``, .png takes one
            frame.
        frames: uint8 [H, W, 3] each.
        fps: Frames per second.
        folder: Write one PNG per frame into the folder ``path`` instead.

    Raises:
        ConfigError: For another ending.
        ImportError: For .mp4 without the extra, naming it.
    """
    check_film(path, frames=1, folder=folder)
    if folder:
        for number, frame in enumerate(frames):
            _write_png(path / f"frame_{number:04d}.png", frame)
    elif path.suffix == ".mp4":
        _write_mp4(path, frames, fps)
    elif path.suffix == ".png":
        _write_png(path, next(iter(frames)))
    else:
        _write_webp(path, frames, fps)
    return path


def _write_png(path: Path, frame: Tensor) -> None:
    with replacing(path) as temporary:
        Image.fromarray(frame.numpy()).save(temporary, format="PNG")


def _write_webp(path: Path, frames: Iterable[Tensor], fps: int) -> None:
    first, *rest = [Image.fromarray(frame.numpy()) for frame in frames]
    with replacing(path) as temporary:
        first.save(
            temporary,
            format="WEBP",
            save_all=True,
            append_images=rest,
            duration=round(1000 / fps),
            loop=0,
            quality=85,
            method=2,
        )


def _write_mp4(path: Path, frames: Iterable[Tensor], fps: int) -> None:
    imageio = require("imageio.v2", extra="video")
    # imageio would resize frames to multiples of 16 if it were not told otherwise.
    options = {"fps": fps, "macro_block_size": 2, "quality": 8}
    with replacing(path) as temporary, imageio.get_writer(temporary, **options) as writer:
        for frame in frames:
            height, width = (side // 2 * 2 for side in frame.shape[:2])
            writer.append_data(frame[:height, :width].numpy())
