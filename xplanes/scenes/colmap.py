"""Captures that COLMAP has registered: a sparse model and its images."""

import csv
import logging
import re
import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import torch

from xplanes.errors import ConfigError, MissingSplitError, SceneError
from xplanes.files import natural
from xplanes.scenes.colmap_model import MODELS, SparseModel, find_model, read_model
from xplanes.scenes.entries import (
    image_path,
    is_number,
    mask_files,
    oriented,
    refuse_repeats,
    require_precision,
    short,
    some,
    unit_times,
)
from xplanes.scenes.formats import is_image
from xplanes.scenes.listing import (
    Listing,
    held_out,
    picked,
    read_splits,
    require_shapes,
    thinned,
    time_words,
)
from xplanes.scenes.masks import MaskUse
from xplanes.scenes.multicamera import recordings_of_cameras
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Scene
from xplanes.settings import Count

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ColmapSettings(SceneSettings):
    """A capture registered with COLMAP."""

    model: str | None  # Folder of the COLMAP model; null: sparse/0, sparse or colmap/sparse/0.
    images: str  # Folder of the images that COLMAP was run on.
    # Folder of masks: NAME.png for each image NAME, black outside the foreground; null for none.
    # Masks that hid moving objects from COLMAP would hide them here, too.
    masks: str | None
    # What masks leave out. alpha: is empty; ignore: is neither trained on nor scored; auto: alpha
    # where they look like silhouettes, else ignore; lrm: is cut from the LRM's input alone.
    mask_use: MaskUse
    # Times of the images: a CSV file with the columns file and time; rank: the order within each
    # camera's folder; null: the numbers in the file names.
    times: str | None
    # Regular expression whose group is the number in a file name, such as frame_(\d+); null: the
    # last number that is not a camera's, as in 034_cam1; all of a name such as 1305031102.175304.
    time_pattern: str | None
    test_cameras: list[str]  # Subfolders of the image folder that form the test split.
    # Hold out every n-th image as val, in order of time and file name; never the first or last.
    eval_every: Count
    orient: bool  # Rotate the world so that the cameras' mean up vector becomes its z axis.

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        # A model beside videos of several cameras is their calibration.
        return find_model(folder, MODELS[:2]) is not None and len(recordings_of_cameras(folder)) < 2

    def check(self) -> None:
        if self.time_pattern is None:
            return
        if self.times is not None:
            raise ConfigError(
                f"time_pattern={self.time_pattern}: file names tell no times where "
                f"times={self.times}; set one of both to null"
            )
        try:
            groups = re.compile(self.time_pattern).groups
        except re.error as problem:
            raise ConfigError(
                f"time_pattern={self.time_pattern}: is no regular expression ({problem}); write "
                r"one such as frame_(\d+)"
            ) from problem
        if groups != 1:
            raise ConfigError(
                f"time_pattern={self.time_pattern}: must have one group in brackets, the number, "
                rf"as in frame_(\d+); it has {groups}"
            )

    def load(self, splits: Sequence[str]) -> Scene:
        source = _model_folder(self.folder, self.model)
        if "test" in splits and not self.test_cameras:
            # Known before the model and all images are looked at.
            raise MissingSplitError(
                f"{source} has no test split. Name the folders of some cameras in "
                "data.test_cameras, or choose another data.eval_split."
            )
        model = read_model(source)
        listing, points = self._listing(model)
        chosen = picked(
            self._parts(listing),
            splits,
            model.source,
            "Name the folders of some cameras in data.test_cameras, lower data.eval_every="
            f"{self.eval_every}, or choose another data.eval_split.",
        )
        chosen = thinned(chosen, self.views, self.eval_views, self.folder)
        read, cut, notes = read_splits(
            chosen, self.resolution, self.image_cache, self.mask_use, listing
        )
        return Scene(self.folder.resolve().name, read, points=points, cut=cut, notes=notes)

    def _listing(self, model: SparseModel) -> tuple[Listing, torch.Tensor | None]:
        """All images of the capture, and the model's points."""
        images = self.folder / self.images
        if not images.is_dir():
            raise SceneError(
                f"{images} is not a folder. Set data.images to the folder, relative to that of the "
                "scene, that COLMAP was run on."
            )
        root = images.resolve()
        _require_files(model, images)
        labels = [f"{model.source}: {name}" for name in model.names]
        paths = [
            image_path(label, root, name, "NAME")
            for label, name in zip(labels, model.names, strict=True)
        ]
        present = {
            path.relative_to(root).as_posix()
            for path in root.rglob("*")
            if is_image(path) and path.is_file()
        }
        _warn_of_unregistered(sorted(present - set(model.names)), len(present), images)
        times, words = self._times(model.names, labels, present)
        poses, points = model.camera_to_world, model.points
        if self.orient:
            poses, points = oriented(poses, points, paths)
        require_precision(model.source, poses[:, :3, 3])
        refuse_repeats(labels, paths, poses, times)
        folders = [_camera(name) for name in model.names]
        listing = Listing(
            paths=tuple(paths),
            files=tuple((PurePosixPath(self.images) / name).as_posix() for name in model.names),
            camera_to_world=torch.from_numpy(poses).float(),
            times=torch.tensor(times or [0.0] * len(paths), dtype=torch.float32),
            calibrations=model.calibrations,
            timed=bool(times),
            masks=() if self.masks is None else self._masks(model.names, self.masks),
            cameras=tuple(folders) if any(folders) else (),
            time_words=words,
        )
        require_shapes(listing)
        return listing, None if points is None else torch.from_numpy(points).float()

    def _masks(self, names: Sequence[str], masks: str) -> tuple[Path | None, ...]:
        kinds = [
            (f"{name}.png", name, PurePosixPath(name).with_suffix(".png").as_posix())
            for name in names
        ]
        return mask_files(self.folder / masks, kinds)

    def _times(
        self, names: Sequence[str], labels: Sequence[str], present: set[str]
    ) -> tuple[list[float], str]:
        """Times from 0 to 1, and where they come from; none where the scene is static."""
        if self.static:
            return [], ""
        if self.times is None:
            found = _numbers(names, labels, self.time_pattern)
            if not found:
                return [], ""
            origin = "the numbers in their names"
        elif self.times == "rank":
            found = _ranks(names, present)
            origin = "their order in their folders"
        else:
            path = self.folder / self.times
            found = _listed_times(path, names)
            origin = str(path)
        logger.info(
            "The times of %d images, from 0 to 1, are %s, from %s to %s",
            *(len(names), origin, min(found), max(found)),
        )
        return unit_times(found), time_words(origin, names, found)

    def _parts(self, listing: Listing) -> dict[str, Listing]:
        """The capture by splits."""
        tested: set[int] = set()
        for camera in self.test_cameras:
            chosen = {
                place
                for place, name in enumerate(listing.cameras)
                if f"{name}/".startswith(f"{camera.strip('/')}/")
            }
            if not chosen:
                names = sorted(set(listing.cameras))
                raise SceneError(
                    f"data.test_cameras={camera}: {self.folder / self.images} has "
                    + (
                        f"no such folder. Folders with images: {some(names)}."
                        if names
                        else "no folders, one for each camera. Set data.test_cameras=[]."
                    )
                )
            tested |= chosen
        rest = listing.subset([place for place in range(len(listing)) if place not in tested])
        parts = {name: rest.subset(part) for name, part in held_out(rest, self.eval_every).items()}
        return parts | {"test": listing.subset(sorted(tested))}


def _model_folder(folder: Path, name: str | None) -> Path:
    """The folder of the sparse model."""
    names = MODELS if name is None else (name,)
    if (path := find_model(folder, names)) is not None:
        others = [
            other.name
            for other in path.parent.iterdir()
            if other != path and other.name.isdigit() and other.is_dir()
        ]
        if name is None and path.name == "0" and others:
            logger.warning(
                "%s holds %d models, because COLMAP could not join them all: %s is read. "
                "Choose another with data.model",
                *(path.parent, len(others) + 1, path),
            )
        return path
    if not folder.is_dir():
        raise SceneError(
            f"The folder {folder.absolute()} does not exist. Set data.root and data.scene to a "
            "folder that holds a COLMAP model and its images."
        )
    raise SceneError(
        f"{folder} holds no COLMAP model: there is no cameras.bin or cameras.txt in "
        f"{', '.join(names)}. Set data.model to the model's folder, relative to {folder}."
    )


def _camera(name: str) -> str:
    """The folder of an image, which holds those of one camera; empty where there is none."""
    folder = PurePosixPath(name).parent.as_posix()
    return "" if folder == "." else folder


def _require_files(model: SparseModel, images: Path) -> None:
    missing = [name for name in model.names if not (images / name).is_file()]
    if missing:
        raise SceneError(
            f"{len(missing)} of {len(model.names)} images that {model.source} lists are not in "
            f"{images}: {some(missing)}. Put them there, or set data.images to the folder that "
            "COLMAP was run on."
        )


def _warn_of_unregistered(names: Sequence[str], count: int, images: Path) -> None:
    if names:
        logger.warning(
            "%d of %d images in %s are not used, because COLMAP did not register them: %s",
            *(len(names), count, images, some(names)),
        )


def _number(text: str) -> float | None:
    """A finite number, whole where it is written so."""
    for kind in (int, float):
        try:
            number = kind(text)
        except ValueError:
            continue
        return number if is_number(number) else None
    return None


def _time_in(stem: str) -> str | None:
    """The number in a name that tells its time: the whole name, or the last one in it.

    A number of the camera at the end is none of time, as in 034_cam1.
    """
    if re.fullmatch(r"\d+\.\d+", stem):
        return stem
    without = re.sub(r"(?i)[_\-. ]*(cam|camera)[_\- ]*\d+$", "", stem)
    return (re.findall(r"\d+", without) or re.findall(r"\d+", stem) or [None])[-1]


def _numbers(names: Sequence[str], labels: Sequence[str], pattern: str | None) -> list[float]:
    """The number in each name; none, with a warning, where they tell no times."""
    if pattern is None and (why := _no_series(names)):
        warnings.warn(f"{why}: all images are taken for one timestep. {_OTHER_TIMES}", stacklevel=5)
        return []
    found: list[float] = []
    for name, label in zip(names, labels, strict=True):
        if pattern is None:
            text = _time_in(PurePosixPath(name).stem)
        else:
            match = re.search(pattern, name)
            text = None if match is None else match[1]
        number = None if text is None else _number(text)
        if number is None:
            wanted = f"no number where data.time_pattern={pattern} has its group"
            raise SceneError(f"{label} has {wanted}. {_OTHER_TIMES}")
        found.append(number)
    if len(names) > 1 and len(set(found)) == 1:
        raise SceneError(
            f"The names of all {len(names)} images, such as {names[0]}, give the number {found[0]} "
            f"for their time. {_OTHER_TIMES}"
        )
    return found


def _no_series(names: Sequence[str]) -> str | None:
    """Why names are not those of a series of images, such as hashes; None if they are."""
    stems = [PurePosixPath(name).stem for name in names]
    bare = [name for name, stem in zip(names, stems, strict=True) if _time_in(stem) is None]
    if bare:
        return f"The names of {len(bare)} of {len(names)} images have no number, such as {bare[0]}"
    # All names of a series are equal but for their numbers.
    kinds = {re.sub(r"\d+", "#", stem) for stem in stems}
    if len(kinds) > max(4, len(names) // 2):
        return f"The names of the images, such as {some(names)}, differ in more than their numbers"
    numbers = {_time_in(stem) for stem in stems}
    if len(names) > 1 and len(numbers) == 1:
        return f"The names of all {len(names)} images, such as {names[0]}, give one number"
    return None


_OTHER_TIMES = (
    r"Set data.time_pattern to a regular expression for the names, such as frame_(\d+), data.times "
    "to a CSV file with the columns file and time, or, for a static scene, data.static=true."
)


def _ranks(names: Sequence[str], present: set[str]) -> list[float]:
    """The place of each image in its folder, images that COLMAP did not register included."""
    folders: dict[str, list[str]] = defaultdict(list)
    for name in present | set(names):
        folders[_camera(name)].append(name)
    places: dict[str, float] = {}
    for inside in folders.values():
        # frame_10 comes after frame_9.
        inside.sort(key=natural)
        places |= {name: place for place, name in enumerate(inside)}
    counts = {len(folders[_camera(name)]) for name in names}
    if len(counts) > 1:
        logger.warning(
            "The cameras' folders hold %d to %d images. Those of one rank are taken to show one "
            "time: if frames are missing, set data.times to a CSV file",
            *(min(counts), max(counts)),
        )
    return [places[name] for name in names]


def _listed_times(path: Path, names: Sequence[str]) -> list[float]:
    """The time of each image from a CSV file."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise SceneError(
            f"data.times={path} cannot be read as CSV ({problem}). Write one line for each image, "
            "with the columns file and time, or set data.times=null."
        ) from problem
    known: dict[str, float] = {}
    for line, row in enumerate(rows, start=2):
        file, time = row.get("file"), row.get("time")
        if file is None or time is None:
            raise SceneError(
                f"{path}: line {line} has no {'file' if file is None else 'time'}. The first line "
                "must name the columns file and time; each further line must fill both."
            )
        number = _number(time)
        if number is None:
            raise SceneError(
                f"{path}: line {line} gives {file} the time {short(time)}; it must be a number, in "
                "any unit."
            )
        if known.setdefault(file, number) != number:
            raise SceneError(
                f"{path}: line {line} gives {file} the time {time}, an earlier one {known[file]}. "
                "Remove one of them."
            )
    if bare := [name for name in names if name not in known]:
        raise SceneError(
            f"{path} has no time for {len(bare)} of {len(names)} images: {some(bare)}. Add a line "
            "for each, with the name that COLMAP has for it."
        )
    return [known[name] for name in names]
