"""Base classes of data formats: common settings, splits, and static scenes."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from xplanes.errors import ConfigError, MissingSplitError, SceneError, warn
from xplanes.scenes.entries import some, world_turn
from xplanes.scenes.formats import is_image
from xplanes.scenes.frame import CubeHints
from xplanes.scenes.images import GREY
from xplanes.scenes.listing import Listing, read_views
from xplanes.scenes.masks import MASKS, MaskUse, chosen_use, survey
from xplanes.scenes.videos import SUFFIXES as VIDEOS
from xplanes.scenes.views import Scene, Views, joined, spread
from xplanes.settings import Count, Location, Positive, Settings

Part = TypeVar("Part", Listing, Views)

SAME = 2
"""Largest difference of a static pixel between frames, in steps of 1/255."""

HELD_OUT = 8
"""One in this many training views is held out if a scene has no validation split."""


def may_hold_out(train: Views) -> bool:
    """Whether there are enough training views to hold some out."""
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
    """The scene, made static: all views at time 0, and one frame of its video.

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


def warn_of_masks(folder: Path, images: Sequence[Path], advice: str = "") -> None:
    """Warn about files and folders that seem to be masks, but are not read.

    Args:
        folder: The scene's folder.
        images: Its images, without masks.
        advice: What to do with masks; empty if they can be named.
    """
    folder, images = folder.resolve(), [path.resolve() for path in images]
    places = {path.parent for path in images}
    used = {*images, *places, *(parent for place in places for parent in place.parents)}
    above = {place.parent for place in places if folder in place.parents}
    found = sorted(
        path
        for place in {folder, *places, *above}
        for path in place.iterdir()
        if MASKS.search(path.name) and path not in used
        if path.is_dir() or is_image(path) or (advice and path.suffix.lower() in VIDEOS)
    )
    if found:
        names = some([path.as_posix().removeprefix(f"{folder.as_posix()}/") for path in found])
        place = found[0] if found[0].is_dir() else found[0].parent
        advice = advice or (
            f"name their folder (data.masks={place.name}, of colmap and nerfies), or their files "
            "(mask_path of the frames in transforms files)"
        )
        warn(f"{folder}: {names} is not read. If these are masks of the images, {advice}.")


def warn_of_videos(folder: Path, images: Sequence[Path]) -> None:
    """Warn about several videos in a capture's folder, or in one inside, but for its images."""
    inside = [path for pattern in ("*", "*/*") for path in folder.glob(pattern)]
    inside = [path for path in inside if path.suffix.lower() in VIDEOS and path.name[0] != "."]
    found = sorted(path.name for path in inside)
    if len(found) > 1:
        alike = {path.stem for path in images} <= {path.stem for path in inside}
        when = "Each image has the name of one" if alike else "If they are of several fixed cameras"
        warn(
            f"{folder}: {some(found)}: {len(found)} videos are not read, only images are. {when}: "
            "read them with data=multicamera."
        )


@dataclass(frozen=True, kw_only=True)
class SceneSettings(Settings, ABC):
    """Base class of the settings in the group ``data``, with one subclass for each format."""

    name: str  # Name of the format in run directories and tables.
    root: Location  # Folder that holds the scenes.
    scene: Location  # Folder of the scene, or name of the demo scene.
    # Width of the images in pixels, or theirs if that is less; null keeps the native size.
    resolution: Count | None
    views: Count | None  # Training views, spread over time; null for all.
    train_on_video: bool  # Also train on the frames of the fixed camera.
    static: bool | None  # Static scene; null: static if the fixed camera's frames are equal.
    eval_split: Literal["test", "val"] | None  # Split to score; null: val, then test at the end.
    eval_views: Count | None  # Maximum views per scored split, spread over time; null for all.
    half_side: Positive | None  # Half the side of the scene's bounding cube; null estimates it.
    # Its centre: three coordinates in the world after turning (data.orient), as in the line cube of
    # xplanes inspect; null estimates it.
    centre: Sequence[float] | None
    refine_cameras: bool  # Correct the poses of the training cameras while the field is trained.
    cache: Location | None  # Folder for images too large for memory; null: the user's cache.

    files: ClassVar[str] = ""
    """Content of a folder of this format, for messages; empty for formats without folders."""

    hint: ClassVar[str] = ""
    """Further advice if there is no such scene."""

    numbers_are_times: ClassVar[bool] = False
    """Whether ``static=false`` takes numbers in the images' names for times that are missing."""

    def check(self) -> None:
        if self.centre is not None and len(self.centre) != 3:
            raise ConfigError(f"centre={self.centre}: must be three world coordinates, [x,y,z]")

    def hints(self, scene: Scene) -> CubeHints:
        """What is known of a scene's cube."""
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

    def scene_of(
        self,
        parts: Mapping[str, Listing],
        mask_use: MaskUse,
        masks: tuple[Sequence[Path | None], str],
        up: str = "",
        video: Listing | None = None,
        points: Tensor | None = None,
    ) -> Scene:
        """The scene of listed images, which are decoded here.

        Args:
            parts: The images of each split.
            mask_use: Meaning of the black parts of masks.
            masks: Masks of the whole capture, from which their meaning is determined for all
                splits, and what their source says of it, as in `Listing`.
            up: Description of the up direction; empty if the files' world is unchanged.
            video: Frames of a fixed camera, if there are some.
            points: World points on surfaces, if known. [N, 3]

        Raises:
            SceneError: If an image or a mask cannot be used, or with mask_use lrm if no training
                image has a mask.
        """
        listings, (files, told) = list(parts.values()), masks
        notes = {"times": source} if (source := listings[0].time_source) else {}
        use, kind, lrm_views = mask_use, GREY, None
        if mask_use == "lrm" and "train" in parts and not any(parts["train"].masks):
            raise SceneError(
                "data.mask_use=lrm: no training image has a mask file. Add masks, or set it to "
                "auto."
            )
        if any(files):
            kind = survey(files, told == "ignored")
            use, notes["masks"] = chosen_use(mask_use, kind, str(self.folder), told)

        def read(part: Listing) -> Views:
            return read_views(part, self.resolution, self.image_cache, use == "ignore", kind)

        if use == "lrm":
            lrm_views = read(parts["train"]) if "train" in parts else None
            parts = {split: replace(part, masks=()) for split, part in parts.items()}
        splits = {split: read(part) for split, part in parts.items()}
        if not up:
            poses = torch.cat([listing.camera_to_world for listing in listings])
            up = world_turn(poses, (), False)[1]
            if world_turn(poses, (), None)[0] is not None:
                warn(f"{self.folder}: up is {up}. If the scene lies on its side, rotate the poses.")
        return Scene(
            self.folder.resolve().name,
            splits,
            video=None if video is None else read(video),
            points=points,
            lrm_views=lrm_views,
            notes={**notes, "up": up},
        )

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


@dataclass(frozen=True, kw_only=True)
class CaptureSettings(SceneSettings, ABC):
    """Base class of formats with held-out images and masks."""

    # If the capture lists no splits, every n-th image is held out as val, in order of time and file
    # name; never the first or last.
    eval_every: Count
    # Use of masked-out pixels. alpha: empty space; ignore: neither trained on nor scored; auto:
    # alpha if masks look like silhouettes, else ignore; lrm: only the LRM's input is masked.
    mask_use: MaskUse
    # Rotate the world so that the cameras' mean up vector becomes its z axis. null: if that is more
    # than 60 degrees from it.
    orient: bool | None

    more_splits: ClassVar[str] = ""
    """Further ways to define a split, for messages."""

    def capture(
        self,
        listing: Listing,
        places: Mapping[str, Sequence[int]],
        splits: Sequence[str],
        source: Path,
        points: np.ndarray | None = None,
        up: Tensor | None = None,
    ) -> Scene:
        """The requested splits of a capture.

        Args:
            listing: All images.
            places: Indices of each split's images in the list.
            splits: Names of splits.
            source: Source of the splits, for messages.
            points: World points on surfaces. [N, 3]
            up: The world's up vector, if the files give one. float64 [3]

        Raises:
            MissingSplitError: If a split has no images.
            SceneError: If an image or a mask cannot be used.
        """
        for split in splits:
            if not places.get(split):
                names = ", ".join(name for name, part in places.items() if part)
                raise MissingSplitError(
                    f"{source} has no {split} split. Splits of this capture: {names or 'none'}. "
                    f"Choose another data.eval_split, lower data.eval_every={self.eval_every} (the "
                    f"first and the last image are never held out){self.more_splits}."
                )
        if not any(listing.masks):
            warn_of_masks(self.folder, listing.paths)
        warn_of_videos(self.folder, listing.paths)
        turn, words = world_turn(listing.camera_to_world, listing.paths, self.orient, up)
        found = None if points is None else torch.from_numpy(points - np.array(listing.origin))
        if turn is not None:
            listing = listing.turned(turn)
            found = None if found is None else found @ turn.T
        parts = self.thinned({split: listing.subset(places[split]) for split in splits})
        found = None if found is None else found.float()
        masks = listing.masks, listing.mask_meaning
        return self.scene_of(parts, self.mask_use, masks, words, points=found)
