"""From settings to objects: the only place that turns names into classes."""

import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from xplanes.backend import fast_bf16
from xplanes.config import (
    ConfigError,
    DataConfig,
    DemoConfig,
    ModelConfig,
    SamplerConfig,
    TrainConfig,
    TrainerConfig,
)
from xplanes.fields import Decoder, XPlanes
from xplanes.fields.base import RadianceField
from xplanes.fields.decoder import Precision
from xplanes.fields.xplanes import random_planes
from xplanes.rendering.carving import carve
from xplanes.rendering.filling import fill
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.renderer import DIAGONAL, Renderer
from xplanes.scenes.batches import RayBatches, step_generator
from xplanes.scenes.demo import ensure_demo_scene
from xplanes.scenes.dnerf import read_scene
from xplanes.scenes.errors import SceneError
from xplanes.scenes.frame import Frame, frame_content
from xplanes.scenes.still import at_one_moment, stands_still
from xplanes.scenes.views import Scene, Views, joined
from xplanes.training.assembly import PLANS, SAMPLINGS, Site, scene_cube, time_rows
from xplanes.training.methods.xplanes import XPlanesMethod
from xplanes.training.module import RadianceModule
from xplanes.training.product import SparseProduct
from xplanes.training.sampling.occupancy import OccupancySampling
from xplanes.training.warming import render_one_ray

START_STREAM = 1_000_033
"""Random stream of the start values."""

FILL_STREAM = 1_000_081
"""Random stream of the points at which the grid of a field that has begun is filled."""


def build_scene(config: DataConfig, splits: tuple[str, ...] | None = None) -> Scene:
    """Read the scene, or render it first where it is a procedural one.

    Args:
        config: The data group.
        splits: Splits to read; the training views and the scored split when None.
    """
    folder = Path(config.root) / config.scene
    if isinstance(config, DemoConfig):
        folder = ensure_demo_scene(
            Path(config.root),
            config.scene,
            resolution=config.resolution or 128,
            seed=config.seed,
            train_views=config.train_views,
            val_views=config.val_views,
            test_views=config.test_views,
        )
    try:
        scene = read_scene(
            folder,
            resolution=config.resolution,
            splits=splits or ("train", config.eval_split),
            views=config.views,
            eval_views=config.eval_views,
        )
    except SceneError as problem:
        if not isinstance(config, DemoConfig):
            raise
        raise SceneError(
            f"{problem} This is a demo scene: delete {folder}, and it is rendered again"
        ) from problem
    parts = dict(scene.splits)
    if config.train_on_video and "train" in parts:
        if scene.video is None:
            raise SceneError(
                f"data.train_on_video=true: {folder} has no video of a fixed camera "
                "(transforms_video.json); set it to false"
            )
        parts["train"] = joined(parts["train"], scene.video)
    scene = replace(scene, name=config.scene, splits=parts)
    if config.still:
        return at_one_moment(scene, "data.still=true")
    if config.still is None and scene.video is not None and stands_still(scene.video):
        return at_one_moment(scene, f"the fixed camera's {len(scene.video)} frames are equal")
    return scene


def training_device(name: str) -> torch.device:
    """The device of ``trainer.accelerator``: a CUDA GPU where there is one, else the CPU.

    Of several processes each has the GPU of its own number.

    Raises:
        ConfigError: If a GPU is asked for and none is found.
    """
    if name == "gpu" and not torch.cuda.is_available():
        raise ConfigError(
            "trainer.accelerator=gpu: no GPU found; set trainer.accelerator=cpu or auto"
        )
    if name == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    rank = int(os.environ.get("LOCAL_RANK", "0"))
    return torch.device("cuda", rank) if rank else torch.device("cuda")


def decoder_precision(trainer: TrainerConfig) -> Precision:
    """The precision of ``trainer.precision``, settled for the device where it says auto."""
    if trainer.precision == "auto":
        return "bf16" if fast_bf16(training_device(trainer.accelerator)) else "32"
    return "bf16" if trainer.precision == "bf16" else "32"


def build_field(
    config: ModelConfig,
    times: Tensor,
    seed: int,
    precision: Precision = "32",
    *,
    planes: Mapping[str, Tensor] | None = None,
    decoder_state: Mapping[str, Tensor] | None = None,
) -> XPlanes:
    """A field that starts from what it is given, the rest of it random.

    Args:
        config: The model group.
        times: Times of the training views; planes of time are left out where all are equal. [V]
        seed: The run's seed.
        precision: Of the decoder's products.
        planes: Planes by name; random ones when None. [C, rows, columns] each
        decoder_state: Weights of the decoder; a fresh one when None.
    """
    distinct = len(times.unique())
    plane_set = config.plane_set if distinct > 1 else "three"
    generator = step_generator(seed, 0, START_STREAM)
    if planes is None:
        planes = random_planes(
            plane_set,
            channels=config.channels,
            resolution=config.resolution,
            time_resolution=config.time_resolution or time_rows(times),
            space_scale=config.space_scale,
            time_scale=config.time_scale,
            generator=generator,
        )
    options = config.decoder
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(generator.initial_seed())
        decoder = Decoder(
            config.channels,
            width=options.width,
            hidden=options.hidden,
            activation=options.activation,  # type: ignore[arg-type]
            density=options.density,  # type: ignore[arg-type]
            density_scale=options.density_scale,
            precision=precision,
            colour_margin=options.colour_margin,
        )
    if decoder_state is not None:
        decoder.load_state_dict(dict(decoder_state))
    else:
        with torch.no_grad():
            decoder.layers[-1].bias[0] += options.density_start  # type: ignore[index]
    decoder.requires_grad_(not options.freeze)
    return XPlanes(planes=planes, decoder=decoder, plane_set=plane_set)


def build_frame(config: TrainConfig, views: Views) -> Frame:
    """The frame in which a model's field lives: the scene's cube, or the model's own."""
    plan = PLANS.get(type(config.model))
    return (scene_cube if plan is None else plan.frame)(config, views)


def build_renderer(config: SamplerConfig, *, still: bool) -> Renderer:
    """The renderer with a grid in which everything may be occupied."""
    grid = OccupancyGrid(
        config.grid_resolution,
        1 if still else config.time_bins,
        step=DIAGONAL / config.samples,
        threshold=config.threshold,
        decay=config.decay,
    )
    return Renderer(
        grid,
        config.samples,
        skip_empty=config.skip_empty,
        occlusion=config.occlusion if config.skip_occluded else 0.0,
    )


def build_module(
    config: TrainConfig,
    scene: Scene,
    frame: Frame,
    *,
    planes: Mapping[str, Tensor] | None = None,
    decoder_state: Mapping[str, Tensor] | None = None,
    sparse: Tensor | None = None,
) -> RadianceModule:
    """Field, renderer and training in one module.

    Args:
        config: The run's settings, its model as it is to be built.
        scene: The scene.
        frame: The field's frame.
        planes: As for `build_field`.
        decoder_state: As for `build_field`.
        sparse: What the products of time planes are tied to (L_r); None leaves the term out.
            [T, 3, C, H, H]
    """
    views = scene.splits["train"]
    if isinstance(config.model, ModelConfig) and config.model.plane_set == "three":
        # Nothing moves in this field: all views are of one moment.
        views = replace(views, times=torch.zeros_like(views.times))
    precision = decoder_precision(config.trainer)
    site = Site(views, frame, precision, begun=planes is not None)
    if isinstance(config.model, ModelConfig):
        method = _xplanes_method(config, site, planes, decoder_state, sparse)
    else:
        method = PLANS[type(config.model)].method(config, site)
    sample = SAMPLINGS.get(type(config.sampler), _occupancy_sampling)
    origin = {"model": asdict(config.model), "frame": frame_content(frame)}
    return RadianceModule(
        method,
        sample(config, site, method.field),
        trainer=config.trainer,
        seed=config.seed,
        origin=None if planes is None else origin,
    )


def _xplanes_method(
    config: TrainConfig,
    site: Site,
    planes: Mapping[str, Tensor] | None,
    decoder_state: Mapping[str, Tensor] | None,
    sparse: Tensor | None,
) -> XPlanesMethod:
    field = build_field(
        config.model,
        site.views.times,
        config.seed,
        "bf16" if site.precision == "bf16" else "32",
        planes=planes,
        decoder_state=decoder_state,
    )
    product = None
    if sparse is not None and field.time is not None and config.loss.sparse_weight:
        product = SparseProduct(sparse, field.rows, config.loss.sparse_frames)
    loss, views = config.loss, len(site.views)
    return XPlanesMethod(
        field,
        loss=loss,
        trainer=config.trainer,
        product=product,
        hold=loss.start_weight / views**2 if site.begun else 0.0,
        fade=None if loss.start_steps is None else loss.start_steps / views,
    )


def _occupancy_sampling(config: TrainConfig, site: Site, field: RadianceField) -> OccupancySampling:
    renderer = build_renderer(config.sampler, still=site.views.is_still)
    if config.sampler.silhouettes:
        carve(renderer.grid, site.views, site.frame)
    if site.begun and config.sampler.fill:
        device = training_device(config.trainer.accelerator)
        for part in (field, renderer.grid):
            part.to(device)
        render_one_ray(field, renderer)
        generator = step_generator(config.seed, 0, FILL_STREAM)
        fill(renderer.grid, field, site.views, site.frame, step=renderer.step, generator=generator)
        for part in (field, renderer.grid):
            part.to("cpu")
    return OccupancySampling(renderer, config.sampler)


def build_batches(config: TrainConfig, scene: Scene, frame: Frame, rank: int) -> RayBatches:
    """The ray batches of one process."""
    return RayBatches(
        scene.splits["train"],
        frame,
        rays=config.trainer.rays_per_batch,
        seed=config.seed,
        background=config.loss.background,
        skip_background=config.data.skip_background,
        background_share=config.data.background_share,
        background_jitter=config.data.background_jitter,
        rank=rank,
    )
