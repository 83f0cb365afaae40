"""Films of a trained scene."""

from collections.abc import Iterable
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from xplanes.files import replacing
from xplanes.optional import require
from xplanes.rendering.box import Field
from xplanes.rendering.pictures import to_bytes
from xplanes.rendering.renderer import Renderer
from xplanes.scenes.cameras import orbit
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views, camera_rays

ELEVATION = 20.0
"""Height angle of the turning camera, in degrees."""


def orbit_poses(views: Views, frame: Frame, count: int) -> Tensor:
    """Cameras around the scene, as far from it as the training cameras are. [count, 4, 4]"""
    distance = (views.camera_to_world[:, :3, 3] - frame.centre).norm(dim=-1).median()
    return orbit(count, radius=float(distance), elevation=ELEVATION, target=frame.centre)


def render_path(
    field: Field,
    renderer: Renderer,
    frame: Frame,
    poses: Tensor,
    times: Tensor,
    *,
    focal: float,
    size: int,
    background: Tensor,
) -> Iterable[Tensor]:
    """Render square frames along a path of cameras and times, one at a time. uint8 [size, size, 3]"""
    device = renderer.grid.density.device
    for pose, time in zip(poses, times.tolist(), strict=True):
        rays = frame.rays(*camera_rays(pose, focal, size, size))
        image = renderer.image(
            field, *(ray.to(device) for ray in rays), time, background.to(device)
        )
        yield to_bytes(image["colour"].view(size, size, 3))


def write_film(path: Path, frames: Iterable[Tensor], *, fps: int) -> Path:
    """Write frames as a film.

    Args:
        path: Its ending decides: .webp needs nothing more, .mp4 the extra ``video``.
        frames: uint8 [H, W, 3] each.
        fps: Frames per second.

    Raises:
        ImportError: For .mp4 without the extra, naming it.
        ValueError: For another ending.
    """
    images = [frame.cpu().numpy() for frame in frames]
    if path.suffix == ".webp":
        first, *rest = [Image.fromarray(image) for image in images]
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
    elif path.suffix == ".mp4":
        imageio = require("imageio.v2", extra="video")
        even = [image[: len(image) // 2 * 2, : image.shape[1] // 2 * 2] for image in images]
        with replacing(path) as temporary:
            # imageio would resize frames to multiples of 16 if it were not told otherwise.
            imageio.mimwrite(temporary, even, fps=fps, macro_block_size=2, quality=8)
    else:
        raise ValueError(f"{path}: films end in .webp or .mp4")
    return path


def film_times(frames: int, turns: float = 1.0) -> Tensor:
    """Times that run forth and back once, so that a repeated film does not jump. [frames]"""
    phase = torch.arange(frames) * (turns / max(frames, 1))
    return 1 - (2 * (phase % 1) - 1).abs()
