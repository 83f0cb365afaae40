"""What a checkpoint says of the field, so that it can be built without its data."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from xplanes import __version__
from xplanes.components import build, plugins
from xplanes.errors import ConfigError
from xplanes.files import stand_in
from xplanes.models.base import ModelSettings
from xplanes.models.initialisation import Method
from xplanes.rendering.sampler import Site
from xplanes.scenes.frame import Frame, frame_content, read_frame
from xplanes.training.building import Parts, precision_of


def require_version(path: Any) -> None:
    """Refuse a checkpoint of a version whose settings were others.

    Args:
        path: The file; what is no local file, or cannot be read, is left to others.

    Raises:
        ConfigError: With the version.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        made = str(content.get("xplanes", "0.2 or older"))
    except Exception:  # Whoever loads it says what is wrong.
        return
    if made.split(".")[:2] != __version__.split(".")[:2]:
        raise ConfigError(
            f"{path} was made by xplanes {made}, whose settings are not those of {__version__}: "
            "load it with that version, or start a new run"
        )


def require_fetched(path: Any) -> None:
    """Refuse what stands for a checkpoint that was not fetched, such as a pointer of Git LFS.

    Args:
        path: The file; what is no local file is left to others.

    Raises:
        ConfigError: Saying what it is and how to fetch the file.
    """
    if isinstance(path, str | Path) and (other := stand_in(Path(path))) is not None:
        raise ConfigError(f"{path} {other}")


def site_content(parts: Parts) -> dict[str, Any]:
    """What data and LRM have settled about a field, as plain values and tensors."""
    site = parts.site
    return {
        "model": parts.settings.plain(),
        "frame": frame_content(site.frame),
        "times": site.times,
        "bounds": site.bounds,
        "initialised": site.initialised,
        "pixels": site.pixels,
        "surrounded": site.surrounded,
    }


def parts_from(
    content: Mapping[str, Any], method: Method, modules: Sequence[str], samples: int | None
) -> Parts:
    """Build a field without its data, for weights that are about to be loaded.

    Args:
        content: What `site_content` gave.
        method: All settings except those of the data and the Trainer.
        modules: The user's modules whose classes ``content`` may name.
        samples: Samples per training batch.

    Raises:
        ConfigError: If the content names a class that may not stand there.
    """
    with plugins(modules):
        settings = build(content["model"], ModelSettings, "model")
    if not content["initialised"] or settings.name != method.model.name:
        settings = method.model  # Weights of another one will not fit.
    site = Site(
        frame=_frame(content),
        times=content["times"],
        seed=method.seed,
        precision=precision_of(settings, torch.device("cpu")),
        bounds=content["bounds"],
        pixels=content["pixels"],
        surrounded=content["surrounded"],
        samples_per_batch=samples,
    )
    return Parts.assemble(settings, site)


def require_frame(parts: Parts, content: Mapping[str, Any]) -> None:
    """Refuse planes that were trained in another frame than the initialisation lies in now.

    Raises:
        ConfigError: Naming what differs.
    """
    trained = _frame(content)
    if not (parts.site.initialised and content["initialised"]):
        return
    for name, now in frame_content(parts.site.frame).items():
        before = torch.as_tensor(getattr(trained, name))
        if not torch.allclose(before, torch.as_tensor(now), rtol=1e-4, atol=1e-5):
            raise ConfigError(
                f"the initialisation was computed again, and its frame is not the checkpoint's "
                f"({name} {before.tolist()}, now {torch.as_tensor(now).tolist()}): what "
                "preparation.cache kept is gone. Bring it back, or start a new run "
                "in another folder"
            )


def _frame(content: Mapping[str, Any]) -> Frame:
    return read_frame(content["frame"], "the checkpoint")


def require_whole_floats(precision: str) -> None:
    """Refuse a Trainer that changes the precision: the model sets its own.

    Raises:
        ConfigError: With what to set instead.
    """
    if precision not in ("32", "32-true"):
        raise ConfigError(
            f"precision={precision}: a field computes in model.precision (auto, 32 or bf16), and "
            "its planes are float32; leave it out"
        )
