"""The fixed-view video: one camera, all timesteps.

A scene may provide it. Otherwise a field is trained on the scene for a short time and rendered from
the canonical camera of the Large Reconstruction Model.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from xplanes.config import compose_plain
from xplanes.errors import ConfigError, SceneError
from xplanes.fields.base import RadianceField
from xplanes.fields.xplanes import XPlanes
from xplanes.lrm.canonical import CanonicalView
from xplanes.models.initialisation import Method, Place, PreparationSettings
from xplanes.preparation.cache import StageCache
from xplanes.rendering.base import RayRenderer
from xplanes.scenes.cameras import PosedCamera, camera_around
from xplanes.scenes.frame import NO_HINTS, CubeHints, Frame, frame_content
from xplanes.scenes.views import Intrinsics, Scene, Views

if TYPE_CHECKING:
    from xplanes.training.module import RadianceModule

OBLONG = 0.01
"""Largest relative difference of the two focal lengths: LRMs expect square pixels."""

OFF_CENTRE = 0.02
"""Largest offset of the principal point from the image centre, as a share of the width."""


def rendering_method(method: Method, views: Views, hints: CubeHints = NO_HINTS) -> Method:
    """Settings of the field that renders the fixed-view video: the defaults of its model.

    The run's own model is not used, because ablations of it would also change the video. Images are
    rendered with the number of samples of training steps: the LRM sees images of few pixels.

    Args:
        method: The run's settings.
        views: Training views; the model's published cube, near and far are kept if they fit.
        hints: Known properties of the scene's cube.
    """
    name = method.preparation.fixed_view_model
    found = Method.read(compose_plain("train", [f"model={name}", "lrm=none"]))
    if found.model.sampler.kind is not RadianceField:
        raise ConfigError(
            f"preparation.fixed_view_model={name}: its renderer draws whole images, not single "
            "rays; choose a model with a radiance field, such as six_planes"
        )
    model = found.model.for_scene(views, hints)
    model = replace(model, sampler=model.sampler.for_video(), precision=method.model.precision)
    return replace(found, seed=method.seed, model=model)


@dataclass(frozen=True)
class FixedView:
    """The fixed-view video.

    Attributes:
        views: Frames of one camera, evenly spaced over [0, 1]; one frame for a static scene.
        target: Centre of the scene in world coordinates. [3]
        seconds: Time to produce it.
        description: Its source, for messages.
    """

    views: Views
    target: Tensor
    seconds: float
    description: str


def fixed_view(
    method: Method, place: Place, view: CanonicalView, size: int, cache: StageCache
) -> FixedView:
    """The scene's own video, or one rendered by a field.

    Args:
        method: The run's settings.
        place: The scene and its frame.
        view: Canonical camera of the LRM; a rendered video uses it.
        size: Image size of the LRM in pixels, the largest size that is rendered.
        cache: Cache of rendered videos.

    Raises:
        SceneError: If the scene's video is requested and missing, lacks timesteps, or has a camera
            that LRMs do not support.
    """
    options, scene, frame = method.preparation, place.scene, place.frame
    if options.fixed_view == "video" and scene.video is None:
        raise SceneError(
            f"preparation.fixed_view=video: {scene.name} has no video of a fixed camera "
            "(transforms_video.json); set preparation.fixed_view=train"
        )
    times = scene.splits["train"].times
    count = 1 if scene.splits["train"].is_static else options.frames or len(times.unique())
    if (video := given_video(scene, options.fixed_view)) is not None:
        check_camera(video)
        views = pick_frames(video, torch.linspace(0, 1, count) if count > 1 else times[:1])
        return FixedView(views, frame.centre, 0.0, f"{len(views)} frames of the scene's video")
    if scene.lrm_views is not None:
        place = replace(
            place, scene=replace(scene, splits=scene.splits | {"train": scene.lrm_views})
        )
    elif scene.is_surrounded:
        place.say(
            f"fixed view: the images of {scene.name} have no silhouettes, so the LRM is shown "
            "everything in the cube, including the ground; with masks it would see only the object "
            "(data.mask_use=lrm)"
        )
    return _rendered(method, place, view, size, count, cache)


def given_video(scene: Scene, fixed_view: str) -> Views | None:
    """The scene's own video of a fixed camera; None if an LRM needs another one.

    Args:
        scene: The scene.
        fixed_view: The setting `PreparationSettings.fixed_view`.
    """
    if scene.video is None or fixed_view == "train":
        return None
    # A video without alpha shows surroundings, which an LRM would treat as part of the object.
    whole = scene.is_surrounded and scene.video.is_opaque
    return None if whole and fixed_view == "auto" else scene.video


def check_camera(video: Views) -> None:
    """Check that a video has one camera, square pixels and a centred principal point.

    Raises:
        SceneError: If not; the message describes the camera.
    """
    intrinsics = video.intrinsics
    way_out = "set preparation.fixed_view=train to render another video, or lrm=none"
    if not intrinsics.is_shared:
        raise SceneError(
            "the frames of the fixed camera's video differ in focal length, principal point or "
            f"size, but LRMs expect one camera: {way_out}"
        )
    (height, width), middle = video.size(0), 0.5 * intrinsics.size[0].flip(0)
    focal_x, focal_y = intrinsics.focal[0].tolist()
    if abs(focal_x / focal_y - 1) > OBLONG:
        raise SceneError(
            f"the fixed camera's focal lengths are {focal_x:.6g} and {focal_y:.6g} pixels along x "
            f"and y, but LRMs expect square pixels: resize its frames, or {way_out}"
        )
    centre_x, centre_y = intrinsics.centre[0].tolist()
    if float((intrinsics.centre[0] - middle).abs().max()) > OFF_CENTRE * width:
        raise SceneError(
            f"the fixed camera's principal point is at {centre_x:.6g}, {centre_y:.6g} of "
            f"{width}x{height} pixels, but LRMs expect it at the centre: crop its frames, or "
            f"{way_out}"
        )
    if intrinsics.lenses is not None:
        straight = PosedCamera(video.camera_to_world[0], focal_x, height, width).rays()[1]
        bent = (video.image_rays(0)[1] - straight).norm(dim=-1).max()
        if float(bent) * focal_x > OFF_CENTRE * width:
            raise SceneError(
                "the fixed camera's lens distorts its frames by more than "
                f"{OFF_CENTRE * width:.3g} pixels, but LRMs expect a pinhole: undistort them, or "
                f"{way_out}"
            )


def pick_frames(video: Views, timesteps: Tensor) -> Views:
    """The frames nearest to evenly spaced timesteps, or to a single timestep. [T]

    Raises:
        SceneError: If a timestep has no frame near it.
    """
    count = len(timesteps)
    gaps = (video.times[None] - timesteps[:, None]).abs()
    nearest, chosen = gaps.min(dim=1)
    # A video with few frames may use each of them for several timesteps.
    allowed = max(0.75 / max(count - 1, 1), 0.75 / max(len(video) - 1, 1))
    if float(nearest.max()) > allowed:
        timestep = float(timesteps[nearest.argmax()])
        raise SceneError(
            f"the video of the fixed camera has no frame near time {timestep:.2f}: its frames must "
            "cover all times from 0 to 1; set preparation.fixed_view=train to render another video"
        )
    return video.subset(chosen)


def canonical_pose(
    views: Views, frame: Frame, view: CanonicalView, *, azimuth: float | None, elevation: float
) -> Tensor:
    """Camera pose for which both the LRM's box and its image contain the scene.

    Args:
        views: Training views.
        frame: The scene's frame; its cube contains a bounding sphere of the content.
        view: The model's camera and box.
        azimuth: Azimuth in degrees, from the world's x axis towards y. None selects the world axis
            nearest to the training camera whose elevation is nearest to ``elevation``: objects are
            often aligned with the world axes, and planes represent axis-aligned content best.
        elevation: Elevation in degrees.

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
    method: Method, place: Place, view: CanonicalView, size: int, count: int, cache: StageCache
) -> FixedView:
    options, scene, frame = method.preparation, place.scene, place.frame
    train = scene.splits["train"]
    pose = canonical_pose(train, frame, view, azimuth=options.azimuth, elevation=options.elevation)
    side = min(size, max(train.height, train.width))
    focal = view.focal * side
    rendering = rendering_method(method, train, place.hints)
    own_frame = rendering.model.frame(train, place.hints)
    # Samplers may have a fixed near bound. The LRM's camera is closer than the training cameras, so
    # its ray origins are moved back.
    away = (train.camera_to_world[:, :3, 3] - frame.centre).norm(dim=-1).mean()
    back = float(away - (pose[:3, 3] - frame.centre).norm())
    inputs = [
        train.identity,
        train.camera_to_world,
        train.times,
        train.ignored,
        intrinsics_key(train.intrinsics),
        frame_content(own_frame),
        rendering.model.plain(),
        place.scene.refine_cameras,
        [method.seed, options.fixed_view_seconds, options.fixed_view_steps],
        [pose, focal, side, count],
    ]

    def make() -> dict[str, Any]:
        place.say(
            f"fixed view: training {options.fixed_view_model} for {_budget(options)} to render "
            f"{count} frames from the LRM's camera"
        )
        with cache.workshop("fixed_view", inputs) as folder:
            module = trained_field(
                rendering,
                replace(place, frame=own_frame),
                folder,
                steps=options.fixed_view_steps,
                seconds=options.fixed_view_seconds,
                advice=f"The model {options.fixed_view_model} renders the fixed view: set "
                "preparation.fixed_view_model to another model, or lrm=none",
            )
            return {"images": _render(module, own_frame, pose, focal, side, count, back)}

    stage = cache.stage("fixed_view", inputs, make, alone=True)
    views = Views(
        stage.content["images"],
        pose.expand(count, 4, 4),
        torch.linspace(0, 1, count) if count > 1 else train.times[:1],
        Intrinsics.shared(focal, side, side, count),
        tuple(f"fixed_{number:03d}.png" for number in range(count)),
    )
    description = (
        f"{count} frames rendered by {options.fixed_view_model} trained for {_budget(options)}"
    )
    return FixedView(views, frame.centre, stage.seconds, description)


def _budget(options: PreparationSettings) -> str:
    """Training time of the field that renders the video, for messages."""
    steps, seconds = options.fixed_view_steps, options.fixed_view_seconds
    return f"{steps} steps" if seconds is None else f"up to {steps} steps or {seconds:g} s"


def intrinsics_key(intrinsics: Intrinsics) -> list[Tensor]:
    """Tensors of the cameras' intrinsics, for the keys of cached stages."""
    key = [intrinsics.focal, intrinsics.centre, intrinsics.size]
    if (lenses := intrinsics.lenses) is not None:
        key += [lenses.model, lenses.coefficients, lenses.skew]
    return key


def trained_field(
    method: Method, place: Place, folder: Path, *, steps: int, seconds: float | None, advice: str
) -> "RadianceModule":
    """Train a field for a short time; an interrupted training is resumed.

    Args:
        method: Settings of the field.
        place: The scene and the field's frame.
        folder: Folder of its checkpoints.
        steps: Maximum number of training steps.
        seconds: Maximum training time in seconds; None for no limit.
        advice: Advice to the user if the loss is not finite; the run's own settings differ from
            ``method``.

    Raises:
        TrainingError: If the loss is not finite.
    """
    # Imported here because Lightning's import takes long, and settings need no training.
    from xplanes.training.fit import fit_quietly
    from xplanes.training.module import RadianceModule

    module = RadianceModule(method)
    module.build(place.scene, place.frame, device=place.device, say=place.say)
    module.advice = advice
    fit_quietly(
        module, place.scene, folder, device=place.device, max_steps=steps, max_seconds=seconds
    )
    return module.eval()


@torch.no_grad()
def _render(
    module: "RadianceModule",
    frame: Frame,
    pose: Tensor,
    focal: float,
    side: int,
    count: int,
    back: float,
) -> Tensor:
    """Premultiplied frames at evenly spaced timesteps; ray origins are moved by ``back`` backwards.

    uint8 [T, side, side, 4]
    """
    renderer = module.renderer
    assert isinstance(renderer, RayRenderer)
    device = renderer.device
    if isinstance(module.field, XPlanes):
        module.field.background = None  # The video shows only what is in the cube.
    origins, directions = PosedCamera(pose, focal, side, side).rays()
    origins, directions = frame.rays(origins - back * directions, directions)
    rays = origins.to(device), directions.to(device)
    frames = []
    for time in torch.linspace(0, 1, count).tolist():
        # Rendering on black gives premultiplied colours.
        image = renderer.image(module.field, *rays, time, torch.zeros(3, device=device))
        whole = torch.cat([image["colour"], image["opacity"][:, None]], dim=-1).clamp(0, 1)
        frames.append((whole * 255).round().to(torch.uint8).view(side, side, 4).cpu())
    return torch.stack(frames)
