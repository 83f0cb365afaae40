"""Demo scenes on disk, in the format of D-NeRF's scenes."""

import hashlib
import json
import os
import random
import secrets
import shutil
import threading
from abc import ABC
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import time as now
from typing import Any, ClassVar, Literal

import torch
from PIL import Image
from torch import Tensor

from xplanes.backend import threads
from xplanes.errors import ConfigError, SceneError
from xplanes.files import DAY
from xplanes.readers.dnerf import read_scene
from xplanes.readers.images import load_images
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Scene, Views
from xplanes.settings import Count, Steps
from xplanes.synthetic.demo.assembly import Assembly
from xplanes.synthetic.demo.capture import Capture, even_times, held_out_times
from xplanes.synthetic.demo.motions import Variation
from xplanes.synthetic.demo.render import camera_at, hemisphere_cameras, render_image
from xplanes.synthetic.demo.scenes import build_demo_scene, demo_scene
from xplanes.synthetic.demo.suite import suite_scene
from xplanes.synthetic.demo.world import World

VERSION = 2
"""Version of the renderer; increase it whenever the images of a scene change."""

SUITE_VERSION = 2
"""Version of the scenes of the suite; increase it whenever their images change."""

RECORD = "demo.json"
"""File that describes the content of a scene folder; written last."""

MASKS = "masks"
"""Folder of the masks of an object with surroundings, with the names of the images."""

USUAL_VIEWS = {"train": 50, "val": 10, "test": 12}
"""Default number of views per split; other numbers become part of the folder name."""

VIDEO_FRAMES = 50
"""Frames of the fixed-camera video."""

_RENDERING = threading.Lock()


@dataclass(frozen=True)
class Shoot:
    """What is rendered to a scene's folder.

    Attributes:
        title: Name in messages.
        assembly: The scene.
        capture: Times and cameras.
        version: Version of the images.
        record: What else the images depend on, besides seed, resolution and numbers of views.
        world: Surroundings; None for images of the assembly alone.
    """

    title: str
    assembly: Assembly
    capture: Capture
    version: int
    record: dict[str, str]
    world: World | None = None


def _demo_shoot(name: str, seed: int, counts: dict[str, int]) -> Shoot:
    assembly = build_demo_scene(name, seed)
    # Parts and motions are hashed, so that an edited scene is rendered again.
    record = {"assembly": _digest(assembly)}
    shots = {}
    for split, count in counts.items():
        draw = random.Random(f"{split} {seed}")  # A stream for each split.
        cameras = hemisphere_cameras(count, draw)
        times = even_times(count) if split == "train" else held_out_times(count, draw)
        shots[split] = list(zip(times, cameras, strict=True))
    camera = camera_at(demo_scene(name).azimuth, 0.0)
    shots["video"] = [(time, camera) for time in even_times(VIDEO_FRAMES)]
    return Shoot(f"demo scene {name}", assembly, Capture(shots), VERSION, record)


def _suite_shoot(name: str, seed: int, counts: dict[str, int]) -> Shoot:
    scene, variation = suite_scene(name), Variation(name, seed)
    assembly = scene.build(variation)
    world = None if scene.world is None else scene.world(assembly, variation)
    capture = scene.rig.capture(counts, f"{name} {seed}")
    around = () if world is None else (world,)
    record = {"content": _digest((SUITE_VERSION, assembly, scene.rig, *around))}
    return Shoot(f"suite scene {name}", assembly, capture, SUITE_VERSION, record, world)


def _digest(content: object) -> str:
    return hashlib.sha256(repr(content).encode()).hexdigest()


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
    shoot: Callable[[str, int, dict[str, int]], Shoot] = _demo_shoot,
) -> Path:
    """Render a demo scene unless its folder exists already.

    The folder is created atomically, even if several processes render the same scene.

    Args:
        root: Folder of the demo scenes; created if missing.
        name: Name of the scene.
        resolution: Height and width of the images in pixels.
        seed: Seed of the variations of a scene: some of colours, shapes and cameras.
        train_views: Number of training views; one random camera per timestep, evenly spaced times.
        val_views: Number of validation views.
        test_views: Number of test views.
        announce: Receives a message before rendering; `print` when None.
        shoot: What is rendered, from name, seed and number of views per split.

    Returns:
        The scene's folder.

    Raises:
        ValueError: If no scene has that name, or a count is below 1.
    """
    counts = {"train": train_views, "val": val_views, "test": test_views}
    numbers = {"resolution": resolution, **{f"{key}_views": n for key, n in counts.items()}}
    for key, value in numbers.items():
        if value < 1:
            raise ValueError(f"{key} is {value}; it must be at least 1")
    made = shoot(name, seed, counts)
    views = {split: len(shots) for split, shots in made.capture.shots.items()}
    asked = {"version": made.version, "scene": name, "seed": seed, "resolution": resolution}
    record = {**asked, "views": views, **made.record}
    suffix = "" if counts == USUAL_VIEWS else "_" + "-".join(map(str, counts.values()))
    folder = Path(root) / f"{name}_{resolution}px_s{seed}{suffix}"
    masked = made.world is not None
    if _holds(folder, record, masked):
        return folder
    total = sum(views.values())
    (announce or print)(f"Rendering {made.title} ({total} images of {resolution} px) to {folder}")
    folder.parent.mkdir(parents=True, exist_ok=True)
    for path in folder.parent.glob(f".{folder.name}.*"):  # Abandoned by other processes.
        if now() - path.stat().st_mtime > DAY:
            shutil.rmtree(path, ignore_errors=True)
    fresh = _sibling(folder)
    try:
        # Parallelising many small operations in torch costs more than it gains.
        with _RENDERING, threads(1):
            for split in views:
                _write_split(fresh, split, made, resolution)
        (fresh / RECORD).write_text(json.dumps(record, indent=2) + "\n")
        _publish(fresh, folder, record, masked)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return folder


ensure_suite_scene = partial(ensure_demo_scene, shoot=_suite_shoot)
"""Render a scene of the suite unless its folder exists already; see `ensure_demo_scene`.

There is no fixed-view video. Objects with surroundings have opaque images, and masks of the object
in ``masks``. Only scores may use these masks, unless ``mask_use`` says otherwise.
"""


def _write_split(folder: Path, split: str, shoot: Shoot, resolution: int) -> None:
    capture, world = shoot.capture, shoot.world
    (folder / split).mkdir()
    if world is not None:
        (folder / MASKS / split).mkdir(parents=True)
    frames = []
    for number, (time, camera) in enumerate(capture.shots[split]):
        file = f"./{split}/r_{number:03d}"
        how = (camera, resolution, capture.samples, capture.angle_x)
        if world is None:
            image = render_image(shoot.assembly.pose(time), *how)
        else:
            image, mask = world.picture(shoot.assembly, time, *how)
            Image.fromarray(mask).save(folder / MASKS / f"{file}.png", compress_level=6)
        Image.fromarray(image).save(folder / f"{file}.png", compress_level=6)
        frames.append({"file_path": file, "time": time, "transform_matrix": camera.tolist()})
    index = {"camera_angle_x": capture.angle_x, "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(index, indent=1) + "\n")


def _holds(folder: Path, record: dict[str, Any], masked: bool) -> bool:
    """Whether a folder matches the record and has all its files, ``masked`` ones with masks."""
    try:
        if json.loads((folder / RECORD).read_text()) != record:
            return False
    except (OSError, ValueError):
        return False
    places = (folder, folder / MASKS) if masked else (folder,)
    return all(
        (folder / f"transforms_{split}.json").is_file()
        and all(
            (place / split / f"r_{number:03d}.png").is_file()
            for place in places
            for number in range(count)
        )
        for split, count in record["views"].items()
    )


def _sibling(folder: Path) -> Path:
    """A new empty folder next to ``folder`` with a unique name."""
    sibling = folder.with_name(f".{folder.name}.{os.getpid()}.{secrets.token_hex(4)}")
    sibling.mkdir()
    return sibling


def _publish(fresh: Path, folder: Path, record: dict[str, Any], masked: bool) -> None:
    """Move a finished folder into place, unless another process was first."""
    while not _holds(folder, record, masked):
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
class ProceduralSettings(SceneSettings, ABC):
    """A procedural scene, rendered on first use."""

    seed: Steps  # Seed of the variations of a scene: some of colours, shapes and cameras.
    train_views: Count  # Training views, each at its own timestep.
    test_views: Count  # Test views, at timesteps other than the training views'.
    val_views: Count  # Validation views.

    find: ClassVar[Callable[[str], object]]
    ensure: ClassVar[Callable[..., Path]]

    def check(self) -> None:
        try:
            type(self).find(self.scene)
        except SceneError as error:
            raise ConfigError(f"scene={self.scene}: {error}") from None

    @property
    def folder(self) -> Path:
        return type(self).ensure(
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
            scene = read_scene(self, splits)
            if not (folder / MASKS).is_dir():
                return scene
            found = {}
            for split, views in scene.splits.items():
                masks = load_images([folder / MASKS / file for file in views.files], None)
                found[split] = replace(views, foreground=masks[..., 0])
            return replace(scene, splits=found)
        except SceneError as problem:
            if str(problem).startswith("data."):  # What is wrong is a setting, not the files.
                raise
            raise SceneError(
                f"{problem} This is a demo scene: delete {folder} to render it again"
            ) from problem


@dataclass(frozen=True, kw_only=True)
class DemoSettings(ProceduralSettings):
    """A procedural scene, rendered on first use."""

    find, ensure = staticmethod(demo_scene), staticmethod(ensure_demo_scene)


@dataclass(frozen=True, kw_only=True)
class SuiteSettings(ProceduralSettings):
    """A procedural scene of the suite, rendered on first use."""

    find, ensure = staticmethod(suite_scene), staticmethod(ensure_suite_scene)

    # Foreground masks, used for scores. alpha: also as training alpha; lrm: also for LRM input.
    mask_use: Literal["score", "alpha", "lrm"]

    def load(self, splits: Sequence[str]) -> Scene:
        scene = super().load(splits)
        train = scene.splits.get("train")
        if self.mask_use == "score" or train is None:
            return scene
        if train.foreground is None:
            raise SceneError(
                f"data.mask_use={self.mask_use}: {self.scene} has no surroundings, so it has no "
                "masks. Set it to score."
            )
        lrm_views = cut_out(train, train.foreground)
        if self.mask_use == "lrm":
            return replace(scene, lrm_views=lrm_views)
        return replace(scene, splits=scene.splits | {"train": lrm_views})


def cut_out(views: Views, foreground: Tensor) -> Views:
    """Opaque views with a foreground mask as their alpha. uint8 [V, H, W]"""
    images = views.in_memory().clone()
    share = foreground[..., None] / 255
    images[..., :3] = (images[..., :3].float() * share).round().to(torch.uint8)
    images[..., 3] = foreground
    return replace(views, images=images)
