"""The base class of data formats: common settings, held-out views, and static scenes."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal, Protocol, Self, TypeVar

import torch
from torch import Tensor

from xplanes.errors import ConfigError, MissingSplitError, SceneError, some, warn
from xplanes.scenes.frame import CubeHints
from xplanes.scenes.views import Scene, Views, joined, spread
from xplanes.settings import Count, Location, Positive, Settings


class Timed(Protocol):
    """A split, before or after its images are read: a sequence with times."""

    @property
    def times(self) -> Tensor: ...

    def __len__(self) -> int: ...

    def subset(self, indices: Sequence[int], /) -> Self: ...


Part = TypeVar("Part", bound=Timed)

SAME = 2
"""Largest difference of a static pixel between frames, in steps of 1/255."""

HELD_OUT = 8
"""One in this many training views is held out if a scene has no validation split."""


def may_hold_out(train: Views) -> bool:
    """Whether there are enough training views to hold some out."""
    return len(train) >= 2 * HELD_OUT


def held_out_places(times: Sequence[float], every: int) -> list[int]:
    """Evenly spaced indices of views to hold out, one per group of ``every`` views in time.

    If several cameras observe each timestep, a fixed index within the groups could always select
    the same camera, so the index varies from group to group.

    Args:
        times: Times of the views, in ascending order.
        every: Size of the groups.
    """
    # Multiples of the golden ratio modulo 1 are evenly spread, too.
    step = 0.5 * (math.sqrt(5) - 1) if 1 < len(set(times)) < len(times) else 0.0
    groups = range(-(-len(times) // every))
    places = (every * group + int(every * ((0.5 + step * group) % 1)) for group in groups)
    return [place for place in places if place < len(times)]


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

    def at_one_time(views: Views) -> Views:
        return replace(views, times=torch.zeros_like(views.times))

    return replace(
        scene,
        splits={name: at_one_time(views) for name, views in scene.splits.items()},
        video=None if scene.video is None else at_one_time(scene.video.subset([0])),
        lrm_views=None if scene.lrm_views is None else at_one_time(scene.lrm_views),
        static_reason=reason,
    )


@dataclass(frozen=True, kw_only=True)
class SceneSettings(Settings, ABC):
    """Base class of the settings in the group ``data``, with one subclass for each format."""

    name: str  # Name of the format in run directories and tables.
    root: Location  # Folder that holds the scenes.
    scene: Location  # Folder of the scene, or name of the demo scene.
    # Maximum width of the images in pixels; null keeps the native size.
    resolution: Count | None
    views: Count | None  # Training views, spread over time; null for all.
    train_on_video: bool  # Also train on the frames of the fixed camera.
    static: bool | None  # Static scene; null: static if the fixed camera's frames are equal.
    eval_split: Literal["test", "val"] | None  # Split to score; null: val, then test at the end.
    eval_views: Count | None  # Maximum views per scored split, spread over time; null for all.
    half_side: Positive | None  # Half the side of the scene's bounding cube; null estimates it.
    # Centre of the bounding cube in world coordinates, after data.orient, as in the line cube of
    # xplanes inspect; null estimates it.
    centre: Sequence[float] | None
    refine_cameras: bool  # Correct the poses of the training cameras while the field is trained.
    cache: Location | None  # Folder for images too large for memory; null: the user's cache.

    files: ClassVar[str] = ""
    """Content of a folder of this format, for messages; empty for formats without folders."""

    hint: ClassVar[str] = ""
    """Further advice if there is no such scene."""

    numbers_are_times: ClassVar[bool] = False
    """Whether ``static=false`` reads missing times from numbers in the images' names."""

    def check(self) -> None:
        if self.centre is not None and len(self.centre) != 3:
            raise ConfigError(f"centre={self.centre}: must be three world coordinates, [x,y,z]")

    def hints(self, scene: Scene) -> CubeHints:
        """Information about a scene's cube other than its views."""
        return CubeHints(self.half_side, self.centre, scene.points)

    @property
    def folder(self) -> Path:
        """The scene's folder."""
        return Path(self.root) / self.scene

    def no_scene(self) -> SceneError:
        """The error for a folder without a scene of this format; names nearby scenes."""
        folder = self.folder.absolute()
        there = "is not a folder" if folder.exists() else "does not exist"
        there = f"holds no {self.files}" if folder.is_dir() else there
        near, scenes = folder if folder.is_dir() else folder.parent, []
        with suppress(OSError):
            scenes = [path.name for path in sorted(near.iterdir()) if self._is_scene(path)]
        nearby = f" Such scenes in {near}: {some(scenes)}." if scenes else ""
        return SceneError(
            f"{folder} {there}.{nearby} Set data.root and data.scene to a folder with {self.files}"
            f"{self.hint}. xplanes inspect FOLDER tells which format a folder has."
        )

    @classmethod
    def _is_scene(cls, path: Path) -> bool:
        with suppress(OSError):  # The user may not have access to some folders.
            return path.is_dir() and cls.recognises(path)
        return False

    @property
    def image_cache(self) -> Path | None:
        """Folder for decoded images; None for the user's cache folder."""
        return None if self.cache is None else Path(self.cache)

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        """Whether a folder looks like a scene of this format, judged by its file names.

        False for formats that do not read the user's folders.
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

    def thinned(self, parts: Mapping[str, Part]) -> dict[str, Part]:
        """Splits, reduced to the numbers of views in `views` and `eval_views`.

        The views that are kept are evenly spaced in temporal order, including the first and the
        last.

        Args:
            parts: Views, or lists of images, by split name.

        Raises:
            SceneError: If the train split has fewer views.
        """
        found = {}
        for split, part in parts.items():
            total, count = len(part), self.views
            if split != "train":
                count = None if self.eval_views is None else min(self.eval_views, total)
            if count is not None:
                if count > total:
                    raise SceneError(
                        f"data.views={count}, but the {split} split of {self.folder} has {total} "
                        f"views. Give a number from 1 to {total}, or null for all."
                    )
                by_time = part.times.argsort(stable=True).tolist()
                part = part.subset(sorted(by_time[rank] for rank in spread(count, total)))
            found[split] = part
        return found

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
        scene = replace(scene, name=self.scene, splits=parts, refine_cameras=self.refine_cameras)
        if self.static:
            return as_static(scene, "data.static=true")
        if self.static is None and scene.video is not None and frames_are_equal(scene.video):
            return as_static(scene, f"the fixed camera's {len(scene.video)} frames are equal")
        return scene

    def _load_scored(self) -> Scene:
        """The training views and the splits that are scored."""
        if self.eval_split is not None:
            return self.load(("train", self.eval_split))
        for scored in (("val", "test"), ("val",), ("test",)):
            with suppress(MissingSplitError):
                return self.load(("train", *scored))
        scene = self.load(("train",))
        train = scene.splits["train"]
        if may_hold_out(train):
            return scene
        warn(
            f"{self.folder}: {len(train)} images are too few to hold some out: the training "
            "images are scored, which says little about other views."
        )
        return replace(scene, splits={**scene.splits, "val": train})
