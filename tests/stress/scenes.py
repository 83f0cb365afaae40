"""Scenes at the edge of what a folder can hold, written to disk in D-NeRF's layout."""

import json
from pathlib import Path

import numpy as np

from tests.balls import surrounding
from tests.captures import save

SCENES = ("black", "white", "transparent", "constant", "ball")
"""Kinds of pictures: opaque of one colour, see-through, see-through grey, a moving ball."""

SIZE = 16
ANGLE = 0.7
DISTANCE = 4.0


def picture(kind: str, time: float, size: int = SIZE) -> np.ndarray:
    """One RGBA picture of a kind of scene. uint8 [size, size, 4]"""
    image = np.zeros((size, size, 4), dtype=np.uint8)
    if kind == "black":
        image[..., 3] = 255
    elif kind == "white":
        image[:] = 255
    elif kind == "constant":
        image[:] = (90, 120, 150, 128)
    elif kind == "ball":
        rows, columns = np.mgrid[:size, :size] + 0.5
        centre = size * (0.4 + 0.2 * time)
        inside = (rows - size / 2) ** 2 + (columns - centre) ** 2 < (size / 4) ** 2
        image[inside] = (200, 100, 50, 255)
    elif kind != "transparent":
        raise ValueError(f"kind={kind!r}: must be one of {', '.join(SCENES)}")
    return image


def write_scene(root: Path, kind: str, *, views: int = 6, times: int = 6, size: int = SIZE) -> Path:
    """The folder of a scene with ``views`` for training of ``times`` timesteps, and two to test."""
    folder = root / f"{kind}_{views}_{times}_{size}"
    if (folder / "transforms_test.json").is_file():
        return folder
    for seed, (split, count) in enumerate((("train", views), ("test", 2))):
        frames = []
        for number, pose in enumerate(surrounding(count, DISTANCE, seed)):
            name, time = f"{split}/r_{number:03d}", number % times / max(times - 1, 1)
            save(folder / f"{name}.png", picture(kind, time, size))
            frames.append({"file_path": name, "time": time, "transform_matrix": pose.tolist()})
        content = {"camera_angle_x": ANGLE, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return folder
