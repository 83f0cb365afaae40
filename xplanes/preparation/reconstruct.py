"""From a scene to a triplane sequence: film it, show each frame to the model, place the result."""

import hashlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xplanes.backend import fast_bf16
from xplanes.config import (
    BundledLRMConfig,
    ImageLRMConfig,
    PretrainedLRMConfig,
    TrainConfig,
)
from xplanes.lrm.alignment import Alignment, align
from xplanes.lrm.bundled import load_bundled
from xplanes.lrm.cube import fit_cube
from xplanes.lrm.errors import LRMError
from xplanes.lrm.images import Crop, foreground_crop, square_crop
from xplanes.lrm.model import LRM
from xplanes.lrm.weights import WeightSource, find_weights, load_weights
from xplanes.preparation.cache import StageCache, fingerprint
from xplanes.preparation.encode import encode
from xplanes.preparation.fixed_view import FixedView, fixed_view
from xplanes.preparation.pictures import film_sheet
from xplanes.preparation.sequence import TriplaneSequence
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene
from xplanes.training.builder import training_device

logger = logging.getLogger(__name__)

SOLID = 128
"""Alpha from which a pixel belongs to the object that is cropped."""


@dataclass(frozen=True)
class LoadedLRM:
    """A model that is ready.

    Attributes:
        model: The model.
        key: Hash of its weights and sizes.
        seconds: Time that it took to load.
    """

    model: LRM
    key: str
    seconds: float


@dataclass(frozen=True)
class Reconstruction:
    """What a model made of a scene.

    Attributes:
        sequence: Triplanes, decoder and frame.
        seconds: Seconds of ``fixed_view`` and ``lrm``.
        report: For metrics.json.
        words: Where the triplanes come from, in a few words.
        picture: Some frames as the model was shown them, colours from 0 to 1. [H, W, 3]
    """

    sequence: TriplaneSequence
    seconds: dict[str, float]
    report: dict[str, Any] = field(default_factory=dict)
    words: str = ""
    picture: Tensor | None = None


def weight_source(config: PretrainedLRMConfig) -> WeightSource:
    """Where the weights of the settings come from."""
    return WeightSource(
        architecture=config.architecture,
        repository=config.repository,
        file=config.file,
        revision=config.revision,
        licence=config.licence,
        megabytes=config.megabytes,
        weights=None if config.weights is None else Path(config.weights),
        config=None if config.config is None else Path(config.config),
    )


def load_lrm(config: ImageLRMConfig, *, say: Callable[[str], None]) -> LoadedLRM:
    """Find the weights, downloading them if need be, and load them.

    Raises:
        LRMError: If no weights can be had, or they do not fit.
    """
    began = time.perf_counter()
    if isinstance(config, BundledLRMConfig):
        own = None if config.weights is None else Path(config.weights)
        model, path = (
            load_bundled(config.bundled) if own is None else load_bundled(own.stem, own.parent)
        )
    elif isinstance(config, PretrainedLRMConfig):
        source = weight_source(config)
        path = find_weights(source, announce=say)
        began = time.perf_counter()
        model = load_weights(source, path, announce=say)
    else:
        raise TypeError(f"{type(config).__name__} names no weights")
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    key = fingerprint([digest, repr(model.config), repr(model.view)])
    return LoadedLRM(model, key, time.perf_counter() - began)


def reconstruct(
    config: TrainConfig,
    scene: Scene,
    frame: Frame,
    lrm: LoadedLRM,
    cache: StageCache,
    *,
    say: Callable[[str], None],
) -> Reconstruction:
    """Make the triplane sequence of a scene.

    Args:
        config: The run's settings.
        scene: The scene.
        frame: The scene's frame: its cube holds a ball around all that the views show.
        lrm: The model.
        cache: Where finished work is kept.
        say: Takes a line before something slow begins.

    Raises:
        LRMError, SceneError: If the scene's video or camera cannot be used.
    """
    options, model = config.lrm, lrm.model
    film = fixed_view(config, scene, frame, model.view, model.image_size, cache, say=say)
    alignment = place(film, model, options)
    device = training_device(config.trainer.accelerator)
    frames = film.views.images
    if bool((frames[..., 3] == 255).all()):
        logger.warning(
            "the frames of the fixed view have no transparency: %s takes the background for a "
            "thing; cut them out (RGBA), or set lrm=none",
            options.name,
        )
    say(f"lrm: {len(frames)} frames to triplanes")
    encoded = encode(
        model,
        lrm.key,
        frames,
        alignment.crop,
        cache,
        device,
        batch=options.batch,
        bf16=wants_bf16(options, device),
    )
    # The cube is to hold the ball around all that the views show.
    offset = float((alignment.frame.centre - frame.centre).norm())
    wanted = alignment.frame.scale * (1 / frame.scale + offset)
    triplanes, half_side = fit_cube(encoded.triplanes, alignment.half_side, wanted)
    placed = replace(alignment, half_side=half_side)
    decoder = model.field_decoder(half_side)
    apart = alignment.mismatch
    report = {
        "fixed_view": film.words,
        "frames": len(frames),
        "distinct": encoded.distinct,
        "cached": encoded.cached,
        "scale": placed.frame.scale,
        "half_side": half_side,
        "mismatch_pixels": {"largest": apart.largest, "mean": apart.mean},
    }
    words = (
        f"{options.name} ({model.config.architecture}) on {film.words}, pictures and field up to "
        f"{apart.largest:.1f} px apart"
    )
    return Reconstruction(
        TriplaneSequence(
            triplanes,
            decoder=decoder.state_dict(),
            decoder_config=decoder.options,
            frame=placed.field_frame,
        ),
        seconds={"fixed_view": film.seconds, "lrm": lrm.seconds + encoded.seconds},
        report=report,
        words=words,
        picture=film_sheet(frames, alignment.crop, model),
    )


def wants_bf16(config: ImageLRMConfig, device: torch.device) -> bool:
    """Whether the model multiplies in bfloat16."""
    return config.precision == "bf16" or (config.precision == "auto" and fast_bf16(device))


def place(film: FixedView, model: LRM, config: ImageLRMConfig) -> Alignment:
    """Where the model's field lies in the world.

    Raises:
        LRMError: If the film's camera cannot be the model's.
    """
    views = film.views
    return align(
        views.camera_to_world[0],
        focal=views.focal,
        height=views.height,
        width=views.width,
        target=film.target,
        view=model.view,
        matching="pad" if config.matching == "pad" else "scale",
        crop=picture_crop(views.images, crop=True) if config.crop else None,
    )


def picture_crop(frames: Tensor, *, crop: bool) -> Crop:
    """One crop for all frames: around what is opaque in any, or around the whole pictures.

    Args:
        frames: Premultiplied RGBA. uint8 [T, H, W, 4]
        crop: Whether the model wants to see the object at a size of its own.

    Raises:
        LRMError: If nothing is opaque.
    """
    alpha = frames[..., 3].amax(dim=0)
    if not crop or bool((alpha > 0).all()):
        return square_crop(*alpha.shape)
    # What is hardly there, such as specks of a field that films, is not the object.
    solid = torch.where(alpha >= SOLID, alpha, 0)
    try:
        return foreground_crop(solid)
    except LRMError as problem:
        raise LRMError(f"{problem}; set lrm.crop=false to show it whole") from None
