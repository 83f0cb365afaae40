"""Frames of video files, decoded with PyAV (extra `video`)."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from xplanes.errors import SceneError, warn
from xplanes.files import stand_in
from xplanes.optional import require
from xplanes.readers.images import Size

SUFFIXES = """.mp4 .mov .m4v .mkv .webm .avi .mpg .mpeg .ts .mts .m2ts .3gp .wmv""".split()
"""Suffixes of video files."""

HDR = {16: "PQ", 18: "HLG"}
"""Transfer characteristics of HDR videos, by their numbers in ITU-T H.273."""


def is_video(path: Path) -> bool:
    """Whether a file is named like a video."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def read_header(path: Path) -> tuple[Size, int, float | None, tuple[float, ...]]:
    """Read the header of a video file. Nothing is decoded.

    Returns:
        Height and width of its frames, number of frames that are shown, frames per second, None if
        unknown, and presentation times of the frames in seconds, empty if unknown.

    Raises:
        SceneError: If the file is not a video.
        MissingExtraError: If PyAV is not installed.
    """
    with _opened(path) as (container, stream):
        # Without frames hidden by an edit list, which the container's count includes.
        stamps = [
            packet.pts
            for packet in container.demux(stream)
            if packet.size > 0 and not packet.is_discard
        ]
        known = sorted(stamp for stamp in stamps if stamp is not None)
        whole = len(known) == len(stamps) and stream.time_base is not None
        times = tuple(float(stamp * stream.time_base) for stamp in known) if whole else ()
        if (curve := stream.codec_context.color_trc) in HDR:
            warn(
                f"{path} is an HDR video ({HDR[curve]}): without tone mapping its colours are "
                "pale. Convert it to SDR first."
            )
        size = (stream.codec_context.height, stream.codec_context.width)
        rate = None if stream.average_rate is None else float(stream.average_rate)
        return size, len(stamps), rate, times


def frames(path: Path, numbers: range) -> Iterator[np.ndarray]:
    """Decode some frames of a video.

    Args:
        path: The file.
        numbers: Indices of the frames, from 0, ascending.

    Returns:
        Colours of each frame. uint8 [h, w, 3]

    Raises:
        SceneError: If the file is damaged, ends before the last of them, or shows rotated frames.
    """
    number = -1
    with _opened(path) as (container, stream):
        stream.codec_context.thread_count = 1  # Several videos are decoded in parallel.
        for number, frame in enumerate(container.decode(stream)):
            if frame.rotation:
                raise SceneError(
                    f"{path} is to be shown rotated by {frame.rotation} degrees, so that its "
                    "pixels do not match its calibration. Encode it upright: ffmpeg -i "
                    f"{path.name} upright{path.suffix}"
                )
            if number in numbers:
                yield frame.to_ndarray(format="rgb24")
            if number == numbers[-1]:
                return
    raise SceneError(
        f"{path} ends after frame {number}, but frame {numbers[-1]} is needed: it is probably "
        f"truncated. Download it again, or set data.frames=[{numbers[0]},{number},{numbers.step}]."
    )


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A video file and its stream of frames; refuses files that cannot be decoded in the block."""
    av = require("av", extra="video")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise SceneError(
                    f"{path} holds no video stream. Put the camera's video in its place."
                )
            yield container, container.streams.video[0]
    except av.FFmpegError as problem:
        if (other := stand_in(path)) is not None:
            raise SceneError(f"{path} {other}.") from problem
        raise SceneError(
            f"{path} cannot be decoded as a video ({problem}). It is probably truncated or "
            "damaged: export or download it again."
        ) from problem
