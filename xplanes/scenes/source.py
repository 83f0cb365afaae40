"""Base class of data formats: common settings and handling of static scenes."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

import torch

from xplanes.errors import MissingSplitError, SceneError
from xplanes.scenes.views import Scene, Views, joined
from xplanes.settings import Count, Location, Positive, Settings

SAME = 2
"""Largest difference of a static pixel between frames, in steps of 1/255."""


HELD_OUT = 8
"""Where a scene has no validation split, one in this number of training views is held out."""


def may_hold_out(train: Views) -> bool:
    """Whether there are training views enough to hold some out."""
    return len(train) >= 2 * HELD_OUT


def frames_are_equal(video: Views) -> bool:
    """Whether all frames of a fixed-camera video (two timesteps or more) are equal."""
    first = video.image(0).to(torch.int16)
    fixed = video.intrinsics.is_shared and not video.is_static
    return fixed and all(
        int((video.image(index).to(torch.int16) - first).abs().max()) <= SAME
        for index in range(1, len(video))
    )


def as_static(scene: Scene, reason: str) -> Scene:
    """The scene as a static one: all views at time 0, and one frame of its video.

    Args:
        scene: The scene.
        reason: Why the scene is known to be static, for the header of a run.
    """
    splits = {
        name: replace(views, times=torch.zeros_like(views.times))
        for name, views in scene.splits.items()
    }
    video = scene.video
    if video is not None:
        video = video.subset(torch.zeros(1, dtype=torch.long))
        video = replace(video, times=torch.zeros(1))
    cut = scene.cut
    if cut is not None:
        cut = replace(cut, times=torch.zeros_like(cut.times))
    return replace(scene, splits=splits, video=video, cut=cut, static_reason=reason)


@dataclass(frozen=True, kw_only=True)
class SceneSettings(Settings, ABC):
    """Base class of the settings in the group ``data``, with one subclass for each format."""

    name: str  # Name of the format in run directories and tables.
    root: Location  # Folder that holds the scenes.
    scene: Location  # Folder of the scene, or name of the demo scene.
    resolution: Count | None  # Width of the images in pixels; null keeps the native size.
    views: Count | None  # Training views, spread over time; null for all.
    train_on_video: bool  # Also train on the frames of the fixed camera.
    static: bool | None  # Static scene; null: static if the fixed camera's frames are equal.
    eval_split: Literal["test", "val"] | None  # Split to score; null: val, then test at the end.
    eval_views: Count | None  # Maximum views per scored split, spread over time; null for all.
    half_side: Positive | None  # Half the side of the scene's bounding cube; null estimates it.
    cache: Location | None  # Folder for images too large for memory; null: the user's cache.

    files: ClassVar[str] = ""
    """What a folder of this format holds, in words; empty for formats without such folders."""

    @property
    def folder(self) -> Path:
        """The scene's folder."""
        return Path(self.root) / self.scene

    @property
    def image_cache(self) -> Path | None:
        """Folder for decoded images; None for the user's cache folder."""
        return None if self.cache is None else Path(self.cache)

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        """Whether a folder looks like a scene of this format, judged by its file names.

        False for formats that read no folders of the user.
        """
        return False

    def prepare(self) -> None:
        """Download or render missing data; called by one process per machine.

        Raises:
            SceneError: If the data cannot be obtained.
        """

    @abstractmethod
    def load(self, splits: Sequence[str]) -> Scene:
        """Read the given splits, and the video of the fixed camera if there is one.

        Args:
            splits: Names of splits: "train", "val", "test".

        Raises:
            MissingSplitError: If a split does not exist.
            SceneError: If anything else is missing, damaged or inconsistent.
        """

    def read(self, splits: Sequence[str] | None = None) -> Scene:
        """Read the scene as these settings specify.

        Args:
            splits: Names of splits. None reads "train" and the scored split: `eval_split`, or
                whichever of "val" and "test" exist.

        Raises:
            SceneError: If the scene cannot be used.
        """
        scene = self.load(tuple(splits)) if splits else self._load_scored()
        parts = dict(scene.splits)
        if self.train_on_video and "train" in parts:
            if scene.video is None:
                raise SceneError(
                    f"data.train_on_video=true: {self.folder} has no video of a fixed camera "
                    "(transforms_video.json); set it to false"
                )
            parts["train"] = joined(parts["train"], scene.video)
        scene = replace(scene, name=self.scene, splits=parts)
        if self.static:
            return as_static(scene, "data.static=true")
        if self.static is None and scene.video is not None and frames_are_equal(scene.video):
            return as_static(scene, f"the fixed camera's {len(scene.video)} frames are equal")
        return scene

    def _load_scored(self) -> Scene:
        """The training views and the splits that are scored."""
        if self.eval_split is not None:
            return self.load(("train", self.eval_split))
        for splits in (("train", "val", "test"), ("train", "val")):
            with suppress(MissingSplitError):
                return self.load(splits)
        try:
            return self.load(("train", "test"))
        except MissingSplitError:
            scene = self.load(("train",))
            train = scene.splits["train"]
            if may_hold_out(train):
                return scene
            warnings.warn(
                f"{self.folder}: {len(train)} images are too few to hold some out: the images that "
                "are trained on are scored, which says little of other views.",
                stacklevel=4,
            )
            return replace(scene, splits={**scene.splits, "val": train})
