"""Triplanes from images, and a turntable video of them: `xplanes triplanes`."""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from xplanes.errors import ConfigError, SceneError
from xplanes.evaluation.render import render_path, write_video
from xplanes.experiment import Experiment
from xplanes.fields import XPlanes
from xplanes.fields.xplanes import SPACE_PLANES
from xplanes.files import natural
from xplanes.lrm.model import LRM
from xplanes.preparation.cache import StageCache
from xplanes.preparation.encode import encode
from xplanes.preparation.reconstruct import ImageLRMSettings, picture_crop
from xplanes.preparation.sequence import TriplaneSequence, save_triplanes
from xplanes.rendering.grid_renderer import DIAGONAL, GridRenderer
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.scenes.cameras import PosedCamera, camera_around
from xplanes.scenes.formats import ENDINGS, is_image
from xplanes.scenes.frame import cube_frame
from xplanes.scenes.images import load_images
from xplanes.streams import Stream, step_generator

FRAMES, FPS, SIDE = 48, 16, 224
SAMPLES, CELLS = 192, 64


def write_triplanes(
    paths: Sequence[Path], out: Path, experiment: Experiment, *, say: Callable[[str], None]
) -> Path:
    """Encode images into triplanes; write these and a turntable video.

    Args:
        paths: Images, or folders of them.
        out: File to write, .safetensors or .pt; the video gets the same name and .webp.
        experiment: Settings; the LRM's, the cache and the device are used.
        say: Receives progress messages.

    Returns:
        The video file.

    Raises:
        ConfigError, LRMError, SceneError: If a setting, the weights or a picture cannot be used.
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
    """Image files; a folder stands for all images in it, by the numbers in their names.

    Raises:
        SceneError: If one is missing, or there are none.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(filter(is_image, path.iterdir()), key=lambda p: natural(p.name))
            if not inside:
                raise SceneError(f"{path} holds no pictures ({', '.join(ENDINGS)})")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise SceneError(f"{path}: there is no such picture or folder")
    if not found:
        raise SceneError("name at least one picture, or a folder of them")
    return found


def turntable(triplanes: Tensor, model: LRM, device: torch.device) -> Iterator[Tensor]:
    """Frames of one camera orbit that begins at the model's canonical camera.

    Args:
        triplanes: One or more, shown one after another. [T, 3, C, H, H]
        model: The model that produced them.
        device: Where to render.

    Yields:
        Images on white. uint8 [SIDE, SIDE, 3]
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
        path, white = (cameras, torch.zeros(len(cameras))), torch.ones(3)
        renderer = GridRenderer(grid, SAMPLES)
        yield from render_path(field, renderer, frame, *path, background=white)
