"""What a run that goes on must have in common with what it began as."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from xplanes.config import ConfigError
from xplanes.scenes.views import Views

KEPT = """model.name lrm.name sampler.name data.name data.scene data.seed data.resolution data.views
data.train_views data.train_on_video data.still data.half_side""".split()
"""Settings on which the planes, their frame and what they show depend. Files may have moved."""


def require_same_settings(run: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse settings that a checkpoint cannot go on with.

    Args:
        run: The run directory.
        before: The settings that it began with; those that are not there are not compared.
        now: The settings that it is to go on with.

    Raises:
        ConfigError: Naming the first that differs.
    """
    for key in KEPT:
        group, name = key.split(".")
        pair = [content.get(group) or {} for content in (before, now)]
        if not all(isinstance(part, Mapping) and name in part for part in pair):
            continue
        was, wanted = (part[name] for part in pair)
        if was != wanted:
            raise ConfigError(
                f"resume={run} with {key}={wanted}: its checkpoint was trained with {key}={was}. "
                "Leave it out, or train anew in another folder"
            )


def require_same_views(run: Path, record: Mapping[str, Any], views: Views) -> None:
    """Refuse other training views than the run's: the frame and the field's size depend on them.

    Args:
        run: The run directory.
        record: The content of its run.json; one that lists no files refuses nothing.
        views: The scene's training views.

    Raises:
        ConfigError: If they are others, or in another order.
    """
    files = record.get("files")
    recorded = files.get("train") if isinstance(files, Mapping) else None
    if isinstance(recorded, list) and recorded != list(views.files):
        raise ConfigError(
            f"{run} was trained on {len(recorded)} views, but the scene now lists "
            f"{len(views.files)} others or in another order: restore the scene's files"
        )
