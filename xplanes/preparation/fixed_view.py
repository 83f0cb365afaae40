"""The fixed-view video: one camera, all timesteps.

A scene may bring it. Otherwise a field is trained on the scene for a short time and rendered from
where the Large Reconstruction Model expects its camera to stand.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xplanes.config import compose_plain
from xplanes.lrm.canonical import CanonicalView
from xplanes.models.initialisation import Method, Place
from xplanes.preparation.cache import StageCache
from xplanes.scenes.cameras import camera_around
from xplanes.scenes.errors import SceneError
from xplanes.scenes.frame import Frame, frame_content
from xplanes.scenes.views import Intrinsics, Views, camera_rays
from xplanes.training.fit import fit_quietly
from xplanes.training.module import RadianceModule

OBLONG = 0.01
"""Share by which the two focal lengths of a video may differ: LRMs expect square pixels."""

OFF_CENTRE = 0.02
"""Share of a video's width by which its principal point may be off its middle, likewise."""

CHECKPOINT_EVERY = 250
"""Steps between checkpoints of that field."""


def rendering_method(method: Method) -> Method:
    """How the field that renders the video is trained: by its model's defaults.

    The run's own model would make ablations of it differ in their video too. Where training and
    images may be sampled at different densities, training's does: a model looks at few pixels.
    """
    name = method.preparation.fixed_view_model
    found = Method.read(compose_plain("train", [f"model={name}", "lrm=none"]))
    model = replace(
        found.model, sampler=found.model.sampler.for_video(), precision=method.model.precision
    )
    return replace(found, seed=method.seed, model=model)


@dataclass(frozen=True)
class FixedView:
    """The video.

    Attributes:
        views: Frames of one camera at timesteps that fill [0, 1] evenly; one where nothing moves.
        target: World point in the middle of the scene. [3]
        seconds: Time that it took to make.
        words: Where it comes from, in a few words.
    """

    views: Views
    target: Tensor
    seconds: float
    words: str


def fixed_view(
    method: Method, place: Place, view: CanonicalView, size: int, cache: StageCache
) -> FixedView:
    """The scene's own video, or one that a field renders.

    Args:
        method: The run's settings.
        place: The scene and its frame.
        view: The camera that the model believes in; a rendered video is taken by it.
        size: Pixels per side that the model looks at; more are not rendered.
        cache: Where a rendered video is kept.

    Raises:
        SceneError: If the scene's video is asked for and there is none, it leaves out timesteps, or
            its camera is none that models know.
    """
    options, scene, frame = method.preparation, place.scene, place.frame
    if options.fixed_view == "video" and scene.video is None:
        raise SceneError(
            f"preparation.fixed_view=video: {scene.name} has no video of a fixed camera "
            "(transforms_video.json); set preparation.fixed_view=train"
        )
    times = scene.splits["train"].times
    count = 1 if scene.splits["train"].is_static else options.frames
    if scene.video is not None and options.fixed_view != "train":
        check_camera(scene.video)
        views = pick_frames(scene.video, torch.linspace(0, 1, count) if count > 1 else times[:1])
        return FixedView(views, frame.centre, 0.0, f"{len(views)} frames of the scene's video")
    return _rendered(method, place, view, size, count, cache)


def check_camera(video: Views) -> None:
    """Refuse a video that is not of one camera with square pixels and centred images.

    Raises:
        SceneError: With what the camera is like.
    """
    intrinsics = video.intrinsics
    way_out = "set preparation.fixed_view=train to do without it, or lrm=none"
    if not intrinsics.is_shared:
        raise SceneError(
            "the frames of the fixed camera's video differ in focal length, principal point or "
            f"size, but models take them for those of one camera: {way_out}"
        )
    (height, width), middle = video.size(0), 0.5 * intrinsics.size[0].flip(0)
    focal_x, focal_y = intrinsics.focal[0].tolist()
    if abs(focal_x / focal_y - 1) > OBLONG:
        raise SceneError(
            f"the fixed camera's focal lengths are {focal_x:.6g} and {focal_y:.6g} pixels along x "
            f"and y, but models expect square pixels: resize its frames, or {way_out}"
        )
    centre_x, centre_y = intrinsics.centre[0].tolist()
    if float((intrinsics.centre[0] - middle).abs().max()) > OFF_CENTRE * width:
        raise SceneError(
            f"the fixed camera's principal point is at {centre_x:.6g}, {centre_y:.6g} of "
            f"{width}x{height} pixels, but models expect it in the middle: crop its frames, or "
            f"{way_out}"
        )


def pick_frames(video: Views, timesteps: Tensor) -> Views:
    """The frames nearest to timesteps that are spread evenly, or to the only one. [T]

    Raises:
        SceneError: If the video leaves out so much that a timestep has no frame near it.
    """
    count = len(timesteps)
    gaps = (video.times[None] - timesteps[:, None]).abs()
    nearest, chosen = gaps.min(dim=1)
    # A video of few frames may stand for each of them for a while.
    allowed = max(0.75 / max(count - 1, 1), 0.75 / max(len(video) - 1, 1))
    if float(nearest.max()) > allowed:
        timestep = float(timesteps[nearest.argmax()])
        raise SceneError(
            f"the video of the fixed camera has no frame near time {timestep:.2f}: its frames must "
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
    method: Method,
    place: Place,
    view: CanonicalView,
    size: int,
    count: int,
    cache: StageCache,
) -> FixedView:
    options, scene, frame = method.preparation, place.scene, place.frame
    train = scene.splits["train"]
    pose = canonical_pose(train, frame, view, azimuth=options.azimuth, elevation=options.elevation)
    side = min(size, max(train.height, train.width))
    focal = view.focal * side
    rendering = rendering_method(method)
    own_frame = rendering.model.frame(train, None)
    # Samplers may begin at a fixed distance. The model's camera stands nearer than those that the
    # field was trained with, so its rays begin behind it.
    away = (train.camera_to_world[:, :3, 3] - frame.centre).norm(dim=-1).mean()
    back = float(away - (pose[:3, 3] - frame.centre).norm())
    inputs = [
        train.images,
        train.camera_to_world,
        train.times,
        [train.intrinsics.focal, train.intrinsics.centre, train.intrinsics.size],
        frame_content(own_frame),
        rendering.model.plain(),
        [method.seed, options.fixed_view_seconds, options.fixed_view_steps],
        [pose, focal, side, count],
    ]

    def make() -> dict[str, Any]:
        place.say(
            f"fixed view: training {options.fixed_view_model} for "
            f"{options.fixed_view_seconds:g} s to render {count} frames from where the LRM's "
            "camera stands"
        )
        with cache.workshop("fixed_view", inputs) as folder:
            module = _train(rendering, method, place, own_frame, folder)
            return {"images": _render(module, own_frame, pose, focal, side, count, back)}

    stage = cache.stage("fixed_view", inputs, make, alone=True)
    views = Views(
        stage.content["images"],
        pose.expand(count, 4, 4),
        torch.linspace(0, 1, count) if count > 1 else train.times[:1],
        Intrinsics.shared(focal, side, side, count),
        tuple(f"fixed_{number:03d}.png" for number in range(count)),
    )
    words = (
        f"{count} frames rendered by {options.fixed_view_model} "
        f"trained for {options.fixed_view_seconds:g} s"
    )
    return FixedView(views, frame.centre, stage.seconds, words)


def _train(
    rendering: Method, method: Method, place: Place, frame: Frame, folder: Path
) -> RadianceModule:
    """Train the field, going on from where an interrupted attempt stopped."""
    module = RadianceModule.of(rendering)
    module.build(place.scene, frame, device=place.device)
    options = method.preparation
    fit_quietly(
        module,
        place.scene,
        folder,
        device=place.device,
        max_steps=options.fixed_view_steps,
        max_seconds=options.fixed_view_seconds,
        checkpoint_every=CHECKPOINT_EVERY,
    )
    return module.eval()


@torch.no_grad()
def _render(
    module: RadianceModule,
    frame: Frame,
    pose: Tensor,
    focal: float,
    side: int,
    count: int,
    back: float,
) -> Tensor:
    """Frames at evenly spread timesteps, premultiplied. uint8 [T, side, side, 4]"""
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
