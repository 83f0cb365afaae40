"""Triplanes from images, and a turntable video of them: `xplanes triplanes`."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from xplanes.errors import ConfigError, SceneError
from xplanes.evaluation.render import Track, render_path, write_video
from xplanes.experiment import Experiment
from xplanes.fields import XPlanes
from xplanes.fields.xplanes import SPACE_PLANES
from xplanes.files import natural
from xplanes.lrm.model import LRM
from xplanes.preparation.cache import StageCache
from xplanes.preparation.encode import encode
from xplanes.preparation.reconstruct import ImageLRMSettings, picture_crop
from xplanes.preparation.sequence import TriplaneSequence, save_triplanes
from xplanes.process import say
from xplanes.readers.formats import ENDINGS, is_image
from xplanes.readers.images import load_images
from xplanes.rendering.grid_renderer import DIAGONAL, GridRenderer
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.scenes.cameras import PosedCamera, camera_around
from xplanes.scenes.frame import cube_frame
from xplanes.streams import Stream, step_generator

FRAMES, FPS, SIDE = 48, 16, 224  # Of the video; pixels per side.
SAMPLES, CELLS = 192, 64  # Steps along the diagonal; cells of the grid per side.


def write_triplanes(paths: Sequence[Path], out: Path, experiment: Experiment) -> Path:
    """Encode images into triplanes; write them and a turntable video.

    Args:
        paths: Images, or folders of them.
        out: File to write, .safetensors or .pt; the video has the same name with .webp.
        experiment: Settings of the LRM, the cache and the device; others are ignored.

    Returns:
        The video file.

    Raises:
        ConfigError, LRMError, SceneError: If a setting, the weights or an image cannot be used.
    """
    pictures = find_pictures(paths)
    if out.suffix not in (".safetensors", ".pt"):
        raise ConfigError(f"out={out}: must end in .safetensors or .pt")
    options = experiment.method.lrm
    if not isinstance(options, ImageLRMSettings):
        raise ConfigError(
            f"lrm={options.name} does not encode images: choose a model, such as lrm=small"
        )
    lrm = options.load_model(say)
    frames = load_images(pictures, None)
    if bool((frames[..., 3] == 255).all()):
        say(
            "the images have no transparency: the model will reconstruct the background as part of "
            "the object"
        )
    folder = experiment.method.preparation.cache
    device = experiment.device
    encoded = encode(
        lrm.model,
        lrm.key,
        frames,
        picture_crop(frames, crop=options.crop),
        StageCache(None if folder is None else Path(folder)),
        device,
        batch=options.batch,
        bf16=options.bf16_on(device),
    )
    decoder = lrm.model.field_decoder()
    sequence = TriplaneSequence(encoded.triplanes, decoder.state_dict(), decoder.options)
    save_triplanes(out, sequence)
    count, _, channels, size = encoded.triplanes.shape[:4]
    say(
        f"wrote {out}: {count} triplanes of {size} x {size} texels and {channels} channels, "
        f"{encoded.seconds / encoded.distinct:.2f} s each"
    )
    video = out.with_suffix(".webp")
    write_video(video, turntable(encoded.triplanes, lrm.model, device), fps=FPS)
    say(f"wrote {video}")
    return video


def find_pictures(paths: Sequence[Path]) -> list[Path]:
    """Image files; for a folder, all its images in natural order of their names.

    Raises:
        SceneError: If a path is missing, or there are no images.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(filter(is_image, path.iterdir()), key=lambda p: natural(p.name))
            if not inside:
                raise SceneError(f"{path} contains no images ({', '.join(ENDINGS)})")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise SceneError(f"{path}: there is no such image or folder")
    if not found:
        raise SceneError("name at least one image, or a folder of images")
    return found


def turntable(triplanes: Tensor, model: LRM, device: torch.device) -> Iterator[Tensor]:
    """Frames of a camera orbit that begins at the model's canonical camera.

    Args:
        triplanes: One or more triplanes, shown one after another. [T, 3, C, H, H]
        model: The LRM that produced them.
        device: Device to render on.

    Yields:
        Images with a white background. uint8 [SIDE, SIDE, 3]
    """
    view = model.view
    frame = cube_frame(view.half_side, torch.zeros(3))
    decoder = model.field_decoder().requires_grad_(False)
    x, y = view.camera_to_world()[:2, 3].tolist()
    numbers = torch.arange(FRAMES)
    for index, triplane in enumerate(triplanes):
        shown = numbers[numbers * len(triplanes) // FRAMES == index].tolist()
        if not shown:
            continue
        planes: dict[str, Tensor] = dict(zip(SPACE_PLANES, triplane, strict=True))
        field = XPlanes(planes=planes, decoder=decoder, plane_set="three").to(device)
        grid = OccupancyGrid(CELLS, 1, step=DIAGONAL / SAMPLES).to(device)
        with torch.no_grad():
            grid.sweep(field, step_generator(0, index, Stream.TURNTABLE))
        cameras = []
        for number in shown:
            azimuth = math.degrees(math.atan2(y, x)) + 360 * number / FRAMES
            pose = camera_around(azimuth, 0.0, view.distance).float()
            cameras.append(PosedCamera(pose, view.focal * SIDE, SIDE, SIDE))
        track, white = Track(cameras, torch.zeros(len(cameras))), torch.ones(3)
        yield from render_path(field, GridRenderer(grid, SAMPLES), frame, track, background=white)
