"""Training batches in the model's own frame, drawn statelessly from (seed, step)."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from xplanes.lrm.canonical import CanonicalView
from xplanes.pretraining.observe import FOCAL
from xplanes.pretraining.pool import Pool
from xplanes.pretraining.samples import SURFACE, VOLUME
from xplanes.scenes.demo.film import CAMERA_DISTANCE

DITHER = 0.01
"""Standard deviation of the distance to the surface at which its colour is asked for."""


TRIES = 3
"""Points near the surface of which one is kept."""


class PretrainingBatch(NamedTuple):
    """Input pictures and what is known of the objects, all in the model's frame.

    Attributes:
        images: RGB on white. [B, 3, S, S]
        points: Positions. [B, N, 3]
        inside: Whether they are inside, 0 or 1. [B, N]
        surface: Positions at the surface. [B, M, 3]
        colours: Their colours. [B, M, 3]
        origins: Where rays start. [B, R, 3]
        directions: Their unit directions. [B, R, 3]
        ray_colours: Colours of their pixels, on white. [B, R, 3]
        ray_alpha: Opacity of their pixels. [B, R]
        ray_hits: Distance to the surface, inf where missed. [B, R]
    """

    images: Tensor
    points: Tensor
    inside: Tensor
    surface: Tensor
    colours: Tensor
    origins: Tensor
    directions: Tensor
    ray_colours: Tensor
    ray_alpha: Tensor
    ray_hits: Tensor


class PretrainingBatches:
    """Batches of objects from a pool.

    Args:
        pool: The objects.
        view: The model's camera.
        seed: Source of all choices.
        objects: Objects in a batch.
        near: Points near the surface, per object.
        volume: Points around the object.
        free: Points in front of what some view sees.
        colour: Points at the surface.
        rays: Rays, half of them of the input view; 0 for none.
    """

    def __init__(
        self,
        pool: Pool,
        view: CanonicalView,
        *,
        seed: int,
        objects: int,
        near: int,
        volume: int,
        free: int,
        colour: int,
        rays: int,
    ) -> None:
        self.pool, self.view, self.seed, self.objects = pool, view, seed, objects
        self.near, self.volume, self.free = near, volume, free
        self.colour, self.rays = colour, rays
        self.scale = view.distance / CAMERA_DISTANCE

    def draw(self, step: int) -> PretrainingBatch:
        """The batch of a step; an object shows once in as many steps as it takes to show all."""
        turns = len(self.pool) // self.objects
        order = np.random.default_rng([self.seed, step // turns]).permutation(len(self.pool))
        random = np.random.default_rng([self.seed, step, 1])
        start = step % turns * self.objects
        drawn = [
            self._sample(self.pool[int(number)], random)
            for number in order[start : start + self.objects]
        ]
        return PretrainingBatch(
            *(torch.from_numpy(np.stack(part)).float() for part in zip(*drawn, strict=True))
        )

    def _sample(self, record: NDArray, random: np.random.Generator) -> tuple[NDArray, ...]:
        views = len(record["poses"])
        source = int(random.integers(views))
        turn = self._turn(record["poses"][source])
        near = self._near(record, random)
        chosen = np.concatenate([near, SURFACE + random.integers(VOLUME, size=self.volume)])
        points, inside = record["points"][chosen] @ turn.T, record["inside"][chosen]
        free = self._free_points(record, source, turn, random)
        at = random.integers(SURFACE, size=self.colour)
        surface = record["surface"][at] + DITHER * random.normal(size=(self.colour, 3))
        origins, directions, pixels, hits = self._rays(record, source, turn, random, self.rays)
        image = record["pictures"][source, ..., :3]
        # Mirrored and with its colours exchanged an object is another object.
        mirror, channels = random.random() < 0.5, random.permutation(3)
        if mirror:
            image = image[:, ::-1]
        sign = np.array([-1.0 if mirror else 1.0, 1.0, 1.0])
        return (
            (image[..., channels] / np.float32(255)).transpose(2, 0, 1),
            np.concatenate([points, free]) * sign,
            np.concatenate([inside, np.zeros(self.free, np.uint8)]),
            surface @ turn.T * sign,
            record["colours"][at][:, channels] / np.float32(255),
            origins * sign,
            directions * sign,
            pixels[:, channels] / np.float32(255),
            pixels[:, 3] / np.float32(255),
            hits,
        )

    def _near(self, record: NDArray, random: np.random.Generator) -> NDArray:
        """Numbers of points near the surface: of `TRIES` each, the one farthest from it. [N]

        Those that lie closer than the planes' texels can tell teach little.
        """
        tries = random.integers(SURFACE, size=(TRIES, self.near))
        apart = record["points"][tries].astype(np.float32) - record["surface"][tries]
        best = np.square(apart).sum(axis=-1).argmax(axis=0)
        return tries[best, np.arange(self.near)]

    def _turn(self, pose: NDArray) -> NDArray:
        """From the object's world to the model's frame, about the origin. [3, 3]"""
        return self.scale * self.view.rotation_matrix().numpy() @ pose[:3, :3].T.astype(float)

    def _rays(
        self,
        record: NDArray,
        source: int,
        turn: NDArray,
        random: np.random.Generator,
        count: int,
        middle: bool = True,
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Rays through pixels: origins, directions, pixels and hits, in the model's frame."""
        pictures = record["pictures"]
        views, side = pictures.shape[:2]
        view = np.where(random.random(count) < 0.5, source, random.integers(views, size=count))
        # Of two pixels take the second where the first shows nothing: half as much background.
        pixel = random.integers(side, size=(2, count, 2))
        empty = pictures[view, pixel[0, :, 0], pixel[0, :, 1], 3] == 0
        row, column = np.where(empty[:, None], pixel[1], pixel[0]).T
        # The first of two by two samples is where depth was taken.
        shift = 0.5 if middle else 0.25
        up = (0.5 - (row + shift) / side) / FOCAL
        right = ((column + shift) / side - 0.5) / FOCAL
        local = np.stack([right, up, -np.ones(count)], axis=-1)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        poses = record["poses"][view].astype(float)
        directions = np.einsum("rij,rj->ri", poses[:, :3, :3], local) @ turn.T / self.scale
        origins = poses[:, :3, 3] @ turn.T
        hits = self.scale * (record["depths"][view, row, column].astype(float) + CAMERA_DISTANCE)
        return origins, directions, pictures[view, row, column], hits

    def _free_points(
        self, record: NDArray, source: int, turn: NDArray, random: np.random.Generator
    ) -> NDArray:
        """Points between where rays enter the box and where they hit something. [F, 3]"""
        origins, directions, _, hits = self._rays(
            record, source, turn, random, self.free, middle=False
        )
        inverse = 1 / np.where(np.abs(directions) < 1e-9, 1e-9, directions)
        reach = self.view.half_side * np.abs(inverse)
        near = np.max(-origins * inverse - reach, axis=-1)
        far = np.minimum(np.min(-origins * inverse + reach, axis=-1), hits - 0.01)
        distance = near + random.random(self.free) * np.maximum(far - near, 0)
        return origins + distance[:, None] * directions
