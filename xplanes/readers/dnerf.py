"""Scenes on disk in the format of D-NeRF and Blender: transforms_train.json and its images."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from xplanes.errors import MissingSplitError, SceneError, warn
from xplanes.readers.capture import scene_of, warn_of_masks
from xplanes.readers.entries import SPLIT_FOLDERS, spelt
from xplanes.readers.listing import Listing
from xplanes.readers.masks import MaskUse
from xplanes.readers.transforms import (
    all_masks,
    listing_of,
    numbers,
    read_frames,
    readable,
    time_span,
)
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Scene


@dataclass(frozen=True, kw_only=True)
class BlenderSettings(SceneSettings):
    """A scene on disk in the format of D-NeRF or Blender."""

    files: ClassVar = "transforms_train.json"
    numbers_are_times: ClassVar = True
    hint: ClassVar = (
        ", get the D-NeRF scenes with `xplanes download dnerf`, or take the built-in scene with "
        "data=demo"
    )

    # Use of masked-out pixels. alpha: empty space; ignore: neither trained on nor scored; auto:
    # alpha if masks look like silhouettes, else ignore; lrm: only the LRM's input is masked.
    mask_use: MaskUse

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        return (folder / "transforms_train.json").is_file()

    def load(self, splits: Sequence[str]) -> Scene:
        scene = read_scene(self, splits, self.mask_use)
        if "masks" not in scene.notes:
            files = [file for views in scene.splits.values() for file in views.files]
            warn_of_masks(self.folder, [self.folder / file for file in files])
        return scene


def read_scene(settings: SceneSettings, splits: Sequence[str], mask_use: MaskUse = "auto") -> Scene:
    """Read and check a whole scene, so that nothing fails after training has begun.

    Args:
        settings: Settings with its folder, which contains transforms_train.json and the images.
        splits: Names of the splits to read, such as train, val, test.
        mask_use: Meaning of the black parts of masks.

    Returns:
        The scene, with ``video`` if transforms_video.json exists.

    Raises:
        SceneError: If anything is missing, damaged or inconsistent; the message says what to do.
    """
    folder = settings.folder
    if not any(folder.glob("transforms_*.json")):
        raise settings.no_scene()
    paths = {split: _transforms_path(folder, split) for split in dict.fromkeys(splits)}
    # All parts share a unit of time, and the meaning of masks.
    parts = dict.fromkeys((*SPLIT_FOLDERS, *paths))
    contents = readable([folder / f"transforms_{part}.json" for part in parts])
    span = time_span(contents.values())
    numbered = numbers(contents) if settings.static is False else None

    def read(path: Path) -> Listing:
        return listing_of(path, read_frames(path), span, movable=False, numbered=numbered)

    listed = {split: _listed(split, path, read) for split, path in paths.items()}
    _warn_of_shared_files(folder, listed)
    listed = settings.thinned(listed)
    video = _list_video(folder / "transforms_video.json", read)
    _require_times(folder, listed if video is None else {**listed, "video": video})
    # Masks mean the same whichever parts are read.
    return scene_of(settings, listed, mask_use, all_masks(contents), video=video)


def _listed(split: str, path: Path, read: Callable[[Path], Listing]) -> Listing:
    """The frames of a split; if a scored split has none, warns before `MissingSplitError`."""
    try:
        return read(path)
    except MissingSplitError as problem:
        if split != "train":
            first, *others = str(problem).splitlines()  # BlenderNeRF writes cameras without images.
            more = " No other frame of it can be used either." if others else ""
            warn(f"The {split} split is left out. {first}{more}")
        raise


def _warn_of_shared_files(folder: Path, parts: Mapping[str, Listing]) -> None:
    """Warn if scored splits show files of training images, found under other names."""
    if (train := parts.get("train")) is None:
        return
    names = {image: spelt(name) for image, name in zip(train.paths, train.names, strict=True)}
    for split, part in parts.items():
        pairs = zip(part.paths, map(spelt, part.names), strict=True)
        if shared := [name for image, name in pairs if names.get(image, name) != name]:
            warn(
                f"{folder}: {len(shared)} of {len(part)} images of the {split} split, such as "
                f"{shared[0]}, are files of training images. If they are others, add them."
            )


def _require_times(folder: Path, parts: Mapping[str, Listing]) -> None:
    """Refuse splits and videos of a dynamic scene that have no times."""
    train = parts.get("train")
    if train is None or len(train.times.unique()) == 1:
        return
    for split, listing in parts.items():
        if not listing.time_source:
            raise SceneError(
                f'No frame of {folder / f"transforms_{split}.json"} has a "time", but those of '
                "transforms_train.json have several. Give every frame its time."
            )


def _transforms_path(folder: Path, split: str) -> Path:
    path = folder / f"transforms_{split}.json"
    if path.is_file():
        return path
    found = sorted(
        other.stem.removeprefix("transforms_") for other in folder.glob("transforms_*.json")
    )
    way_out = "Add the file."
    if split == "test" and found == ["train"]:
        way_out = (
            "Move some of its frames into a file of that name: they are scored, not trained on."
        )
    if split != "train" and "val" in found:
        way_out = "Leave data.eval_split out, set it to val, or add the file."
    names = ", ".join(found)
    raise MissingSplitError(f"{path} does not exist. Splits of this scene: {names}. {way_out}")


def _list_video(path: Path, read: Callable[[Path], Listing]) -> Listing | None:
    if not path.is_file():
        return None
    listing = read(path)
    poses = listing.camera_to_world
    if not poses.allclose(poses[:1].expand_as(poses), atol=1e-4):
        raise SceneError(
            f"{path} holds a camera that moves. It must hold the frames of one fixed camera: "
            f"correct it, or rename the file and it is not read."
        )
    return listing
