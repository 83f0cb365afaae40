"""Captures in the format of LLFF: poses_bounds.npy, and a folder with one image per row."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from xplanes.readers.capture import CaptureSettings
from xplanes.readers.colmap import ColmapSettings
from xplanes.readers.entries import read_array, unit_times
from xplanes.readers.formats import is_image
from xplanes.readers.images import native_sizes, width_rank
from xplanes.readers.listing import Listing, held_out, time_source
from xplanes.readers.name_times import times_in_names
from xplanes.readers.rigs import POSES, STATIC, is_dynamic, read_poses_bounds, recordings_of_cameras
from xplanes.scenes.views import Scene

OTHER_TIMES = (
    "Rename the images by their times, in the order of the rows, or, for a static scene, set "
    "data.static=true."
)


@dataclass(frozen=True, kw_only=True)
class LlffSettings(CaptureSettings):
    """A capture in the format of LLFF; static unless it has folders of a dynamic scene."""

    files: ClassVar = "poses_bounds.npy and a folder images with an image for each of its rows"
    numbers_are_times: ClassVar = True

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        if not (folder / POSES).is_file() or recordings_of_cameras(folder):
            return False
        # As in Mip-NeRF 360's captures, COLMAP's model, which has lenses and points, is preferred.
        kept = is_dynamic(folder) or not ColmapSettings.recognises(folder)
        return kept and bool(_image_folders(folder))

    def load(self, splits: Sequence[str]) -> Scene:
        path = self.folder / POSES
        if not (path.is_file() and (found := _image_folders(self.folder))):
            raise self.no_scene()
        count = len(read_array(path, "Export or download it again."))
        # A folder of copies may lack some.
        found = [images for images in found if len(images) == count] or found
        images = min(
            found, key=lambda each: width_rank(native_sizes(each[:1])[0][1], self.resolution)
        )
        rows = read_poses_bounds(path, images)
        images = [row.source for row in rows]
        names = [image.name for image in images]
        dynamic = self.static is False or is_dynamic(self.folder)
        times = times_in_names(names, True, OTHER_TIMES) if dynamic else []
        listing = Listing.checked(
            path,
            [row.label for row in rows],
            images,
            np.stack([row.pose for row in rows]),
            unit_times(times) if times else [],
            files=tuple(image.relative_to(self.folder).as_posix() for image in images),
            calibrations=tuple(row.calibration for row in rows),
            time_source=time_source("the numbers in their names", names, times)
            if times
            else STATIC,
        )
        return self.capture(listing, held_out(listing, self.eval_every), splits, path)


def _image_folders(folder: Path) -> list[list[Path]]:
    """The images of each folder called images, images_4 and so on, in LLFF's order."""
    found = [path for path in folder.glob("images*") if path.is_dir()]
    listed = [sorted(filter(is_image, path.iterdir())) for path in sorted(found)]
    return [images for images in listed if images]
