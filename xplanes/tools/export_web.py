"""One HTML file that plays a run's surfaces over time: `xplanes export --what web`."""

import base64
import html
import json
import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor
from tqdm import tqdm

from xplanes.errors import ConfigError
from xplanes.files import write_text

PARTS = Path(__file__).parent / "web"
"""Folder of the page's template, three.js, and its version and licence."""

LIMIT = 20_000_000  # Largest size of a page in bytes, which mail and most hosts accept.

COARSEST = 1 / 100
"""Share of the requested triangles or points below which there are too many timesteps."""

SPARE = 100_000  # Bytes reserved for everything except the shapes, the template and three.js.
STEPS = 2**16 - 1  # Largest quantised coordinate along each side of a shape's bounding box.


@dataclass(frozen=True)
class Shape:
    """A coloured surface or point cloud at one time.

    Attributes:
        places: Vertices or points in world coordinates. [N, 3]
        colours: In sRGB, from 0 to 1. [N, 3]
        faces: Triangles, counter-clockwise from outside; None for points. [F, 3]
    """

    places: Tensor
    colours: Tensor
    faces: np.ndarray | None = None


def write_page(
    path: Path,
    shape_at: Callable[[float, float], Shape],
    times: Sequence[float],
    *,
    title: str,
    background: Tensor,
    eye: Tensor,
) -> dict[str, Any]:
    """Write a self-contained page that needs no network.

    Args:
        path: The HTML file.
        shape_at: Function from a time in [0, 1] and a share of the triangles or points in [0, 1]
            to a shape; the share is lowered until the page is smaller than 20 MB.
        times: Times to show, from 0 to 1.
        title: Title of the page.
        background: Colour in sRGB, from 0 to 1. [3]
        eye: Initial position of the camera, in world coordinates with z up. [3]

    Returns:
        Number of vertices, triangles and bytes, the share, and the version of three.js.

    Raises:
        ConfigError: If there are too many timesteps for the limit.
    """
    three = json.loads((PARTS / "three.json").read_text(encoding="utf-8"))
    script = (PARTS / three["file"]).read_text(encoding="utf-8")
    page = (PARTS / "page.html").read_text(encoding="utf-8")
    shapes, share = _fitting(LIMIT - len(page) - len(script) - SPARE, shape_at, times)
    low = np.min([shape.pop("least") for shape in shapes], axis=0)
    high = np.max([shape.pop("most") for shape in shapes], axis=0)
    radius = float(np.linalg.norm(high - low)) / 2
    vertices, triangles = (sum(shape[name] for shape in shapes) for name in ("vertices", "faces"))
    content = {
        "times": list(times),
        "background": background.tolist(),
        "centre": ((low + high) / 2).tolist(),
        "radius": radius,
        "towards": (eye.numpy() - (low + high) / 2).tolist(),
        # Large enough for points on a sphere to cover it.
        "point": 0 if triangles else 4 * radius * (len(shapes) / vertices) ** 0.5,
        "shapes": shapes,
    }
    licence = (PARTS / three["licence_file"]).read_text(encoding="utf-8")
    filled = {
        "title": html.escape(title),
        "notice": f"three.js {three['version']}, {three['homepage']}\n\n{licence}",
        "three": script,
        "run": json.dumps(content).replace("<", "\\u003c"),  # Prevents </script>.
    }
    text = re.sub(r"\{\{(\w+)\}\}", lambda found: filled[found[1]], page)
    write_text(path, text)
    return {
        "vertices": vertices,
        "triangles": triangles,
        "bytes": len(text.encode()),
        "share": share,
        "three": three["version"],
    }


def _fitting(
    room: int, shape_at: Callable[[float, float], Shape], times: Sequence[float]
) -> tuple[list[dict[str, Any]], float]:
    """Shapes that fit into ``room`` bytes, and their share of the triangles or points."""
    share = 1.0
    while share > COARSEST:
        shapes: list[dict[str, Any]] = []
        for time in tqdm(times, "times", leave=False, delay=2, disable=None):
            shapes.append(_packed_shape(shape_at(time, share)))
            expected = sum(len(shape["data"]) for shape in shapes) * len(times) / len(shapes)
            if expected > room:
                share *= 0.95 * room / expected
                break
        else:
            return shapes, share
    raise ConfigError(
        f"--times {len(times)}: these timesteps do not fit into a page of {LIMIT // 10**6} MB; set "
        "fewer"
    )


def _packed_shape(shape: Shape) -> dict[str, Any]:
    places, colours = shape.places.numpy(), (255 * shape.colours).round().byte().numpy()
    low, size = places.min(axis=0), np.ptp(places, axis=0)
    cells = np.round((places - low) / np.where(size > 0, size, 1) * STEPS).astype("<u2")
    if shape.faces is None:  # Spatial order saves a third of the bytes.
        order = np.lexsort((cells[:, 2], *(cells[:, :2] >> 11).T))
        cells, colours = cells[order], colours[order]
    content = packed(cells) + packed(colours)
    if shape.faces is not None:
        content += packed(shape.faces.astype("<u4"))
    least, most = np.quantile(places, [0.01, 0.99], axis=0)  # Ignore floaters for the camera.
    return {
        "vertices": len(places),
        "faces": 0 if shape.faces is None else len(shape.faces),
        "low": low.tolist(),
        "size": size.tolist(),
        "least": least,
        "most": most,
        "data": base64.b64encode(zlib.compress(content, 9)).decode(),
    }


def packed(values: np.ndarray) -> bytes:
    """Arrange unsigned integers as bytes that compress well; the page has the inverse.

    Args:
        values: Little-endian. [N, C]

    Returns:
        Differences between rows, modulo the type's range, column by column; each column has all
        lowest bytes first and all highest bytes last.
    """
    steps = np.diff(values, axis=0, prepend=np.zeros_like(values[:1])).T
    split = np.ascontiguousarray(steps).view(np.uint8).reshape(*steps.shape, -1)
    return split.transpose(0, 2, 1).tobytes()
