"""Captures in the format of nerfstudio and instant-ngp: one transforms.json and its images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from xplanes.errors import BrokenFrameError, SceneError, first_of, warn
from xplanes.readers.capture import CaptureSettings
from xplanes.readers.entries import image_path, short, spelt
from xplanes.readers.listing import Listing, held_out
from xplanes.readers.rigs import is_rig
from xplanes.readers.transforms import listing_of, numbers, read_frames, stated_up
from xplanes.scenes.views import Scene

SPLITS = ("train", "val", "test")


@dataclass(frozen=True, kw_only=True)
class NerfstudioSettings(CaptureSettings):
    """A capture in the format of nerfstudio or instant-ngp."""

    files: ClassVar = "transforms.json"
    numbers_are_times: ClassVar = True
    more_splits: ClassVar = ', or list "val_filenames" or "test_filenames" in the file'

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        return (folder / "transforms.json").is_file() and not is_rig(folder)

    def load(self, splits: Sequence[str]) -> Scene:
        """Read and check a whole capture.

        Except for ``data.orient``, poses are used unchanged: ``applied_transform``,
        ``applied_scale``, ``scale``, ``offset`` and ``aabb_scale`` place the world in other
        programs, whereas the field's frame is estimated from the cameras. Times in any unit are
        mapped to [0, 1] over the frames of all splits.
        """
        path = self.folder / "transforms.json"
        if not path.is_file():
            raise self.no_scene()
        content = read_frames(path)
        listing = listing_of(
            path, content, numbered=numbers({path: content}) if self.static is False else None
        )
        places = _listed_splits(path, content, listing)
        if places is None:
            places = held_out(listing, self.eval_every)
        if "train" in splits and not places.get("train"):
            raise SceneError(f'{path} has no frames to train on: fill "train_filenames".')
        orient, up = stated_up(content, self.orient)
        return replace(self, orient=orient).capture(listing, places, splits, path, up=up)


def _listed_splits(
    path: Path, content: Mapping[str, Any], listing: Listing
) -> dict[str, list[int]] | None:
    """Indices of the frames that the file lists for each split; None if it lists no splits."""
    listed = {split: content.get(f"{split}_filenames") for split in SPLITS}
    if not any(listed.values()):
        return None
    # Frames by name, None for those that are left out, and by file for names spelt differently.
    places: dict[str | Path, int | None] = dict.fromkeys(
        spelt(frame["file_path"]) for frame in content["frames"]
    )
    for index, (name, image) in enumerate(zip(listing.names, listing.paths, strict=True)):
        places[spelt(name)] = places[image] = index
    found: dict[str, list[int]] = {}
    missing = []
    for split, names in listed.items():
        key = f"{split}_filenames"
        if names is None:
            continue
        if not isinstance(names, list):
            raise SceneError(f"{path}: {key} is {short(names)}, not a list of file names.")
        for name in names:
            try:
                if (frame := spelt(name)) not in places:
                    frame = image_path(str(path), path.parent.resolve(), name, key)
                index = places[frame]
            except BrokenFrameError as problem:
                missing.append(f"{key}: {problem}")
            except KeyError:
                missing.append(f"{key}: {path}: {name} is in no frame.")
            else:
                if index is not None:  # Others are reported already.
                    found.setdefault(split, []).append(index)
    if missing:
        warn(f"{len(missing)} names in lists of splits are left out:\n{first_of(missing)}")
    splits = {split: sorted(set(chosen)) for split, chosen in found.items()}
    _warn_of_shared_views(path, splits)
    return splits


def _warn_of_shared_views(path: Path, splits: Mapping[str, Sequence[int]]) -> None:
    """Warn if views are trained on and scored; validation and test may share views."""
    for split in SPLITS[1:]:
        scored = splits.get(split, ())
        if shared := set(scored) & set(splits.get("train", ())):
            warn(
                f"{path}: {len(shared)} of {len(scored)} views of {split}_filenames are in "
                "train_filenames as well: they are trained on, so scores on them say nothing of "
                "new views. Remove both lists to hold out every eighth frame."
            )
