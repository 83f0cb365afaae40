"""What is kept of one object: pictures with depth, points with occupancy, coloured surface."""

import math

import numpy as np
from numpy.typing import NDArray

from xplanes.pretraining.objects import procedural_object
from xplanes.pretraining.observe import camera, cast, film_solids, inside
from xplanes.pretraining.solids import Array, Solids
from xplanes.scenes.demo.film import CAMERA_DISTANCE

SURFACE, VOLUME = 2048, 1024
"""Points kept near the surface, and anywhere around the object."""

SPREADS = (0.01, 0.03, 0.09)
"""Standard deviations of the distances at which points near the surface lie."""

STREAM = 41_011
"""Keeps cameras and points apart from the objects' own choices."""


def sample_type(views: int, side: int) -> np.dtype:
    """One object as a record.

    Its fields are RGB on white and opacity of each view, the distance along each pixel's first ray
    less the cameras' (inf where it misses), camera poses, points and whether they are inside, and
    points on the surface with their colours.
    """
    return np.dtype(
        [
            ("pictures", "u1", (views, side, side, 4)),
            ("depths", "f2", (views, side, side)),
            ("poses", "f4", (views, 4, 4)),
            ("points", "f2", (SURFACE + VOLUME, 3)),
            ("inside", "u1", (SURFACE + VOLUME,)),
            ("surface", "f2", (SURFACE, 3)),
            ("colours", "u1", (SURFACE, 3)),
        ]
    )


def draw_sample(seed: int, views: int, side: int) -> NDArray:
    """The record of an object, the same for the same seed. [1]"""
    solids, random = procedural_object(seed), np.random.default_rng([STREAM, seed])
    record = np.zeros(1, sample_type(views, side))
    for view, (azimuth, elevation) in enumerate(_cameras(random, views)):
        pose = camera(azimuth, elevation)
        colour, alpha, depth = film_solids(solids, pose, side)
        record["pictures"][0, view, ..., :3] = np.rint(255 * colour)
        record["pictures"][0, view, ..., 3] = np.rint(255 * alpha)
        record["depths"][0, view] = depth - CAMERA_DISTANCE
        record["poses"][0, view] = pose
    found, colours = surface_points(solids, random, SURFACE)
    record["surface"][0], record["colours"][0] = found, np.rint(255 * colours)
    spread = random.choice(SPREADS, SURFACE)[:, None]
    low, high = solids.bounds()
    near = found + spread * random.normal(size=found.shape)
    around = random.uniform(low - 0.15, high + 0.15, (VOLUME, 3))
    record["points"][0] = np.concatenate([near, around])
    # Occupancy is that of the rounded points.
    record["inside"][0] = inside(solids, record["points"][0].astype(np.float64))
    return record


def view_cameras(seed: int, views: int) -> list[tuple[float, float]]:
    """Azimuth and elevation of the cameras that see an object, in degrees."""
    return _cameras(np.random.default_rng([STREAM, seed]), views)


def _cameras(random: np.random.Generator, views: int) -> list[tuple[float, float]]:
    """Mostly from the side, at times from above."""
    found = []
    for _ in range(views):
        elevation = random.uniform(3, 50) if random.random() < 0.85 else random.uniform(50, 85)
        found.append((random.uniform(0, 360), elevation))
    return found


def surface_points(solids: Solids, random: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Points on the surface, as random lines from above and the sides first meet it.

    Returns:
        Positions and shaded colours. [N, 3], [N, 3]
    """
    low, high = solids.bounds()
    middle, radius = 0.5 * (low + high), float(np.linalg.norm(0.5 * (high - low)))
    found, colours, missing = [], [], count
    while missing > 0:
        lines = 3 * missing + 64
        height = random.uniform(-0.35, 1, lines)
        turn, flat = random.uniform(0, 2 * math.pi, lines), np.sqrt(1 - height**2)
        away = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=-1)
        across = np.stack([-np.sin(turn), np.cos(turn), np.zeros(lines)], axis=-1)
        angle, far = random.uniform(0, 2 * math.pi, lines), radius * np.sqrt(random.random(lines))
        upwards = np.cross(away, across)
        offset = (far * np.cos(angle))[:, None] * across + (far * np.sin(angle))[:, None] * upwards
        origins = middle + offset + 1.5 * radius * away
        distance, part, _, colour = cast(solids, origins, -away)
        hit = part >= 0
        found.append((origins - distance[:, None] * away)[hit][:missing])
        colours.append(colour[hit][:missing])
        missing -= len(found[-1])
    return np.concatenate(found), np.concatenate(colours)
