"""From a scene to a triplane sequence: fixed-view video, LRM encoding, alignment."""

import hashlib
import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from xplanes.backend import fast_bf16
from xplanes.errors import ConfigError, LRMError
from xplanes.lrm.alignment import Alignment, Matching, align, fit_cube
from xplanes.lrm.images import Crop, foreground_crop, square_crop
from xplanes.lrm.model import LRM
from xplanes.models.initialisation import InitialiserSettings, Method, Place
from xplanes.preparation.cache import StageCache, fingerprint
from xplanes.preparation.encode import encode
from xplanes.preparation.fixed_view import FixedView, fixed_view
from xplanes.preparation.sequence import TriplaneSequence
from xplanes.preparation.stages import contact_sheet
from xplanes.scenes.matte import SOLID
from xplanes.settings import Count, Location

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadedLRM:
    """A loaded LRM.

    Attributes:
        model: The model.
        key: Hash of its weights and sizes.
        seconds: Time to load it.
    """

    model: LRM
    key: str
    seconds: float


@dataclass(frozen=True)
class Reconstruction:
    """Triplanes of a scene, predicted by an LRM.

    Attributes:
        sequence: Triplanes, decoder and frame.
        seconds: Seconds of ``fixed_view`` and ``lrm``.
        report: For metrics.json.
        description: The source of the triplanes, for messages.
        picture: Contact sheet of input frames, colours in [0, 1]. [H, W, 3]
    """

    sequence: TriplaneSequence
    seconds: dict[str, float]
    report: dict[str, Any] = field(default_factory=dict)
    description: str = ""
    picture: Tensor | None = None


@dataclass(frozen=True, kw_only=True)
class ImageLRMSettings(InitialiserSettings, ABC):
    """Settings of an LRM and of its input images."""

    weights: Location | None  # Local file of weights; null: downloaded or bundled weights.
    # If focal lengths differ from the LRM's. scale: match sizes at the scene's depth; pad: exact.
    matching: Matching
    crop: bool  # Crop images to the object size in the LRM's training.
    batch: Count  # Images per batch.
    precision: Literal["auto", "32", "bf16"]  # Precision of matrix products; auto: bf16 if fast.

    def check(self) -> None:
        if self.crop and self.matching == "pad":
            raise ConfigError(
                "crop=true with lrm.matching=pad: both change the image size; set either "
                "lrm.crop=false or lrm.matching=scale"
            )

    @property
    def model_name(self) -> str:
        """Name of the LRM, which may be chosen by other settings than ``name``."""
        return self.name if self.weights is None else Path(self.weights).name

    @abstractmethod
    def load_model(self, say: Callable[[str], None]) -> LoadedLRM:
        """Find the weights, download them if necessary, and load them.

        Raises:
            LRMError: If the weights are not available or do not fit.
        """

    def bf16_on(self, device: torch.device) -> bool:
        """Whether the model multiplies in bfloat16."""
        return self.precision == "bf16" or (self.precision == "auto" and fast_bf16(device))


def loaded(model: LRM, path: Path, began: float) -> LoadedLRM:
    """A model loaded from a file, with the time since ``began``."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    key = fingerprint([digest, repr(model.config), repr(model.view)])
    return LoadedLRM(model, key, time.perf_counter() - began)


def reconstruct(
    method: Method, options: ImageLRMSettings, place: Place, lrm: LoadedLRM, cache: StageCache
) -> Reconstruction:
    """Predict the triplane sequence of a scene.

    Args:
        method: The run's settings.
        options: Settings of the LRM.
        place: The scene and its frame; its cube contains a bounding sphere of the content.
        lrm: The model.
        cache: Cache of the stages.

    Raises:
        LRMError, SceneError: If the scene's video or camera cannot be used.
    """
    model, frame, device = lrm.model, place.frame, place.device
    video = fixed_view(method, place, model.view, model.image_size, cache)
    alignment = align_to(video, model, options)
    frames = video.views.in_memory()
    if bool((frames[..., 3] == 255).all()):
        logger.warning(
            "the frames of the fixed-view video have no transparency: %s will reconstruct the "
            "background as part of the object; remove it (RGBA), or set lrm=none",
            options.model_name,
        )
    place.say(f"lrm: {len(frames)} frames to triplanes")
    encoded = encode(
        model,
        lrm.key,
        frames,
        alignment.crop,
        cache,
        device,
        batch=options.batch,
        bf16=options.bf16_on(device),
    )
    # The cube must contain the bounding sphere of the content.
    offset = float((alignment.frame.centre - frame.centre).norm())
    wanted = alignment.frame.scale * (1 / frame.scale + offset)
    triplanes, half_side = fit_cube(encoded.triplanes, alignment.half_side, wanted)
    placed = replace(alignment, half_side=half_side)
    decoder = model.field_decoder(half_side)
    apart = alignment.mismatch
    report = {
        "fixed_view": video.description,
        "frames": len(frames),
        "distinct": encoded.distinct,
        "cached": encoded.cached,
        "scale": placed.frame.scale,
        "half_side": half_side,
        "mismatch_pixels": {"largest": apart.largest, "mean": apart.mean},
    }
    description = (
        f"{options.model_name} ({model.config.architecture}) on {video.description}, image and "
        f"field up to {apart.largest:.1f} px apart"
    )
    return Reconstruction(
        TriplaneSequence(
            triplanes,
            decoder=decoder.state_dict(),
            decoder_config=decoder.options,
            frame=placed.field_frame,
        ),
        seconds={"fixed_view": video.seconds, "lrm": lrm.seconds + encoded.seconds},
        report=report,
        description=description,
        picture=contact_sheet(frames, alignment.crop, model),
    )


def align_to(video: FixedView, model: LRM, options: ImageLRMSettings) -> Alignment:
    """Alignment of the model's frame with the world.

    Raises:
        LRMError: If the camera of the video cannot be aligned with the model's.
    """
    views = video.views
    return align(
        views.camera_to_world[0],
        focal=float(views.intrinsics.focal[0, 0]),
        height=views.height,
        width=views.width,
        target=video.target,
        view=model.view,
        matching=options.matching,
        crop=picture_crop(views.in_memory(), crop=True) if options.crop else None,
    )


def picture_crop(frames: Tensor, *, crop: bool) -> Crop:
    """One crop for all frames: around pixels that are opaque in any frame, or the whole image.

    Args:
        frames: Premultiplied RGBA. uint8 [T, H, W, 4]
        crop: Whether to crop to the object.

    Raises:
        LRMError: If nothing is opaque.
    """
    alpha = frames[..., 3].amax(dim=0)
    if not crop or bool((alpha > 0).all()):
        return square_crop(*alpha.shape)
    # Faint content, such as floaters of the field that renders the fixed-view video, is left out.
    solid = torch.where(alpha >= SOLID, alpha, 0)
    try:
        return foreground_crop(solid)
    except LRMError as problem:
        raise LRMError(f"{problem}; set lrm.crop=false to use whole images") from None
