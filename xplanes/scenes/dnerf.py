"""Scenes on disk in the format of D-NeRF and Blender: transforms_train.json and its images."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from xplanes.errors import MissingSplitError, SceneError
from xplanes.scenes.listing import Listing, read_splits, read_views, thinned
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.transforms import read_transforms
from xplanes.scenes.views import Scene

__all__ = ["SceneError", "read_scene"]

GET_DATA = (
    "Set data.root and data.scene to a folder that holds transforms_train.json, get the D-NeRF "
    "scenes with `xplanes download dnerf`, or take the built-in scene with data=demo."
)


@dataclass(frozen=True, kw_only=True)
class BlenderSettings(SceneSettings):
    """A scene on disk in the format of D-NeRF or Blender."""

    files: ClassVar = "transforms_train.json"

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        return (folder / "transforms_train.json").is_file()

    def load(self, splits: Sequence[str]) -> Scene:
        return read_scene(
            self.folder,
            resolution=self.resolution,
            splits=splits,
            views=self.views,
            eval_views=self.eval_views,
            cache=self.image_cache,
        )


def read_scene(
    folder: Path,
    *,
    resolution: int | None,
    splits: Sequence[str],
    views: int | None = None,
    eval_views: int | None = None,
    cache: Path | None = None,
) -> Scene:
    """Read a scene and check all of it, so that nothing fails after training has begun.

    Args:
        folder: Folder of transforms_train.json and the images.
        resolution: Width of the images in pixels; None keeps the native sizes.
        splits: Names of the splits to read, such as train, val, test.
        views: Number of views to keep of the train split, spread evenly over time;
            None keeps all.
        eval_views: The same for every other split, at most.
        cache: Folder of images that are too large for memory; that of the user when None.

    Returns:
        The scene, with ``video`` where transforms_video.json exists.

    Raises:
        SceneError: Anything is missing, damaged or inconsistent; the message says what to do.
    """
    folder = Path(folder)
    _check_folder(folder)
    paths = {split: _transforms_path(folder, split) for split in dict.fromkeys(splits)}
    listed = {split: _listed(split, path) for split, path in paths.items()}
    listed = thinned(listed, views, eval_views, folder)
    video = _list_video(folder)
    others = listed if video is None else {**listed, "video": video}
    _require_times(folder, listed.get("train"), others)
    told = any(part.mask_meaning for part in listed.values())
    read, _, notes = read_splits(listed, resolution, cache, "auto" if told else "alpha")
    return Scene(
        folder.resolve().name,
        read,
        video=None if video is None else read_views(video, resolution, cache),
        notes=notes,
    )


def _listed(split: str, path: Path) -> Listing:
    """The frames of a split; a warning tells why those of a split that is only scored are none."""
    try:
        return read_transforms(path)
    except MissingSplitError as problem:
        if split != "train":
            warnings.warn(f"The {split} split is left out. {problem}", stacklevel=4)
        raise


def _require_times(folder: Path, train: Listing | None, others: Mapping[str, Listing]) -> None:
    """Refuse frames of a moving scene that do not tell their times."""
    if train is None or len(train.times.unique()) == 1:
        return
    for split, listing in others.items():
        if not listing.timed:
            raise SceneError(
                f'No frame of {folder / f"transforms_{split}.json"} has a "time", but those of '
                "transforms_train.json have several. Give every frame its time."
            )


def _check_folder(folder: Path) -> None:
    if folder.is_dir():
        return
    kind = "is not a folder" if folder.exists() else "does not exist"
    root = next(parent for parent in folder.absolute().parents if parent.is_dir())
    names = _scenes_in(root)
    nearby = f"Scenes in {root}: {', '.join(names)}." if names else f"There is no scene in {root}."
    raise SceneError(f"The scene folder {folder.absolute()} {kind}. {nearby} {GET_DATA}")


def _transforms_path(folder: Path, split: str) -> Path:
    path = folder / f"transforms_{split}.json"
    if path.is_file():
        return path
    found = sorted(
        other.stem.removeprefix("transforms_") for other in folder.glob("transforms_*.json")
    )
    if not found:
        names = _scenes_in(folder)
        inside = f" Scenes inside it: {', '.join(names)}." if names else ""
        raise SceneError(f"{folder} holds no transforms_{split}.json.{inside} {GET_DATA}")
    way_out = "Add the file."
    if split == "test" and found == ["train"]:
        way_out = (
            "Move some of its frames into a file of that name: they are scored, not trained on."
        )
    if split != "train" and "val" in found:
        way_out = "Leave data.eval_split out, set it to val, or add the file."
    names = ", ".join(found)
    raise MissingSplitError(f"{path} does not exist. Splits of this scene: {names}. {way_out}")


def _scenes_in(folder: Path) -> list[str]:
    return sorted(path.parent.name for path in folder.glob("*/transforms_train.json"))


def _list_video(folder: Path) -> Listing | None:
    path = folder / "transforms_video.json"
    if not path.is_file():
        return None
    listing = read_transforms(path)
    poses = listing.camera_to_world
    if not poses.allclose(poses[:1].expand_as(poses), atol=1e-4):
        raise SceneError(
            f"{path} holds a camera that moves. It must hold the frames of one fixed camera: "
            f"correct it, or rename the file and it is not read."
        )
    return listing
