"""Times of images from the numbers in their names."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import PurePosixPath
from statistics import median

from xplanes.errors import some, warn
from xplanes.files import natural

OTHER_TIMES = (
    r"Set data.time_pattern to a regular expression for the names, such as frame_(\d+), data.times "
    "to a CSV file with the columns file and time, or, for a static scene, data.static=true."
)

FEW = 0.5
"""Ratio of distinct times to images in a folder below which times are suspicious."""

CAMERA = re.compile(
    r"(?i)(?<![a-z])(cam|camera|view|lens|sensor|rig|device|kinect)s?[_\- ]*\d+(?![a-z\d])"
    r"|(?<![^_\-. ])[cv]\d+(?=$|[_\-. ])"
)
"""The number of a camera, as in 034_cam1."""

CLIP = re.compile(r"(?i)[cv]\d{3,}")
"""The number of a clip or a frame rather than of a camera."""

SIDE = re.compile(
    r"(?i)(?<![a-z])(left|right|top|bottom|front|back|rear|cent(er|re)|middle)(?![a-z])"
)
"""The name of a camera by its place, as in left_0001."""

FRAME = re.compile(r"(?i)\d{4}|^[cv]\d{3}")
"""A number that may be of a frame even after the word for a camera, as in cam_0001."""

MOST_CAMERAS = 64
"""Number of images up to which numbers of cameras are taken for these, as in cam00 to cam19."""

SIGN = r"(?:(?:(?<=[_ ])|^)-)?"
"""The sign of a number at the beginning of a name, or after a separator."""

CLOCK = re.compile(
    rf"{SIGN}(?<![A-Za-z\d])\d+\.\d+(?=s?$)|(?<!\d)(\d{{10}})[_-](\d{{9}}|\d{{6}}|\d{{3}})$"
)
"""Seconds and their fraction at the end of a name, as in 1305031102.175304."""

DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_.T ]*(?:at )?"
    r"(\d\d|\d(?=[-_.:]\d\d[-_.:]))[-_.:h]?(\d\d)[-_.:m]?(\d\d)[s.]?(\d*)"
    r"(?:[\s_.-]?(?i:(?P<half>[ap])\.?m\b))?"
)
"""Date and time of day, with parts of a second or before or after noon, as in
PXL_20260102_115959250 and 2026-01-02 at 1.59.59 PM."""

MILLISECONDS = re.compile(DATE.pattern + r"[_-](?P<part>\d{3})(?!\d)")
"""Date, time of day and perhaps milliseconds, as in IMG_20260102_115959_250."""

LEAST_STEP = 10
"""Least median interval between images of one second, in milliseconds."""

COPY = re.compile(r"\s*\((\d+)\)$")
"""The number that browsers and file managers add to names of copies, as in clip_1(3)."""

NUMBER = rf"{SIGN}\d+"
"""A whole number."""

Number = int | float


def times_in_names(
    names: Sequence[str], dynamic: bool = False, advice: str = OTHER_TIMES
) -> list[Number]:
    """Times of images, in any unit, from their names; empty, with a warning, if there are none.

    Times are dates with the time of day, seconds with a fraction, or else the number that varies
    most among the names and is not that of a camera. Warns, with examples, if times are not in the
    order of the names, may be numbers of cameras, or if there are far fewer times than images.

    Args:
        names: Names of the images, with their folders. [V]
        dynamic: Whether the scene is known to change, so that numbers of cameras may be times.
        advice: How to give other times, for warnings.
    """
    if times := times_of_clocks(names):
        # Twelve-hour clocks do not have the order of the names.
        halves = any((date := DATE.search(name)) and date["half"] for name in names)
        return times if halves else _checked(names, times, advice)
    stems = [PurePosixPath(name).stem for name in names]
    # If each folder is a timestep, file names are those of cameras.
    paths = [PurePosixPath(name).with_suffix("").as_posix() for name in names]
    files, whole = ([CAMERA.sub("", text) for text in texts] for texts in (stems, paths))
    for texts in (files, whole, stems):
        found = most_different(texts)
        if len(set(found)) > 1 or (found and len(names) == 1):
            break
    cameras = _cameras(stems) if texts is stems and len(names) > 1 else []
    few = len(names) <= MOST_CAMERAS and not any(map(FRAME.search, cameras))
    why = _no_series(names, stems, found)
    if not why and cameras and few and not dynamic:
        why = (
            f"The numbers in the names of the images, such as {names[0]}, are those of cameras "
            "(data.static=false takes them for times)"
        )
    if why:
        warn(f"{why}: all images are taken for one timestep. {advice}")
        return []
    return _checked(names, found, advice, by_file=texts is not whole, by_camera=bool(cameras))


def times_of_clocks(names: Sequence[str]) -> list[Number]:
    """Dates with the time of day, or seconds with a fraction; empty if a name has none."""
    stems = [PurePosixPath(name).stem for name in names]
    for times in (_dates(stems), [_clock(stem) for stem in stems]):
        found: list[Number] = [time for time in times if time is not None]
        if len(found) == len(names) and not _few(names, found):
            return found
    return []


def _cameras(stems: Sequence[str]) -> list[str]:
    """The camera in each name; empty if a name has none, or if all are clips."""
    found = [match[0] for stem in stems if (match := CAMERA.search(stem))]
    return [] if len(found) < len(stems) or all(map(CLIP.fullmatch, found)) else found


def _dates(stems: Sequence[str]) -> list[float | None]:
    """Seconds of the date and time of day in each name."""
    times = [_date(stem) for stem in stems]
    matches = [MILLISECONDS.search(stem) for stem in stems]
    found = [
        (time, int(match["part"]))
        for time, match in zip(times, matches, strict=True)
        if time is not None and match is not None
    ]
    pairs = [*pairwise(sorted(set(found)))]
    steps = [after - before for (one, before), (other, after) in pairs if one == other]
    # Numbers of images, not milliseconds: no camera takes a hundred images a second.
    counted = all(after in (0, 1, before + 1) for (_, before), (_, after) in pairs)
    if len(found) < len(stems) or (median(steps) < LEAST_STEP if steps else counted):
        return times
    return [time + part / 1000 for time, part in found]


def _date(stem: str) -> float | None:
    """Seconds of the date and time of day in a name."""
    if (match := DATE.search(stem)) is None:
        return None
    *day, hour, minute, second, fraction, half = match.groups()
    hour = int(hour) % 12 + 12 * (half in "pP") if half else hour
    try:
        seconds = datetime(*map(int, (*day, hour, minute, second)), tzinfo=UTC).timestamp()
    except ValueError:
        return None
    return seconds + float(f"0.{fraction or 0}")


def _clock(stem: str) -> float | None:
    """Seconds with a fraction at the end of a name."""
    if (match := CLOCK.search(stem)) is None:
        return None
    return float(f"{match[1]}.{match[2]}" if match[1] else match[0])


def most_different(texts: Sequence[str]) -> list[Number]:
    """The number in each name at the position where numbers vary most, or the last such position.

    If names have different counts of numbers, the last number of each, if that varies more. Numbers
    of copies, such as 3 in clip_1(3), count if no other varies. Empty if a name has no number.
    """
    rows = [re.findall(NUMBER, COPY.sub("", text)) for text in texts]
    if not all(rows):
        rows = [re.findall(NUMBER, text) for text in texts]
    if not all(rows):
        return []
    shared = range(min(map(len, rows)))
    place = max(shared, key=lambda column: (len({row[column] for row in rows}), column))
    found: list[Number] = [int(row[place]) for row in rows]
    last: list[Number] = [int(row[-1]) for row in rows]
    if len(set(last)) > len(set(found)):
        found = last
    if len(set(found)) > 1 or not any(map(COPY.search, texts)):
        return found
    # The first of several copies may have no number, or 0.
    return [int(match[1]) if (match := COPY.search(text)) else -1 for text in texts]


def _no_series(names: Sequence[str], stems: Sequence[str], found: Sequence[Number]) -> str | None:
    """Why names, such as hashes, do not form a series of images; None if they do."""
    bare = [name for name in names if not re.search(r"\d", name)]
    if bare:
        return f"The names of {len(bare)} of {len(names)} images have no number, such as {bare[0]}"
    # Names of a series differ only in their numbers.
    kinds = {re.sub(r"\d+", "#", stem) for stem in stems}
    if len(kinds) > max(4, len(names) // 2):
        return f"The names of the images, such as {some(names)}, differ in more than their numbers"
    if len(names) > 1 and len(set(found)) <= 1:
        return f"The names of all {len(names)} images, such as {names[0]}, give one number"
    return None


def _folders(names: Sequence[str]) -> list[list[int]]:
    """Indices of the images of each folder and camera, in the order of their names."""
    folders: dict[tuple[str, ...], list[int]] = defaultdict(list)
    paths = [PurePosixPath(name).with_suffix("") for name in names]
    bare = [natural(CAMERA.sub("", path.as_posix())) for path in paths]
    for place in sorted(range(len(names)), key=bare.__getitem__):
        path = paths[place]
        cameras = [match[0] for kind in (CAMERA, SIDE) for match in kind.finditer(path.name)]
        folders[path.parent.as_posix(), *cameras].append(place)
    return list(folders.values())


def _few(names: Sequence[str], times: Sequence[Number]) -> bool:
    """Whether there are far fewer times than images in a folder."""
    return len(set(times)) < FEW * max(map(len, _folders(names)))


def _checked(
    names: Sequence[str],
    times: list[Number],
    advice: str,
    by_file: bool = False,
    by_camera: bool = False,
) -> list[Number]:
    """The times; warns if they are implausible.

    Args:
        names: Names of the images. [V]
        times: Their times. [V]
        advice: How to give others.
        by_file: Whether the times are numbers in the files' names, even if folders are timesteps.
        by_camera: Whether they follow the word for a camera.
    """
    why, shown = "may be those of cameras" if by_camera else "", list(range(min(3, len(names))))
    for places in _folders(names):
        back = [pair for pair in pairwise(places) if times[pair[1]] < times[pair[0]]]
        if back:
            why, shown = "do not have the order of the names", [*back[0]]
            break
    if not why and _few(names, times):
        why = f"are only {len(set(times))}, for {len(names)} images"
    if not why and by_file and (folders := timesteps_of(names)):
        why = f"are those of the files, and the folders {some(folders)} are taken for cameras"
    if why:
        pairs = ", ".join(f"{names[place]} -> {times[place]}" for place in shown)
        warn(f"The times from the numbers in the names {why} ({pairs}). {advice}")
    return times


def timesteps_of(names: Sequence[str]) -> list[str]:
    """The folders of images, if they may be timesteps with an image of each camera; else none."""
    folders = Counter(PurePosixPath(name).parent.name for name in names)
    # Numbers with large gaps are those of devices.
    counts = [int(folder) for folder in folders if re.fullmatch(r"\d{4,6}", folder)]
    timesteps = 1 < len(folders) == len(counts) and max(counts) - min(counts) < 2 * len(counts)
    if len({re.sub(r"\d+", "#", folder) for folder in folders}) == 1:
        # Files of few digits are cameras rather than frames.
        short = all(len(re.sub(r"\D", "", PurePosixPath(name).stem)) < 3 for name in names)
        timesteps |= short and len(folders) > max(folders.values())
    return sorted(folders) if timesteps and not any(map(CAMERA.search, folders)) else []
