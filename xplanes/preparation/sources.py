"""Sources of an initialisation: published LRMs, bundled LRMs, and triplane files."""

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from xplanes.errors import ConfigError, LRMError
from xplanes.lrm.weights import WeightSource, find_weights, load_bundled, load_weights
from xplanes.models.base import InitialValues
from xplanes.models.initialisation import (
    NO_TIME,
    NOTHING_SKIPPED,
    Initialisation,
    Initialiser,
    InitialiserSettings,
    Method,
    Place,
)
from xplanes.models.x_planes import XPlanesSettings
from xplanes.preparation.cache import Stage, StageCache
from xplanes.preparation.fixed_view import given_video
from xplanes.preparation.reconstruct import ImageLRMSettings, LoadedLRM, loaded, reconstruct
from xplanes.preparation.sequence import TriplaneSequence, check_sequence, load_triplanes
from xplanes.preparation.stages import convert_stage, decompose_stage, named_planes, parts_sheet
from xplanes.scenes.views import Views
from xplanes.settings import Location

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class BundledLRMSettings(ImageLRMSettings):
    """A bundled LRM, or another LRM in the same format from ``weights``."""

    bundled: str  # Name of the bundled LRM.

    @property
    def model_name(self) -> str:
        return self.bundled if self.weights is None else super().model_name

    def load_model(self, say: Callable[[str], None]) -> LoadedLRM:
        began = time.perf_counter()
        if self.weights is None:
            model, path = load_bundled(self.bundled)
        else:
            own = Path(self.weights)
            if not own.is_file():
                raise LRMError(f"lrm.weights={own}: there is no such file")
            if own.suffix != ".safetensors":
                raise LRMError(
                    f"{own} is not a .safetensors file: give one that xplanes pretrain-lrm wrote, "
                    "next to its .json, or name the published model to which the weights belong "
                    f"(lrm=large lrm.weights={own})"
                )
            model, path = load_bundled(own.stem, own.parent)
        return loaded(model, path, began)

    def load(self, say: Callable[[str], None] = print) -> "LRMInitialiser":
        return LRMInitialiser(self, self.load_model(say))


@dataclass(frozen=True, kw_only=True)
class AutoLRMSettings(BundledLRMSettings):
    """A bundled LRM for scenes with a video of a fixed camera, random initialisation for others."""

    def load(self, say: Callable[[str], None] = print) -> "AutoInitialiser":
        return AutoInitialiser(self, self.load_model(say))


@dataclass(frozen=True, kw_only=True)
class PublishedLRMSettings(WeightSource, ImageLRMSettings):
    """A published LRM."""

    def load_model(self, say: Callable[[str], None]) -> LoadedLRM:
        path = find_weights(self, announce=say)
        began = time.perf_counter()
        return loaded(load_weights(self, path, announce=say), path, began)

    def load(self, say: Callable[[str], None] = print) -> "LRMInitialiser":
        return LRMInitialiser(self, self.load_model(say))


class LRMInitialiser(Initialiser):
    """Triplanes that an LRM predicts from a fixed-view video.

    Args:
        settings: Settings of the LRM and of its input images.
        lrm: The model.
    """

    def __init__(self, settings: ImageLRMSettings, lrm: LoadedLRM) -> None:
        self.settings, self.lrm, self.key = settings, lrm, lrm.key

    def initialise(self, method: Method, place: Place) -> Initialisation:
        cache = cache_of(method, place)
        made = reconstruct(method, self.settings, place, self.lrm, cache)
        found = from_sequence(
            made.sequence, method, place, cache, source=made.description, seconds=made.seconds
        )
        shown = {} if made.picture is None else {"fixed_view": made.picture}
        repeated = 1 - made.report["distinct"] / made.report["frames"]
        return replace(
            found,
            pictures=shown | found.pictures,
            lrm=made.report,
            skipped=found.skipped | {"frames": repeated},
        )


class AutoInitialiser(LRMInitialiser):
    """Triplanes of an LRM, or a random initialisation where a video would have to be rendered.

    Training a field to render one takes seconds, which cancels the LRM's gain: docs/decisions.md.
    """

    def initialise(self, method: Method, place: Place) -> Initialisation:
        scene, wanted = place.scene, method.preparation.fixed_view
        if wanted == "auto" and scene.lrm_views is None and given_video(scene, wanted) is None:
            words = "no video of a fixed camera for an LRM"
            if scene.video is not None:
                words = (
                    "the images of the fixed camera have no silhouettes for an LRM "
                    "(preparation.fixed_view=video uses them anyway)"
                )
            words = f"random initialisation: {words}"
            return Initialisation(
                method.model, place.frame, description=words, lrm={"name": "none"}
            )
        found = super().initialise(method, place)
        return replace(found, lrm=found.lrm | {"name": self.settings.model_name})


@dataclass(frozen=True, kw_only=True)
class TriplaneFileSettings(InitialiserSettings):
    """A precomputed triplane sequence from a file."""

    triplanes: Location | None  # File written by save_triplanes.

    def load(self, say: Callable[[str], None] = print) -> "FileInitialiser":
        if self.triplanes is None:
            raise ConfigError("lrm=file needs lrm.triplanes=FILE, a file written by save_triplanes")
        if not Path(self.triplanes).is_file():
            raise ConfigError(f"lrm.triplanes={self.triplanes}: there is no such file")
        return FileInitialiser(Path(self.triplanes))


class FileInitialiser(Initialiser):
    """Triplanes from a file.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def initialise(self, method: Method, place: Place) -> Initialisation:
        began = time.perf_counter()
        sequence = load_triplanes(self.path)
        seconds = {"lrm": time.perf_counter() - began}
        cache = cache_of(method, place)
        return from_sequence(sequence, method, place, cache, source=str(self.path), seconds=seconds)


def cache_of(method: Method, place: Place) -> StageCache:
    """The cache of a run's stages.

    Raises:
        ConfigError: If processes share the run and there is no cache for them to share.
    """
    folder = method.preparation.cache
    if place.devices > 1 and folder is None:
        raise ConfigError(
            f"preparation.cache=null with lrm={method.lrm.name} and trainer.devices="
            f"{place.devices}: the processes share the initialisation through the cache; set "
            "it to a folder"
        )
    cache = StageCache(None if folder is None else Path(folder))
    if place.devices > 1 and not cache.writable:
        raise ConfigError(
            f"preparation.cache={folder} cannot be written, and the {place.devices} processes "
            "share the initialisation through it: set another folder"
        )
    return cache


def from_sequence(
    sequence: TriplaneSequence,
    method: Method,
    place: Place,
    cache: StageCache,
    *,
    source: str,
    seconds: Mapping[str, float],
) -> Initialisation:
    """Convert a triplane sequence from any source to an initialisation.

    Args:
        sequence: The sequence.
        method: The run's settings.
        place: The scene and its frame; the frame is used if the sequence has none.
        cache: Cache of the stages.
        source: Name of the sequence in messages.
        seconds: Seconds of the preceding stages.

    Raises:
        ConfigError, SceneError: If the sequence is invalid (`check_sequence`).
    """
    check_sequence(sequence, source)
    views = place.scene.splits["train"]
    model = _settings_for(method, sequence, views, source=source)
    if len(sequence.triplanes) == 1 and not views.is_static:
        logger.warning(
            "%s has a single triplane: the field has no time planes and is trained as static",
            source,
        )
    device = place.device
    parts = decompose_stage(sequence.triplanes, method.decomposition, cache, device)
    low_rank, sparse, report = (parts.content[name] for name in ("low_rank", "sparse", "report"))
    _warn_unless_converged(report, method)
    planes = convert_stage(parts, model, method.decomposition, method.seed, cache, device)
    regularised = model.plane_set != "three" and model.loss.sparse_weight > 0
    target, unexplained = sparse if regularised else None, planes.content["unexplained"]
    spent = {"decomposition": parts.seconds if report else 0.0, "convert": planes.seconds}
    kept = sum(each["rank"] for each in report.values())
    left_out = 1 - kept / (len(report) * len(low_rank)) if report else 0.0
    return Initialisation(
        model=model,
        frame=sequence.frame or place.frame,
        values=InitialValues(named_planes(planes, model.plane_set), sequence.decoder, target),
        report=report | ({"unexplained": unexplained} if unexplained else {}),
        seconds=NO_TIME | dict(seconds) | spent,
        description=_described(sequence, method, parts, unexplained, source),
        pictures={} if sparse is None else {"decomposition": parts_sheet(low_rank, sparse)},
        skipped=NOTHING_SKIPPED | {"directions": left_out},
    )


def _settings_for(
    method: Method, sequence: TriplaneSequence, views: Views, *, source: str
) -> XPlanesSettings:
    """The model's settings, updated with those that the sequence determines."""
    frames, _, channels = sequence.triplanes.shape[:3]
    model = replace(cast(XPlanesSettings, method.model), channels=channels)
    if views.is_static or frames == 1:
        model = replace(model, plane_set="three")
    if model.plane_set != "three":
        # The video may have more timesteps than the training views.
        model = replace(model, time_resolution=model.rows_of_time(views.times, frames))
    if sequence.decoder_config is not None:
        try:
            decoder = replace(model.decoder, **dict(sequence.decoder_config))
        except ConfigError as error:
            raise ConfigError(f"{source} does not fit: model.decoder.{error}") from error
        model = replace(model, decoder=decoder)
    return model


def _warn_unless_converged(report: Mapping[str, Mapping[str, Any]], method: Method) -> None:
    """Warn once about all orientations that did not converge."""
    unconverged = [
        f"{name} (residual {each['residual']:.1e}, last step {each['change']:.1e})"
        for name, each in report.items()
        if not each["converged"]
    ]
    if unconverged:
        logger.warning(
            "the decomposition of %s did not converge within decomposition.max_iterations=%d to "
            "decomposition.tolerance=%g (ten times that for the last step): raise one of them",
            ", ".join(unconverged),
            method.decomposition.max_iterations,
            method.decomposition.tolerance,
        )


def _described(
    sequence: TriplaneSequence,
    method: Method,
    parts: Stage,
    unexplained: Mapping[str, float],
    source: str,
) -> str:
    frames, _, channels, size = sequence.triplanes.shape[:4]
    words = [f"{frames} triplanes of {source}, {size} x {size} with {channels} channels"]
    own = cast(XPlanesSettings, method.model).channels
    if channels != own:
        words[0] += f" (not model.channels={own})"
    if report := parts.content["report"]:
        ranks = "/".join(str(each["rank"]) for each in report.values())
        share = max(each["sparsity"] for each in report.values())
        words.append(
            f"rank {ranks}, up to {100 * share:.0f}% sparse" + (", cached" if parts.cached else "")
        )
    if unexplained:
        words.append(
            f"time planes {method.decomposition.dynamic}, {100 * unexplained['after']:.0f}% of the "
            f"sparse part unexplained (random: {100 * unexplained['before']:.0f}%)"
        )
    else:
        words.append("no time planes")
    words.append("given decoder" if sequence.decoder is not None else "new decoder")
    words.append("given frame" if sequence.frame is not None else "the scene's frame")
    return " · ".join(words)
