"""Captures in the format of nerfstudio and instant-ngp: one transforms.json and its images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from xplanes.errors import BrokenFrameError, SceneError
from xplanes.scenes.entries import image_path, short
from xplanes.scenes.listing import Listing, held_out
from xplanes.scenes.source import CaptureSettings
from xplanes.scenes.transforms import listing_of, read_frames
from xplanes.scenes.views import Scene

SPLITS = ("train", "val", "test")

OTHER_AXES = ("from_mitsuba", "from_na")
"""Keys with which instant-ngp and NeuS2 mark poses whose axes are not OpenGL's."""


@dataclass(frozen=True, kw_only=True)
class NerfstudioSettings(CaptureSettings):
    """A capture in the format of nerfstudio or instant-ngp."""

    files: ClassVar = "transforms.json"

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        return (folder / "transforms.json").is_file()

    def load(self, splits: Sequence[str]) -> Scene:
        """Read a capture and check all of it.

        Poses are taken as they stand: ``applied_transform``, ``applied_scale``, ``scale``,
        ``offset`` and ``aabb_scale`` say where the world lies in other programs, but the field's
        frame is estimated from the cameras. Times in any unit are mapped to [0, 1] over all frames,
        of whichever split.
        """
        path = self.folder / "transforms.json"
        if not path.is_file():
            raise _no_capture(self.folder)
        content = read_frames(path)
        for key in OTHER_AXES:
            if content.get(key):
                raise SceneError(
                    f"{path}: {key}={short(content[key])} stands for poses with other axes than "
                    "OpenGL's (x right, y up, z backward). Convert transform_matrix, and take the "
                    "key out."
                )
        listing = listing_of(path, content, any_unit=True)
        places = _listed_splits(path, content, listing) or held_out(listing, self.eval_every)
        if "train" in splits and not places.get("train"):
            raise SceneError(f'{path} has no frames to train on: fill "train_filenames".')
        missing = next((split for split in splits if not places.get(split)), "")
        way_out = _way_out(missing, places, self.eval_every)
        return self.capture(listing, places, splits, path, way_out)


def _listed_splits(
    path: Path, content: Mapping[str, Any], listing: Listing
) -> dict[str, list[int]] | None:
    """Places of the frames that the file lists for each split; None where it lists none."""
    listed = {split: content.get(f"{split}_filenames") for split in SPLITS}
    if all(names is None for names in listed.values()):
        return None
    places = {image: index for index, image in enumerate(listing.paths)}
    owner: dict[int, str] = {}
    found: dict[str, list[int]] = {}
    for split, names in listed.items():
        key = f"{split}_filenames"
        if names is None:
            continue
        if not isinstance(names, list):
            raise SceneError(f"{path}: {key} is {short(names)}, not a list of file names.")
        for name in names:
            try:
                image = image_path(str(path), path.parent.resolve(), name, key)
            except BrokenFrameError:
                if name in {frame["file_path"] for frame in content["frames"]}:
                    continue  # There was a warning of it.
                raise
            if image not in places:
                raise SceneError(
                    f"{path}: {key} names {name}, which no frame shows. Add the frame, or take the "
                    "name out."
                )
            # Validation and test views may be the same ones.
            other = owner.setdefault(places[image], key)
            if other != key and "train_filenames" in (other, key):
                raise SceneError(
                    f"{path}: {name} is in {other} and in {key}. Views that are scored must not be "
                    "trained on: take it out of one of them."
                )
            found.setdefault(split, []).append(places[image])
    return {split: sorted(set(chosen)) for split, chosen in found.items()}


def _way_out(split: str, places: Mapping[str, list[int]], eval_every: int) -> str:
    """What makes a split that is missing."""
    way_out = "List"
    if split == "test" and places.get("val"):
        way_out = "Leave data.eval_split out, set it to val, or list"
    elif "val" in places and len(places["train"]) > 2 and eval_every > 1:
        way_out = f"Set data.eval_every below {eval_every}, or list"
    elif "val" in places:
        way_out = "The first and the last frame are never held out. List"
    return f'{way_out} "{split}_filenames" in the file.'


def _no_capture(folder: Path) -> SceneError:
    if (folder / "transforms_train.json").is_file():
        return SceneError(
            f"{folder} holds transforms_train.json, not transforms.json: read it with data=blender."
        )
    there = "does not exist" if not folder.exists() else "holds no transforms.json"
    root = next(parent for parent in folder.absolute().parents if parent.is_dir())
    names = sorted(path.parent.name for path in root.glob("*/transforms.json"))
    nearby = f"Captures in {root}: {', '.join(names)}. " if names else ""
    return SceneError(
        f"The folder {folder.absolute()} {there}. {nearby}Set data.root and data.scene to a folder "
        "with the transforms.json of ns-process-data or of instant-ngp's colmap2nerf.py."
    )
