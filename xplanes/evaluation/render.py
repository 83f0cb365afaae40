"""Films along a path of cameras and times, as the command line names them."""

import difflib
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from xplanes.config import ConfigError
from xplanes.evaluation.media import (
    ELEVATION,
    check_film,
    film_times,
    orbit_poses,
    render_path,
    write_film,
)
from xplanes.evaluation.progress import progress
from xplanes.evaluation.runs import TrainedRun
from xplanes.files import require_writable
from xplanes.scenes.views import Views

FRAMES = 48
LARGEST = 8192
"""Pixels per side; WebP ends at twice as many."""


@dataclass(frozen=True)
class FilmOptions:
    """What to film.

    Attributes:
        path: Camera: ``orbit``, ``fixed`` (the first camera of the orbit), or ``view:FILE``.
        time: ``sweep`` (from 0 to 1), ``forth-and-back``, or a number from 0 to 1.
        frames: Number of frames; None for 48, or 1 where neither camera nor time moves.
        fps: Frames per second.
        size: Pixels per side; None for those of the training views.
        elevation: Height angle of orbit and fixed camera, in degrees.
        what: ``colour`` or ``depth``.
    """

    path: str = "orbit"
    time: str = "forth-and-back"
    frames: int | None = None
    fps: int = 16
    size: int | None = None
    elevation: float = ELEVATION
    what: str = "colour"

    @property
    def count(self) -> int:
        """Number of frames."""
        if self.frames is not None:
            return self.frames
        frozen = self.path != "orbit" and self.time not in ("sweep", "forth-and-back")
        return 1 if frozen else FRAMES

    def check(self) -> None:
        """Refuse what cannot be filmed.

        Raises:
            ConfigError: With the option, its value and what is allowed.
        """
        times(self.time, 1)
        if self.path not in ("orbit", "fixed") and not self.path.startswith("view:"):
            raise ConfigError(f"--path {self.path}: must be orbit, fixed or view:FILE")
        for name, value, most in (
            ("frames", self.count, 100_000),
            ("fps", self.fps, 240),
            ("size", 1 if self.size is None else self.size, LARGEST),
        ):
            if not 1 <= value <= most:
                raise ConfigError(f"--{name} {value}: must lie between 1 and {most}")
        if not -90 <= self.elevation <= 90:
            raise ConfigError(
                f"--elevation {self.elevation:g}: must lie between -90 and 90 degrees"
            )


def film(trained: TrainedRun, options: FilmOptions, out: str | None = None) -> Path:
    """Render and write a film.

    Args:
        trained: The run.
        options: What to film.
        out: A file (.webp, .mp4, .png), or a folder if it ends in /; by default a file in the run's
            media/ that is named after the paths.

    Returns:
        Where the film is.

    Raises:
        ConfigError: If options are out of range or contradict one another.
        ImportError: For .mp4 without the extra ``video``.
    """
    options.check()
    check_out(out, options)
    target, folder = destination(trained.path, options, out, trained.checkpoint)
    require_writable(target.parent)
    views = trained.scene.splits["train"]
    longer = max(views.height, views.width)
    size = longer if options.size is None else options.size
    frames = render_path(
        trained.module.field,
        trained.module.renderer,
        trained.frame,
        poses(trained, options),
        times(options.time, options.count),
        focal=views.focal * size / longer,
        size=size,
        background=trained.scene.background,
        what=options.what,
    )
    shown = progress(frames, options.count, "frames")
    return write_film(target, shown, fps=options.fps, folder=folder)


def check_out(out: str | None, options: FilmOptions) -> None:
    """Refuse an ``--out`` that could not be written, before the run is loaded.

    Raises:
        ConfigError: As `xplanes.evaluation.media.check_film`.
        ImportError: For .mp4 without the extra ``video``.
    """
    target, folder = destination(Path(), options, out, "last")
    check_film(target, frames=options.count, folder=folder)


def destination(
    run: Path, options: FilmOptions, out: str | None, checkpoint: str
) -> tuple[Path, bool]:
    """The file or folder to write, and whether it is a folder."""
    if out is not None:
        return Path(out), out.endswith("/") or Path(out).is_dir()
    camera = options.path.replace(":", "_").replace("/", "_").removesuffix(".png")
    parts = ["render", camera, options.time]
    parts += [part for part in (options.what, checkpoint) if part not in ("colour", "last")]
    ending = ".png" if options.count == 1 else ".webp"
    return run / "media" / ("_".join(parts) + ending), False


def poses(trained: TrainedRun, options: FilmOptions) -> Tensor:
    """Camera of each frame. [F, 4, 4]"""
    views = trained.scene.splits["train"]
    if options.path == "orbit":
        return orbit_poses(views, trained.frame, options.count, options.elevation)
    if options.path == "fixed":
        pose = orbit_poses(views, trained.frame, 1, options.elevation)
    else:
        pose = view_pose(trained.scene.splits, options.path.removeprefix("view:"))[None]
    return pose.expand(options.count, 4, 4)


def view_pose(splits: dict[str, Views], name: str) -> Tensor:
    """Camera of the view whose file is called ``name``, with or without ending. [4, 4]

    Raises:
        ConfigError: If there is none, with similar names.
    """
    known = {
        file: views.camera_to_world[index]
        for views in splits.values()
        for index, file in enumerate(views.files)
    }
    for file, pose in known.items():
        if name in (file, file.rsplit(".", 1)[0]):
            return pose
    near = difflib.get_close_matches(name, list(known), n=3, cutoff=0.3) or list(known)[:3]
    raise ConfigError(
        f"--path view:{name}: no such view in {' or '.join(splits)}. Views are called "
        f"{', '.join(near)}"
    )


def times(name: str, count: int) -> Tensor:
    """Time of each frame, from 0 to 1. [F]

    Raises:
        ConfigError: If ``name`` is neither a way through time nor a number from 0 to 1.
    """
    if name == "sweep":
        return torch.linspace(0, 1, count)
    if name == "forth-and-back":
        return film_times(count)
    try:
        moment = float(name)
    except ValueError:
        moment = math.nan
    if not 0 <= moment <= 1:
        raise ConfigError(f"--time {name}: must be sweep, forth-and-back or a number from 0 to 1")
    return torch.full((count,), moment)
