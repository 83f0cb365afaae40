"""The start of a field: planes, decoder and frame from a source, or nothing."""

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from xplanes.checks import check
from xplanes.config import (
    ConfigError,
    ImageLRMConfig,
    LRMConfig,
    ModelConfig,
    TrainConfig,
    TriplaneFileConfig,
    build,
)
from xplanes.preparation.cache import StageCache
from xplanes.preparation.reconstruct import LoadedLRM, load_lrm, reconstruct
from xplanes.preparation.sequence import TriplaneSequence, load_triplanes
from xplanes.preparation.stages import Parts, convert_stage, decompose_stage
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene, Views
from xplanes.training.assembly import time_rows
from xplanes.training.builder import training_device

logger = logging.getLogger(__name__)

STAGES = ("fixed_view", "lrm", "decomposition", "convert")


def _no_time() -> dict[str, float]:
    return dict.fromkeys(STAGES, 0.0)


def _nothing_skipped() -> dict[str, float]:
    return {"frames": 0.0, "directions": 0.0}


@dataclass(frozen=True)
class Start:
    """What a field starts from.

    Attributes:
        model: The model's settings as the field is to be built: the source decides about channels,
            decoder and whether there are planes of time.
        frame: The field's frame: the source's own, or the scene's.
        planes: Planes by name; None for random ones. [C, rows, columns] each
        decoder: Weights of the decoder; None for a fresh one.
        sparse: What the products of time planes are tied to (L_r). [T, 3, C, H, H]
        report: The decomposition for metrics.json: per orientation, and as ``unexplained`` the
            share of the sparse part's energy that the time planes leave, ``before`` (at random) and
            ``after`` (as they start).
        seconds: Seconds of each stage; of one from the cache those that it took to make.
        words: The start in one line.
        pictures: By name, colours from 0 to 1: the two parts at a few moments, and what the model
            was shown. [H, W, 3] each
        lrm: What the model made of the scene, for metrics.json.
        skipped: For metrics.json: shares of the ``frames`` that equal others and did not pass
            through the model, and of the singular ``directions`` that were not formed.
    """

    model: ModelConfig
    frame: Frame
    planes: Mapping[str, Tensor] | None = None
    decoder: Mapping[str, Tensor] | None = None
    sparse: Tensor | None = None
    report: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=_no_time)
    words: str = "planes at random"
    pictures: dict[str, Tensor] = field(default_factory=dict)
    lrm: dict[str, Any] = field(default_factory=dict)
    skipped: dict[str, float] = field(default_factory=_nothing_skipped)


Source = Path | LoadedLRM | None
"""Where a start comes from: a file, a model, or nothing."""


def find_source(config: LRMConfig, *, say: Callable[[str], None] = print) -> Source:
    """Find what a start is to come from, before anything slow begins.

    Args:
        config: The settings of the Large Reconstruction Model.
        say: Takes a line before anything is downloaded.

    Raises:
        ConfigError: If a file is missing or not named.
        LRMError: If the weights of a model cannot be had, or do not fit.
    """
    if isinstance(config, ImageLRMConfig):
        return load_lrm(config, say=say)
    if not isinstance(config, TriplaneFileConfig):
        return None
    if config.triplanes is None:
        raise ConfigError("lrm=file needs lrm.triplanes=FILE, a file written by save_triplanes")
    if not Path(config.triplanes).is_file():
        raise ConfigError(f"lrm.triplanes={config.triplanes}: there is no such file")
    return Path(config.triplanes)


def prepare(
    config: TrainConfig,
    scene: Scene,
    frame: Frame,
    source: Source,
    *,
    say: Callable[[str], None] = print,
) -> Start:
    """Make the start that the settings ask for; ``lrm=none`` is random and costs nothing.

    Args:
        config: The run's settings.
        scene: The scene.
        frame: The frame of the scene, for sources that bring none.
        source: Outcome of `find_source`.
        say: Takes a line before something slow begins.

    Raises:
        ConfigError, SceneError, LRMError: If the source is damaged or does not fit the settings or
            the scene.
    """
    if source is None:
        return Start(config.model, frame)
    cache = _cache(config)
    if isinstance(source, LoadedLRM):
        made = reconstruct(config, scene, frame, source, cache, say=say)
        start = start_from(
            made.sequence, config, scene, frame, cache, source=made.words, seconds=made.seconds
        )
        shown = {} if made.picture is None else {"fixed_view": made.picture}
        twins = 1 - made.report["distinct"] / made.report["frames"]
        return replace(
            start,
            pictures=shown | start.pictures,
            lrm=made.report,
            skipped=start.skipped | {"frames": twins},
        )
    began = time.perf_counter()
    sequence = load_triplanes(source)
    seconds = {"lrm": time.perf_counter() - began}
    return start_from(sequence, config, scene, frame, cache, source=str(source), seconds=seconds)


def _cache(config: TrainConfig) -> StageCache:
    folder = config.preparation.cache
    cache = StageCache(None if folder is None else Path(folder))
    if config.trainer.devices > 1 and cache.folder is not None and not cache.writable:
        raise ConfigError(
            f"preparation.cache={folder} cannot be written, and the {config.trainer.devices} "
            "processes share the start through it: name another folder"
        )
    return cache


def start_from(
    sequence: TriplaneSequence,
    config: TrainConfig,
    scene: Scene,
    frame: Frame,
    cache: StageCache,
    *,
    source: str,
    seconds: Mapping[str, float],
) -> Start:
    """From a triplane sequence of any source to a start.

    Args:
        sequence: The sequence, checked.
        config: The run's settings.
        scene: The scene.
        frame: The frame of the scene, for a sequence that brings none.
        cache: Where finished stages are kept.
        source: What messages call the sequence.
        seconds: Seconds of the stages that made it.
    """
    views = scene.splits["train"]
    still = views.is_still
    model = _settled(config, sequence, views, source=source)
    if len(sequence.triplanes) == 1 and not still:
        logger.warning(
            "nothing moves in the only triplane of %s: the field gets no planes of time and trains "
            "as a still one",
            source,
        )
    device = training_device(config.trainer.accelerator)
    parts = decompose_stage(sequence.triplanes, config.decomposition, cache, device)
    _warn(parts, config)
    planes = convert_stage(parts, model, config.decomposition, config.seed, cache, device)
    tied = model.plane_set != "three" and config.loss.sparse_weight > 0
    return Start(
        model=model,
        frame=sequence.frame or frame,
        planes=planes.planes,
        decoder=sequence.decoder,
        sparse=parts.sparse if tied else None,
        report=parts.report | ({"unexplained": planes.unexplained} if planes.unexplained else {}),
        seconds=_no_time()
        | dict(seconds)
        | {"decomposition": parts.seconds, "convert": planes.seconds},
        words=_words(sequence, config, parts, planes.unexplained, source),
        pictures={} if parts.picture is None else {"decomposition": parts.picture},
        skipped=_nothing_skipped() | {"directions": _left_out(parts)},
    )


def _left_out(parts: Parts) -> float:
    """Share of the singular directions below the threshold, over all orientations."""
    if not parts.report:
        return 0.0
    kept = sum(report["rank"] for report in parts.report.values())
    return 1 - kept / (len(parts.report) * len(parts.low_rank))


def _settled(
    config: TrainConfig, sequence: TriplaneSequence, views: Views, *, source: str
) -> ModelConfig:
    """The model's settings with what the sequence decides."""
    frames, _, channels = sequence.triplanes.shape[:3]
    model = replace(config.model, channels=channels)
    if views.is_still or frames == 1:
        model = replace(model, plane_set="three")
    if model.plane_set != "three":
        model = replace(model, time_resolution=model.time_resolution or time_rows(views.times))
    if sequence.decoder_config is not None:
        decoder = asdict(model.decoder) | dict(sequence.decoder_config)
        model = replace(model, decoder=build(type(model.decoder), decoder))
    try:
        check(replace(config, model=model))
    except ConfigError as error:
        raise ConfigError(f"{source} does not fit: {error}") from error
    return model


def _warn(parts: Parts, config: TrainConfig) -> None:
    """Say once which orientations did not converge."""
    open_ones = [
        f"{name} (residual {report['residual']:.1e}, last step {report['change']:.1e})"
        for name, report in parts.report.items()
        if not report["converged"]
    ]
    if open_ones:
        logger.warning(
            "the decomposition of %s did not converge within decomposition.max_iterations=%d to "
            "decomposition.tolerance=%g (ten times that for the last step): raise one of them",
            ", ".join(open_ones),
            config.decomposition.max_iterations,
            config.decomposition.tolerance,
        )


def _words(
    sequence: TriplaneSequence,
    config: TrainConfig,
    parts: Parts,
    unexplained: Mapping[str, float],
    source: str,
) -> str:
    frames, _, channels, size = sequence.triplanes.shape[:4]
    words = [f"{frames} triplanes of {source}, {size} x {size} with {channels} channels"]
    if channels != config.model.channels:
        words[0] += f" (not model.channels={config.model.channels})"
    if parts.report:
        ranks = "/".join(str(report["rank"]) for report in parts.report.values())
        share = max(report["sparsity"] for report in parts.report.values())
        words.append(
            f"rank {ranks}, up to {100 * share:.0f}% sparse" + (", cached" if parts.cached else "")
        )
    if unexplained:
        words.append(
            f"time planes {config.decomposition.dynamic}, {100 * unexplained['after']:.0f}% of the "
            f"sparse part unexplained ({100 * unexplained['before']:.0f}% at random)"
        )
    else:
        words.append("no planes of time")
    words.append("its decoder" if sequence.decoder is not None else "a fresh decoder")
    words.append("its frame" if sequence.frame is not None else "the scene's frame")
    return " · ".join(words)
