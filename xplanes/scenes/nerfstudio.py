"""Captures in the format of nerfstudio and instant-ngp: one transforms.json and its images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from xplanes.errors import BrokenFrameError, MissingSplitError, SceneError
from xplanes.scenes.entries import image_path, short
from xplanes.scenes.listing import Listing, held_out, read_splits, thinned
from xplanes.scenes.masks import MaskUse
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.transforms import listing_of, read_frames
from xplanes.scenes.views import Scene
from xplanes.settings import Count

SPLITS = ("train", "val", "test")

OTHER_AXES = ("from_mitsuba", "from_na")
"""Keys with which instant-ngp and NeuS2 mark poses whose axes are not OpenGL's."""


@dataclass(frozen=True, kw_only=True)
class NerfstudioSettings(SceneSettings):
    """A capture in the format of nerfstudio or instant-ngp."""

    files: ClassVar = "transforms.json"

    # Hold out every n-th frame as val, in order of time and file name; never the first or last.
    # Splits listed in the capture (train_filenames, ...) take precedence.
    eval_every: Count
    # What masks leave out. alpha: is empty; ignore: is neither trained on nor scored; auto: alpha
    # where they look like silhouettes, else ignore; lrm: is cut from the LRM's input alone.
    mask_use: MaskUse

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        return (folder / "transforms.json").is_file()

    def load(self, splits: Sequence[str]) -> Scene:
        return read_capture(
            self.folder,
            resolution=self.resolution,
            splits=splits,
            eval_every=self.eval_every,
            mask_use=self.mask_use,
            views=self.views,
            eval_views=self.eval_views,
            cache=self.image_cache,
        )


def read_capture(
    folder: Path,
    *,
    resolution: int | None,
    splits: Sequence[str],
    eval_every: int = 8,
    mask_use: MaskUse = "auto",
    views: int | None = None,
    eval_views: int | None = None,
    cache: Path | None = None,
) -> Scene:
    """Read a capture and check all of it.

    Poses are taken as they stand: ``applied_transform``, ``applied_scale``, ``scale``, ``offset``
    and ``aabb_scale`` tell where the world lies in other programs, but the field's frame is found
    from the cameras. Times in any unit are mapped to [0, 1] over all frames, of whichever split.

    Args:
        folder: Folder of transforms.json.
        resolution: Width of the images in pixels; None keeps the native sizes.
        splits: Names of the splits to read: train, val, test.
        eval_every: Where the file lists no splits, one frame in ``eval_every`` goes to val.
        mask_use: What the black parts of masks are.
        views: Number of views to keep of the train split, spread evenly over time;
            None keeps all.
        eval_views: The same for every other split, at most.
        cache: Folder of images that are too large for memory; that of the user when None.

    Raises:
        MissingSplitError: If there is no split of a name.
        SceneError: Anything else is missing, damaged or inconsistent.
    """
    folder = Path(folder)
    path = folder / "transforms.json"
    if not path.is_file():
        raise _no_capture(folder)
    content = read_frames(path)
    for key in OTHER_AXES:
        if content.get(key):
            raise SceneError(
                f"{path}: {key}={short(content[key])} stands for poses with other axes than "
                "OpenGL's (x right, y up, z backward). Convert transform_matrix, and take the key "
                "out."
            )
    listing = listing_of(path, content, any_unit=True)
    parts = _listed_splits(path, content, listing) or held_out(listing, eval_every)
    chosen = {}
    for split in dict.fromkeys(splits):
        if not parts.get(split):
            raise _no_split(path, split, parts, eval_every)
        chosen[split] = listing.subset(parts[split])
    chosen = thinned(chosen, views, eval_views, folder)
    read, cut, notes = read_splits(chosen, resolution, cache, mask_use, listing)
    return Scene(folder.resolve().name, read, cut=cut, notes=notes)


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
                    continue  # A warning told of it.
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


def _no_split(
    path: Path, split: str, parts: Mapping[str, list[int]], eval_every: int
) -> SceneError:
    names = ", ".join(name for name in parts if parts[name])
    if split == "train":
        return SceneError(f'{path} has no frames to train on: fill "train_filenames".')
    way_out = (
        "Leave data.eval_split out, set it to val, or list "
        if split == "test" and parts.get("val")
        else f"Set data.eval_every below {eval_every}, or list "
        if "val" in parts and len(parts["train"]) > 2 and eval_every > 1
        else "The first and the last frame are never held out. List "
        if "val" in parts
        else "List "
    )
    return MissingSplitError(
        f"{path} has no {split} split. Splits of this capture: {names}. {way_out}"
        f'"{split}_filenames" in the file.'
    )


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
