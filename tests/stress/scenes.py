"""Scenes at the edge of what a folder can hold, written to disk in D-NeRF's layout."""

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

from xplanes.scenes.cameras import look_at

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
    """Write a scene's training and test views unless they are there.

    Args:
        root: Folder for scenes.
        kind: One of `SCENES`.
        views: Training views, from all sides.
        times: Distinct timesteps among them.
        size: Pixels along each side.

    Returns:
        The scene's folder.
    """
    folder = root / f"{kind}_{views}_{times}_{size}"
    if (folder / "transforms_test.json").is_file():
        return folder
    for split, count in (("train", views), ("test", 2)):
        (folder / split).mkdir(parents=True)
        frames = []
        for number in range(count):
            timestep = number % times
            time = timestep / max(times - 1, 1)
            angle = 0.3 + 2.4 * number + (split == "test")
            height = 0.4 + 0.5 * math.sin(number)
            pose = look_at(_place(angle, height)[None])[0]
            Image.fromarray(picture(kind, time, size)).save(folder / split / f"r_{number:03d}.png")
            frames.append(
                {
                    "file_path": f"./{split}/r_{number:03d}",
                    "time": time,
                    "transform_matrix": pose.tolist(),
                }
            )
        content = {"camera_angle_x": ANGLE, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return folder


def _place(angle: float, height: float):
    import torch

    flat = math.cos(height)
    place = [flat * math.cos(angle), flat * math.sin(angle), math.sin(height)]
    return DISTANCE * torch.tensor(place, dtype=torch.float64)
