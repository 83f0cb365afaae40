"""Captures registered with COLMAP: a sparse model and its images."""

import csv
import logging
import math
import os
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import ClassVar

from xplanes.errors import ConfigError, MissingSplitError, SceneError, some, warn
from xplanes.files import natural
from xplanes.readers.capture import CaptureSettings
from xplanes.readers.colmap_model import (
    MODELS,
    SparseModel,
    find_model,
    image_count,
    models_inside,
    read_model,
)
from xplanes.readers.entries import (
    decoded,
    image_path,
    mask_files,
    number_in,
    short,
    spelt,
    unit_times,
    usable,
)
from xplanes.readers.formats import is_image
from xplanes.readers.listing import Listing, held_out, time_source
from xplanes.readers.name_times import OTHER_TIMES, times_in_names
from xplanes.readers.rigs import POSES, STATIC, are_registered, is_dynamic, recordings_of_cameras
from xplanes.scenes.views import Scene
from xplanes.settings import Location

logger = logging.getLogger(__name__)

DOUBTFUL = 1.0
"""Mean reprojection error in pixels above which COLMAP's cameras are worth refining."""

USUAL = "images"
"""Default folder of images."""


@dataclass(frozen=True, kw_only=True)
class ColmapSettings(CaptureSettings):
    """A capture registered with COLMAP."""

    files: ClassVar = "sparse/0 with cameras.bin and images.bin (or .txt), and images"
    numbers_are_times: ClassVar = True
    more_splits: ClassVar = ", or name the folders of some cameras in data.test_cameras"

    # Folder of the COLMAP model; null: sparse/0 (or the largest beside it), sparse or
    # colmap/sparse/0.
    model: Location | None
    images: Location  # Folder of the images that COLMAP was run on.
    # Folder of masks: NAME.png for each image NAME, black outside the foreground; null for none.
    # Masks that removed moving objects for COLMAP would remove them here, too.
    masks: Location | None
    # Times of the images: a CSV file with the columns file and time; rank: the order within each
    # camera's folder; null: the numbers in the file names.
    times: Location | None
    # Regular expression whose group is the number in a file name, such as frame_(\d+); null: a date
    # with the time of day, seconds with a fraction, or else the number that differs most among the
    # names and is not a camera's, as in 034_cam1.
    time_pattern: str | None
    test_cameras: list[str]  # Subfolders of the image folder that form the test split.

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        # A model beside videos of several cameras is their calibration.
        if len(recordings_of_cameras(folder)) > 1 or are_registered(folder):
            return False
        if find_model(folder, MODELS[:2]) is not None:
            return True
        # A transforms.json that was converted from the model takes precedence.
        others = any(folder.glob("transforms*.json")) or (folder / "dataset.json").is_file()
        return not others and bool(find_model(folder) or len(models_inside(folder)) == 1)

    def check(self) -> None:
        super().check()
        if self.time_pattern is None:
            return
        if self.times is not None:
            raise ConfigError(
                f"time_pattern={self.time_pattern}: times are not read from file "
                f"names with times={self.times}; set one of the two to null"
            )
        try:
            groups = re.compile(self.time_pattern).groups
        except re.error as problem:
            raise ConfigError(
                f"time_pattern={self.time_pattern}: is not a regular expression ({problem}); write "
                r"one such as frame_(\d+)"
            ) from problem
        if groups != 1:
            raise ConfigError(
                f"time_pattern={self.time_pattern}: must have one group in brackets, the number, "
                rf"as in frame_(\d+); it has {groups}"
            )

    def load(self, splits: Sequence[str]) -> Scene:
        if not self.folder.is_dir():
            raise self.no_scene()
        if "test" in splits and not self.test_cameras:
            # Checked before the model, whose choice may be reported, and the images are read.
            raise MissingSplitError(
                f"{self.folder} has no test split. Name the folders of some cameras in "
                "data.test_cameras, or choose another data.eval_split."
            )
        model = read_model(_model_folder(self.folder, self.model))
        listing = self._listing(model)
        points = model.points
        scene = self.capture(listing, self._places(listing), splits, model.source, points)
        notes = dict(scene.notes)
        if self._as_llff:
            notes["poses"] = f"those of COLMAP; data=llff reads {POSES}"
        if points is not None and not math.isnan(model.error):
            words = f"{len(points)}, {model.error:.2f} px from where images show them on average"
            if model.error > DOUBTFUL:
                words += "; data.refine_cameras=true corrects the cameras in training"
            notes["points"] = words
        return replace(scene, notes=notes)

    @property
    def _as_llff(self) -> bool:
        """Whether the capture is one of LLFF's static ones, too, as in Mip-NeRF 360."""
        return (self.folder / POSES).is_file() and not is_dynamic(self.folder)

    def _listing(self, model: SparseModel) -> Listing:
        """All images of the capture."""
        images = _image_folder(self.folder, self.images, model)
        root = images.resolve()

        def image_of(place: int) -> tuple[int, Path]:
            name = model.names[place]
            return place, image_path(f"{model.source}: {name}", root, name, "NAME")

        kept, paths = zip(*usable("images", image_of, range(len(model.names))), strict=True)
        names = tuple(model.names[place] for place in kept)
        labels = [f"{model.source}: {name}" for name in names]
        # The search does not enter folders that are links.
        found = {*root.rglob("*")}.union(*(place.iterdir() for place in {p.parent for p in paths}))
        present = {
            path.relative_to(root).as_posix() for path in found if is_image(path) and path.is_file()
        }
        used = [path.relative_to(root).as_posix() for path in paths]
        if rest := sorted(present.difference(used)):
            logger.warning(
                "%d of %d images in %s are not used, because COLMAP did not register them: %s",
                *(len(rest), len(present), images, some(rest)),
            )
        times, source = self._times(names, labels, used, present)
        return Listing.checked(
            model.source,
            labels,
            paths,
            model.camera_to_world[[*kept]],
            times,
            files=tuple((_shown(images, self.folder) / name).as_posix() for name in used),
            calibrations=tuple(model.calibrations[place] for place in kept),
            masks=() if self.masks is None else self._masks(names, self.masks),
            time_source=source,
            names=names,
        )

    def _masks(self, names: Sequence[str], masks: str) -> tuple[Path | None, ...]:
        kinds = [
            (name, stem, f"{stem}_mask", f"{stem}.mask")
            for name in names
            if (stem := PurePosixPath(name).with_suffix("").as_posix())
        ]
        return mask_files(self.folder / masks, kinds)

    def _times(
        self, names: Sequence[str], labels: Sequence[str], used: Sequence[str], present: set[str]
    ) -> tuple[list[float], str]:
        """Times from 0 to 1, and their source; no times if the scene is static."""
        if self.static:
            return [], ""
        origin = "the numbers in their names"
        if self.times == "rank":
            found, origin = _ranks(used, present), "their order in their folders"
        elif self.times is not None:
            path = self.folder / self.times
            found, origin = _listed_times(path, names), str(path)
        elif self.time_pattern is not None:
            found = _matched(names, labels, self.time_pattern)
        elif self.static is None and self._as_llff:
            return [], STATIC
        elif not (found := times_in_names(names, dynamic=self.static is False)):
            return [], ""
        logger.info(
            "The times of %d images, from 0 to 1, are %s, from %s to %s",
            *(len(names), origin, min(found), max(found)),
        )
        return unit_times(found), time_source(origin, names, found)

    def _places(self, listing: Listing) -> dict[str, list[int]]:
        folders, tested = [_camera(name) for name in listing.names], set[int]()
        for camera in self.test_cameras:
            inside = f"{camera.strip('/')}/"
            chosen = {at for at, name in enumerate(folders) if f"{name}/".startswith(inside)}
            if not chosen:
                names = sorted({*folders} - {""})
                raise SceneError(
                    f"data.test_cameras={camera}: {self.folder / self.images} has "
                    + (
                        f"no such folder. Folders with images: {some(names)}."
                        if names
                        else "no folders, one for each camera. Set data.test_cameras=[]."
                    )
                )
            tested |= chosen
        rest = [place for place in range(len(listing)) if place not in tested]
        parts = held_out(listing.subset(rest), self.eval_every)
        places = {split: [rest[at] for at in part] for split, part in parts.items()}
        return places | {"test": sorted(tested)}


def _model_folder(folder: Path, name: str | None) -> Path:
    names = MODELS if name is None else (name,)
    if (path := find_model(folder, names)) is not None:
        if name is None and path.name == "0":
            path = _largest(path)
        return path
    found = models_inside(folder) if name is None else []
    if len(found) == 1:
        logger.info("The model is read from %s (data.model)", found[0])
        return found[0]
    if found:
        inside = [path.relative_to(folder).as_posix() for path in found]
        raise SceneError(
            f"{folder} holds {len(found)} COLMAP models: {some(inside)}. Choose one with "
            "data.model."
        )
    raise SceneError(
        f"{folder} holds no COLMAP model: there is no cameras.bin or cameras.txt in "
        f"{', '.join(names)}. Set data.model to the model's folder, relative to {folder}."
    )


def _largest(first: Path) -> Path:
    """The numbered model with the most images among ``first`` and its siblings."""
    numbered = (path for path in models_inside(first.parent) if path.name.isdigit())
    if not (others := [path for path in numbered if path != first]):
        return first
    counts = {path: image_count(path) for path in (first, *others)}
    largest = max(counts, key=lambda path: counts[path])
    each = ", ".join(f"{path.name} has {count}" for path, count in counts.items())
    warn(
        f"{first.parent} holds {len(counts)} models, because COLMAP could not join them all. "
        f"{largest} is read, which has the most images ({each}). Choose another with data.model."
    )
    return largest


def _camera(name: str) -> str:
    """The folder of an image, which holds the images of one camera; empty if there is none."""
    folder = PurePosixPath(name).parent.as_posix()
    return "" if folder == "." else folder


def _image_folder(folder: Path, name: str, model: SparseModel) -> Path:
    """The folder of the images of a model.

    This is the nearest folder ``name`` in or above the model's folder. For the default name, it may
    also be the only folder of the scene that contains the images, such as input.

    Raises:
        SceneError: If there is none.
    """
    places = [place for place in model.source.parents if place.is_relative_to(folder)]
    for place in (*places, folder):
        if (place / name).is_dir():
            return place / name
    holding = [
        place
        for place in (Path(place) for place, *_ in os.walk(folder) if name == USUAL)
        if all((place / image).is_file() for image in model.names[:3])
    ]
    if len(holding) == 1:
        logger.info("Images are read from %s (data.images)", holding[0])
        return holding[0]
    names = [place.relative_to(folder).as_posix() for place in holding]
    raise SceneError(
        f"{folder / name} is not a folder. Set data.images to the folder, relative to that of the "
        "scene, that COLMAP was run on"
        + (f": {' or '.join(names)}." if names else f", with images such as {model.names[0]}.")
    )


def _shown(images: Path, folder: Path) -> Path:
    """The folder of images as it is in tables: relative to the scene's if it lies inside."""
    images, folder = images.absolute(), folder.absolute()
    return images.relative_to(folder) if images.is_relative_to(folder) else Path(images.name)


def _matched(names: Sequence[str], labels: Sequence[str], pattern: str) -> list[float]:
    """The number in each name that matches the pattern's group."""
    found: list[float] = []
    for name, label in zip(names, labels, strict=True):
        match = re.search(pattern, name)
        number = None if match is None else number_in(match[1] or "")
        if number is None:
            raise SceneError(
                f"{label} has no number where data.time_pattern={pattern} has its group. "
                f"{OTHER_TIMES}"
            )
        found.append(number)
    if len(names) > 1 and len(set(found)) == 1:
        raise SceneError(
            f"The names of all {len(names)} images, such as {names[0]}, contain the same time, "
            f"{found[0]}. {OTHER_TIMES}"
        )
    return found


def _ranks(names: Sequence[str], present: set[str]) -> list[float]:
    """The rank of each image file in its folder, counting files that COLMAP did not register."""
    folders: dict[str, list[str]] = defaultdict(list)
    for name in present | set(names):
        folders[_camera(name)].append(name)
    places: dict[str, float] = {}
    for inside in folders.values():
        # In natural order, frame_10 comes after frame_9.
        inside.sort(key=natural)
        places |= {name: place for place, name in enumerate(inside)}
    counts = {len(folders[_camera(name)]) for name in names}
    if len(counts) > 1:
        logger.warning(
            "The cameras' folders hold %d to %d images. Images of equal rank are treated as "
            "simultaneous: if frames are missing, set data.times to a CSV file",
            *(min(counts), max(counts)),
        )
    return [places[name] for name in names]


def _listed_times(path: Path, names: Sequence[str]) -> list[float]:
    """The time of each image from a CSV file."""
    try:
        header, *lines = decoded(path.read_bytes()).splitlines(keepends=True) or [""]
        mark = max(",;\t", key=header.count)  # Spreadsheets may write semicolons.
        keys = [key.strip(' "\r\n').lower() for key in header.split(mark)]
        rows = list(csv.DictReader(lines, keys, delimiter=mark, skipinitialspace=True))
    except (OSError, ValueError, csv.Error) as problem:
        raise SceneError(
            f"data.times={path} cannot be read as CSV ({problem}). Write one line for each image, "
            "with the columns file and time, or set data.times=null."
        ) from problem
    known: dict[str, float] = {}
    for line, row in enumerate(rows, start=2):
        file, time = row.get("file"), row.get("time") or ""
        number = number_in(time if mark == "," else time.replace(",", "."))
        if file is None or number is None:
            raise SceneError(
                f"{path}: line {line} is {short(row)}. The first line must name the columns file "
                "and time; each further line must fill both, with a time that is a number."
            )
        if known.setdefault(file, number) != number:
            raise SceneError(
                f"{path}: line {line} gives {file} the time {number}, an earlier one "
                f"{known[file]}. Remove one of them."
            )
    stems = {PurePosixPath(spelt(file)).stem: time for file, time in known.items()}
    own = [PurePosixPath(name).stem for name in names]
    if len(stems) == len(known) and len({*own}) == len(own):  # Of other folders, or no ending.
        known |= {name: stems[stem] for name, stem in zip(names, own, strict=True) if stem in stems}
    if bare := [name for name in names if name not in known]:
        raise SceneError(
            f"{path} has no time for {len(bare)} of {len(names)} images: {some(bare)}. Add a line "
            "for each, with the name that COLMAP has for it."
        )
    return [known[name] for name in names]
