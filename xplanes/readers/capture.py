"""Captures: their settings, splits and masks, and the scene of listed images."""

from abc import ABC
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from xplanes.errors import MissingSplitError, SceneError, some, warn
from xplanes.readers.entries import world_turn
from xplanes.readers.formats import is_image
from xplanes.readers.images import GREY
from xplanes.readers.listing import Listing, read_views
from xplanes.readers.masks import MASKS, MaskUse, Meaning, chosen_use, survey
from xplanes.readers.videos import SUFFIXES as VIDEOS
from xplanes.readers.videos import is_video
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Scene, Views
from xplanes.settings import Count


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
    inside = [*filter(is_video, [*folder.glob("*"), *folder.glob("*/*")])]
    found = sorted(path.name for path in inside)
    if len(found) > 1:
        alike = {path.stem for path in images} <= {path.stem for path in inside}
        when = "Each image has the name of one" if alike else "If they are of several fixed cameras"
        warn(
            f"{folder}: {some(found)}: {len(found)} videos are not read, only images are. {when}: "
            "read them with data=multicamera."
        )


def scene_of(
    settings: SceneSettings,
    parts: Mapping[str, Listing],
    mask_use: MaskUse,
    masks: tuple[Sequence[Path | None], Meaning | None],
    up: str = "",
    video: Listing | None = None,
    points: Tensor | None = None,
) -> Scene:
    """The scene of listed images, which are decoded here.

    Args:
        settings: Settings with its folder and the width of its images.
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
            "data.mask_use=lrm: no training image has a mask file. Add masks, or set it to auto."
        )
    if any(files):
        kind = survey(files, told == "ignore")
        use, notes["masks"] = chosen_use(mask_use, kind, str(settings.folder), told)

    def read(part: Listing) -> Views:
        return read_views(part, settings.resolution, settings.image_cache, use == "ignore", kind)

    if use == "lrm":
        lrm_views = read(parts["train"]) if "train" in parts else None
        parts = {split: replace(part, masks=()) for split, part in parts.items()}
    splits = {split: read(part) for split, part in parts.items()}
    if not up:
        poses = torch.cat([listing.camera_to_world for listing in listings])
        up = world_turn(poses, (), False)[1]
        if world_turn(poses, (), None)[0] is not None:
            warn(f"{settings.folder}: up is {up}. If the scene lies on its side, rotate the poses.")
    return Scene(
        settings.folder.resolve().name,
        splits,
        video=None if video is None else read(video),
        points=points,
        lrm_views=lrm_views,
        notes={**notes, "up": up},
    )


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
        found = None
        if points is not None:
            found = torch.from_numpy(points - np.array(listing.origin))
            found = (found if turn is None else found @ turn.T).float()
        if turn is not None:
            listing = listing.turned(turn)
        parts = self.thinned({split: listing.subset(places[split]) for split in splits})
        masks = listing.masks, listing.mask_meaning
        return scene_of(self, parts, self.mask_use, masks, words, points=found)
