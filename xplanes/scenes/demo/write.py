"""Demo scenes on disk, in the format of D-NeRF's scenes."""

import hashlib
import json
import os
import random
import secrets
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import time as now
from typing import Any

from PIL import Image
from torch import Tensor

from xplanes.backend import threads
from xplanes.scenes.demo.assembly import Assembly
from xplanes.scenes.demo.render import CAMERA_ANGLE_X, camera_at, hemisphere_cameras, render_image
from xplanes.scenes.demo.scenes import build_demo_scene, demo_scene
from xplanes.scenes.dnerf import read_scene
from xplanes.scenes.errors import SceneError
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Scene
from xplanes.settings import Count, Steps

VERSION = 2
"""Version of the renderer; increase it whenever the images of a scene change."""

RECORD = "demo.json"
"""File that describes the content of a scene folder; written last."""

USUAL_VIEWS = {"train": 50, "val": 10, "test": 12}
"""Default number of views per split; other numbers become part of the folder name."""

VIDEO_FRAMES = 50
"""Frames of the fixed-camera video."""

DAY = 86_400.0
"""Age in seconds from which an unfinished folder counts as abandoned."""

_RENDERING = threading.Lock()


def ensure_demo_scene(
    root: Path,
    name: str,
    *,
    resolution: int,
    seed: int = 0,
    train_views: int = USUAL_VIEWS["train"],
    val_views: int = USUAL_VIEWS["val"],
    test_views: int = USUAL_VIEWS["test"],
    announce: Callable[[str], None] | None = None,
) -> Path:
    """Render a demo scene unless its folder exists already.

    The folder is created atomically, even if several processes render the same scene.

    Args:
        root: Folder of the demo scenes; created if missing.
        name: Name of the scene.
        resolution: Height and width of the images in pixels.
        seed: Seed of colours, motion phases and cameras.
        train_views: Number of training views; one random camera per timestep, evenly spaced times.
        val_views: Number of validation views.
        test_views: Number of test views.
        announce: Receives a message before rendering; `print` when None.

    Returns:
        The scene's folder.

    Raises:
        ValueError: If no scene has that name, or a count is below 1.
    """
    counts = {"train": train_views, "val": val_views, "test": test_views}
    for key, value in {
        "resolution": resolution,
        **{f"{k}_views": v for k, v in counts.items()},
    }.items():
        if value < 1:
            raise ValueError(f"{key} is {value}; it must be at least 1")
    assembly = build_demo_scene(name, seed)
    record = _record(name, assembly, resolution, seed, counts)
    folder = Path(root) / _folder_name(name, resolution, seed, counts)
    if _holds(folder, record):
        return folder
    total = sum(counts.values()) + VIDEO_FRAMES
    (announce or print)(
        f"Rendering demo scene {name} ({total} images of {resolution} px) to {folder}"
    )
    folder.parent.mkdir(parents=True, exist_ok=True)
    _clear_unfinished(folder)
    fresh = _sibling(folder)
    try:
        with _one_thread():
            for split, shots in _shots(name, seed, counts).items():
                _write_split(fresh, split, shots, assembly, resolution)
        (fresh / RECORD).write_text(json.dumps(record, indent=2) + "\n")
        _publish(fresh, folder, record)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return folder


Shot = tuple[float, Tensor]
"""Time and camera-to-world matrix [4, 4] of a view."""


def _shots(name: str, seed: int, counts: dict[str, int]) -> dict[str, list[Shot]]:
    """Times and cameras of every split; each split has its own random stream."""
    scene = demo_scene(name)
    shots = {}
    for split, count in counts.items():
        draw = random.Random(f"{split} {seed}")
        cameras = hemisphere_cameras(count, draw)
        # Times of held-out views are stratified. Every split begins at time 0, because readers of
        # this format expect it.
        held_out = [0.0, *((i + draw.random()) / count for i in range(1, count))]
        times = _even(count) if split == "train" else held_out
        shots[split] = list(zip(times, cameras, strict=True))
    camera = camera_at(scene.azimuth, 0.0)
    shots["video"] = [(time, camera) for time in _even(VIDEO_FRAMES)]
    return shots


def _even(count: int) -> list[float]:
    return [i / max(count - 1, 1) for i in range(count)]


def _write_split(
    folder: Path, split: str, shots: list[Shot], assembly: Assembly, resolution: int
) -> None:
    (folder / split).mkdir()
    frames = []
    for number, (time, camera) in enumerate(shots):
        file = f"./{split}/r_{number:03d}"
        picture = render_image(assembly.pose(time), camera, resolution)
        Image.fromarray(picture).save(folder / f"{file}.png", compress_level=6)
        frames.append({"file_path": file, "time": time, "transform_matrix": camera.tolist()})
    index = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(index, indent=1) + "\n")


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit PyTorch to one thread: parallelising many small operations costs more than it gains."""
    with _RENDERING, threads(1):
        yield


def _record(
    name: str, assembly: Assembly, resolution: int, seed: int, counts: dict[str, int]
) -> dict[str, Any]:
    return {
        "version": VERSION,
        "scene": name,
        "seed": seed,
        "resolution": resolution,
        "views": {**counts, "video": VIDEO_FRAMES},
        # Parts and motions are hashed, so that an edited scene is rendered again.
        "assembly": hashlib.sha256(repr(assembly).encode()).hexdigest(),
    }


def _folder_name(name: str, resolution: int, seed: int, counts: dict[str, int]) -> str:
    suffix = "" if counts == USUAL_VIEWS else "_" + "-".join(map(str, counts.values()))
    return f"{name}_{resolution}px_s{seed}{suffix}"


def _holds(folder: Path, record: dict[str, Any]) -> bool:
    """Whether a folder matches the record and has all its files."""
    try:
        if json.loads((folder / RECORD).read_text()) != record:
            return False
    except (OSError, ValueError):
        return False
    return all(
        (folder / f"transforms_{split}.json").is_file()
        and all((folder / split / f"r_{number:03d}.png").is_file() for number in range(count))
        for split, count in record["views"].items()
    )


def _sibling(folder: Path) -> Path:
    """A new empty folder next to ``folder`` with a unique name."""
    sibling = folder.with_name(f".{folder.name}.{os.getpid()}.{secrets.token_hex(4)}")
    sibling.mkdir()
    return sibling


def _clear_unfinished(folder: Path) -> None:
    """Remove abandoned temporary folders next to ``folder``."""
    for path in folder.parent.glob(f".{folder.name}.*"):
        if now() - path.stat().st_mtime > DAY:
            shutil.rmtree(path, ignore_errors=True)


def _publish(fresh: Path, folder: Path, record: dict[str, Any]) -> None:
    """Move a finished folder into place, unless another process was first."""
    while not _holds(folder, record):
        stale = _sibling(folder)
        try:
            if folder.exists():
                folder.replace(stale)
            fresh.rename(folder)
            return
        except OSError:
            # Another process changed the folder in the meantime: check again.
            continue
        finally:
            shutil.rmtree(stale, ignore_errors=True)


@dataclass(frozen=True, kw_only=True)
class DemoSettings(SceneSettings):
    """A procedural scene, rendered on first use."""

    seed: Steps  # Seed of colours, motion phases and cameras.
    train_views: Count  # Training views, each at its own timestep.
    test_views: Count  # Test views, at other timesteps than the training views.
    val_views: Count  # Validation views.

    @property
    def folder(self) -> Path:
        return ensure_demo_scene(
            Path(self.root),
            self.scene,
            resolution=self.resolution or 128,
            seed=self.seed,
            train_views=self.train_views,
            val_views=self.val_views,
            test_views=self.test_views,
        )

    def prepare(self) -> None:
        _ = self.folder

    def load(self, splits: Sequence[str]) -> Scene:
        folder = self.folder
        try:
            return read_scene(
                folder,
                resolution=self.resolution,
                splits=splits,
                views=self.views,
                eval_views=self.eval_views,
            )
        except SceneError as problem:
            raise SceneError(
                f"{problem} This is a demo scene: delete {folder} to render it again"
            ) from problem
