"""The fixed-view video: one camera, all moments.

A scene may bring it. Otherwise a field is trained on the scene for a short time and rendered from
where the Large Reconstruction Model expects its camera to stand.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xplanes.checks import parse
from xplanes.config import TrainConfig, compose_plain
from xplanes.lrm.canonical import CanonicalView
from xplanes.preparation.cache import StageCache
from xplanes.scenes.cameras import camera_around
from xplanes.scenes.datamodule import RayDataModule
from xplanes.scenes.errors import SceneError
from xplanes.scenes.frame import Frame, frame_content
from xplanes.scenes.views import Scene, Views, camera_rays
from xplanes.schemas.samplers import SamplerConfig
from xplanes.training.builder import build_batches, build_frame, build_module
from xplanes.training.fit import fit
from xplanes.training.module import RadianceModule

CHECKPOINT_EVERY = 250
"""Steps between checkpoints of that field."""


def filming_settings(config: TrainConfig) -> TrainConfig:
    """How the field that films is trained: by its model's defaults, on the run's scene and device.

    The run's own model would make ablations of it differ in their video too. Where training and
    pictures may be sampled at different densities, training's does: a model looks at few pixels.

    Raises:
        ConfigError: If there is no such model.
    """
    options, own = config.preparation, config.trainer
    film = parse(compose_plain("train", [f"model={options.fixed_view_model}", "lrm=none"]))
    sampler = film.sampler
    if isinstance(sampler, SamplerConfig):
        sampler = replace(sampler, render_samples=sampler.samples)
    return replace(
        film,
        seed=config.seed,
        sampler=sampler,
        data=replace(
            config.data,
            skip_background=film.data.skip_background,
            background_share=film.data.background_share,
            background_jitter=film.data.background_jitter,
        ),
        trainer=replace(
            film.trainer,
            accelerator=own.accelerator,
            precision=own.precision,
            deterministic=own.deterministic,
            max_seconds=options.fixed_view_seconds,
            max_steps=options.fixed_view_steps,
            checkpoint_every=CHECKPOINT_EVERY,
            evaluate_at=[],
            media=False,
        ),
    )


@dataclass(frozen=True)
class FixedView:
    """The video.

    Attributes:
        views: Frames of one camera at moments that fill [0, 1] evenly; one where nothing moves.
        target: World point in the middle of the scene. [3]
        seconds: Time that it took to make.
        words: Where it comes from, in a few words.
    """

    views: Views
    target: Tensor
    seconds: float
    words: str


def fixed_view(
    config: TrainConfig,
    scene: Scene,
    frame: Frame,
    view: CanonicalView,
    size: int,
    cache: StageCache,
    *,
    say: Callable[[str], None],
) -> FixedView:
    """The scene's own video, or one that a field renders.

    Args:
        config: The run's settings.
        scene: The scene.
        frame: The scene's frame.
        view: The camera that the model believes in; a rendered video is taken by it.
        size: Pixels per side that the model looks at; more are not rendered.
        cache: Where a rendered video is kept.
        say: Takes a line before something slow begins.

    Raises:
        SceneError: If the scene's video is asked for and there is none, or it leaves out moments.
    """
    options = config.preparation
    if options.fixed_view == "video" and scene.video is None:
        raise SceneError(
            f"preparation.fixed_view=video: {scene.name} has no video of a fixed camera "
            "(transforms_video.json); set preparation.fixed_view=train"
        )
    times = scene.splits["train"].times
    count = 1 if scene.splits["train"].is_still else options.frames
    if scene.video is not None and options.fixed_view != "train":
        views = pick_frames(scene.video, torch.linspace(0, 1, count) if count > 1 else times[:1])
        return FixedView(views, frame.centre, 0.0, f"{len(views)} frames of the scene's video")
    return _rendered(config, scene, frame, view, size, count, cache, say)


def pick_frames(video: Views, moments: Tensor) -> Views:
    """The frames nearest to moments that are spread evenly, or to the only one. [T]

    Raises:
        SceneError: If the video leaves out so much that a moment has no frame near it.
    """
    count = len(moments)
    gaps = (video.times[None] - moments[:, None]).abs()
    nearest, chosen = gaps.min(dim=1)
    # A video of few frames may stand for each of them for a while.
    allowed = max(0.75 / max(count - 1, 1), 0.75 / max(len(video) - 1, 1))
    if float(nearest.max()) > allowed:
        moment = float(moments[nearest.argmax()])
        raise SceneError(
            f"the video of the fixed camera has no frame near time {moment:.2f}: its frames must "
            "spread over all times from 0 to 1; set preparation.fixed_view=train to do without it"
        )
    return video.subset(chosen)


def canonical_pose(
    views: Views,
    frame: Frame,
    view: CanonicalView,
    *,
    azimuth: float | None,
    elevation: float,
) -> Tensor:
    """Where the model's camera stands if its box is to hold the scene, and its picture too.

    Args:
        views: Training views.
        frame: The scene's frame, whose cube holds a ball around all that the views show.
        view: The model's camera and box.
        azimuth: Direction in degrees from the world's x axis towards y; None takes the axis of the
            world that points most towards the training camera whose height angle is nearest to
            ``elevation``. Things are often built along the world's axes, and planes hold best what
            lies along theirs.
        elevation: Height angle in degrees.

    Returns:
        Camera-to-world matrix. [4, 4]
    """
    if azimuth is None:
        offset = views.camera_to_world[:, :3, 3] - frame.centre
        height = torch.asin((offset[:, 2] / offset.norm(dim=-1)).clamp(-1, 1))
        nearest = offset[int((height - math.radians(elevation)).abs().argmin())]
        azimuth = 90.0 * round(math.atan2(float(nearest[1]), float(nearest[0])) / (0.5 * math.pi))
    radius = 1 / frame.scale
    held = min(view.half_side, view.distance * math.sin(math.atan(0.5 / view.focal)))
    distance = view.distance * radius / held
    return camera_around(azimuth, elevation, distance, frame.centre).float()


def _rendered(
    config: TrainConfig,
    scene: Scene,
    frame: Frame,
    view: CanonicalView,
    size: int,
    count: int,
    cache: StageCache,
    say: Callable[[str], None],
) -> FixedView:
    options, train = config.preparation, scene.splits["train"]
    pose = canonical_pose(train, frame, view, azimuth=options.azimuth, elevation=options.elevation)
    side = min(size, max(train.height, train.width))
    focal = view.focal * side
    filming = filming_settings(config)
    own_frame = build_frame(filming, train)
    # Samplers may begin at a fixed distance. The model's camera stands nearer than those that the
    # field was trained with, so its rays begin behind it.
    away = (train.camera_to_world[:, :3, 3] - frame.centre).norm(dim=-1).mean()
    back = float(away - (pose[:3, 3] - frame.centre).norm())
    inputs = [
        train.images,
        train.camera_to_world,
        train.times,
        train.focal,
        frame_content(own_frame),
        [asdict(part) for part in (filming.model, filming.sampler, filming.loss, filming.trainer)],
        [config.seed, filming.data.skip_background],
        [filming.data.background_share, filming.data.background_jitter],
        [pose, focal, side, count],
    ]

    def make() -> dict[str, Any]:
        say(
            f"fixed view: training {options.fixed_view_model} for "
            f"{options.fixed_view_seconds:g} s to film {count} frames from where the LRM's camera "
            "stands"
        )
        with cache.workshop("fixed_view", inputs) as folder:
            module = _train(filming, scene, own_frame, folder)
            return {"images": _film(module, own_frame, pose, focal, side, count, back)}

    stage = cache.stage("fixed_view", inputs, make, alone=True)
    views = Views(
        stage.content["images"],
        pose.expand(count, 4, 4),
        torch.linspace(0, 1, count) if count > 1 else train.times[:1],
        focal,
        tuple(f"fixed_{number:03d}.png" for number in range(count)),
    )
    words = (
        f"{count} frames filmed by {options.fixed_view_model} "
        f"trained for {options.fixed_view_seconds:g} s"
    )
    return FixedView(views, frame.centre, stage.seconds, words)


def _train(config: TrainConfig, scene: Scene, frame: Frame, folder: Path) -> RadianceModule:
    """Train the field, going on from where an interrupted attempt stopped."""
    split = config.data.eval_split
    first = torch.zeros(1, dtype=torch.long)
    # One view is scored, for the log; nothing is chosen by it.
    few = replace(
        scene, splits=scene.splits | {split: scene.splits[split].subset(first)}, video=None
    )
    module = build_module(config, few, frame)
    data = RayDataModule(few, frame, lambda rank: build_batches(config, few, frame, rank))
    fit(config, module, data, folder, resume=True)
    return module.eval()


@torch.no_grad()
def _film(
    module: RadianceModule,
    frame: Frame,
    pose: Tensor,
    focal: float,
    side: int,
    count: int,
    back: float,
) -> Tensor:
    """Frames at evenly spread moments, premultiplied. uint8 [T, side, side, 4]"""
    device = module.renderer.device
    origins, directions = camera_rays(pose, focal, side, side)
    origins, directions = frame.rays(origins - back * directions, directions)
    rays = origins.to(device), directions.to(device)
    frames = []
    for time in torch.linspace(0, 1, count).tolist():
        # Black behind the scene leaves colours multiplied by opacity.
        image = module.renderer.image(module.field, *rays, time, torch.zeros(3, device=device))
        whole = torch.cat([image["colour"], image["opacity"][:, None]], dim=-1).clamp(0, 1)
        frames.append((whole * 255).round().to(torch.uint8).view(side, side, 4).cpu())
    return torch.stack(frames)
