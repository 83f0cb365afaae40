"""What cameras and points find of an object."""

import math

import numpy as np
import torch
from numpy.typing import NDArray

from xplanes.backend import compiled
from xplanes.pretraining.solids import Array, Solids
from xplanes.scenes.cameras import look_at
from xplanes.scenes.demo.film import CAMERA_ANGLE_X, CAMERA_DISTANCE

FOCAL = 0.5 / math.tan(0.5 * CAMERA_ANGLE_X)
"""Focal length of D-NeRF's cameras as a share of the picture's side."""


def camera(azimuth: float, elevation: float) -> Array:
    """Pose of a D-NeRF camera that looks at the origin from a direction in degrees. [4, 4]"""
    turn, rise = math.radians(azimuth), math.radians(elevation)
    flat = math.cos(rise)
    place = [flat * math.cos(turn), flat * math.sin(turn), math.sin(rise)]
    return look_at(CAMERA_DISTANCE * torch.tensor([place], dtype=torch.float64))[0].numpy()


def film_solids(
    solids: Solids, pose: Array, side: int, samples: int = 2
) -> tuple[Array, Array, Array]:
    """Render one picture.

    Args:
        solids: What stands before the camera.
        pose: Camera to world. [4, 4]
        side: Pixels along each side.
        samples: Rays per pixel and axis.

    Returns:
        Colour on white, opacity, and the distance along each pixel's first ray (inf where it
        misses), which passes through the middle of its first sample. [S, S, 3], [S, S], [S, S]
    """
    colour, alpha, depth = np.empty((side, side, 3)), np.empty((side, side)), np.empty((side, side))
    cpu = compiled("xplanes.pretraining.cpu")
    seen = _rectangles(solids, pose, side * samples)
    cpu.film(solids.arrays, seen, pose, FOCAL, samples, colour, alpha, depth)
    return colour, alpha, depth


def cast(
    solids: Solids, origins: Array, directions: Array
) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """First surface on each ray [N, 3]: distance, part, normal, colour. [N], [N], [N, 3], [N, 3]"""
    distances, owners = np.empty(len(origins)), np.empty(len(origins), dtype=np.int64)
    seen = np.zeros((len(origins), 6))
    cpu = compiled("xplanes.pretraining.cpu")
    cpu.cast(solids.arrays, origins, directions, distances, owners, seen)
    return distances, owners, seen[:, :3], seen[:, 3:]


def inside(solids: Solids, points: Array) -> NDArray[np.bool_]:
    """Which positions [N, 3] lie inside any part. [N]"""
    result = np.zeros(len(points), dtype=np.bool_)
    compiled("xplanes.pretraining.cpu").inside(solids.arrays, points, result)
    return result


_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)


def _rectangles(solids: Solids, pose: Array, side: int) -> NDArray[np.int64]:
    """Rows and columns (from, to) that each part can be seen in. [P, 4]"""
    local = solids.extents[:, None] * _CORNERS
    corners = np.einsum("pij,pcj->pci", solids.rotations, local) + solids.centres[:, None]
    x, y, z = np.moveaxis((corners - pose[:3, 3]) @ pose[:3, :3], -1, 0)
    depth = np.maximum(-z, 0.05)
    columns = (x / depth * FOCAL + 0.5) * side
    rows = (0.5 - y / depth * FOCAL) * side
    limits = [rows.min(1) - 1, rows.max(1) + 2, columns.min(1) - 1, columns.max(1) + 2]
    return np.clip(np.stack(limits, axis=-1), 0, side).astype(np.int64)
