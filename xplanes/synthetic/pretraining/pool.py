"""Training objects on disk: generated once, in checksummed shards; generation is resumable."""

import hashlib
import math
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from xplanes.backend import compiled
from xplanes.errors import ConfigError
from xplanes.files import read_json, replacing, write_json
from xplanes.lrm.canonical import CanonicalView
from xplanes.streams import Stream, step_generator
from xplanes.synthetic.demo.render import CAMERA_ANGLE_X, CAMERA_DISTANCE, camera_at
from xplanes.synthetic.pretraining.losses import line_box
from xplanes.synthetic.pretraining.objects import procedural_object
from xplanes.synthetic.pretraining.settings import BatchSettings
from xplanes.synthetic.pretraining.solids import Array, Solids

CPU = torch.device("cpu")

FOCAL = 0.5 / math.tan(0.5 * CAMERA_ANGLE_X)
"""Focal length of D-NeRF's cameras as a share of the image side."""


def render_solids(
    solids: Solids, pose: Array, side: int, samples: int = 2
) -> tuple[Array, Array, Array]:
    """Render one image.

    Args:
        solids: The object.
        pose: Camera-to-world matrix. [4, 4]
        side: Height and width in pixels.
        samples: Rays per pixel and axis.

    Returns:
        Colour on white, opacity, and the depth along each pixel's first ray (inf if it misses),
        which passes through the centre of the pixel's first sample. [S, S, 3], [S, S], [S, S]
    """
    colour, alpha, depth = np.empty((side, side, 3)), np.empty((side, side)), np.empty((side, side))
    cpu = compiled("xplanes.synthetic.pretraining.solids_numba")
    seen = _rectangles(solids, pose, side * samples)
    cpu.render(solids.arrays, seen, pose, FOCAL, samples, colour, alpha, depth)
    return colour, alpha, depth


def cast(
    solids: Solids, origins: Array, directions: Array
) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """First hit of each ray [N, 3]: distance, part, normal, colour. [N], [N], [N, 3], [N, 3]"""
    distances, owners = np.empty(len(origins)), np.empty(len(origins), dtype=np.int64)
    seen = np.zeros((len(origins), 6))
    cpu = compiled("xplanes.synthetic.pretraining.solids_numba")
    cpu.cast(solids.arrays, origins, directions, distances, owners, seen)
    return distances, owners, seen[:, :3], seen[:, 3:]


def inside(solids: Solids, points: Array) -> NDArray[np.bool_]:
    """Whether points [N, 3] lie inside any part. [N]"""
    result = np.zeros(len(points), dtype=np.bool_)
    compiled("xplanes.synthetic.pretraining.solids_numba").inside(solids.arrays, points, result)
    return result


_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)


def _rectangles(solids: Solids, pose: Array, side: int) -> NDArray[np.int64]:
    """Bounding rectangle of each part in the image: rows and columns (from, to). [P, 4]"""
    local = solids.extents[:, None] * _CORNERS
    corners = np.einsum("pij,pcj->pci", solids.rotations, local) + solids.centres[:, None]
    x, y, z = np.moveaxis((corners - pose[:3, 3]) @ pose[:3, :3], -1, 0)
    depth = np.maximum(-z, 0.05)
    columns = (x / depth * FOCAL + 0.5) * side
    rows = (0.5 - y / depth * FOCAL) * side
    limits = [rows.min(1) - 1, rows.max(1) + 2, columns.min(1) - 1, columns.max(1) + 2]
    return np.clip(np.stack(limits, axis=-1), 0, side).astype(np.int64)


SURFACE, VOLUME = 2048, 1024
"""Points stored per object: near the surface, and in the volume around the object."""

SPREADS = (0.01, 0.03, 0.09)
"""Standard deviations of the distance between the surface and points near it."""

STREAM = 41_011
"""Random stream of cameras and points, independent of the objects' own stream."""


def sample_type(views: int, side: int) -> np.dtype:
    """Record type of one object.

    Fields: RGB on white and opacity of each view; depth along each pixel's first ray minus the
    camera distance (inf if it misses); camera poses; points and their occupancy; surface points and
    their colours.
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
    """Generate the record of an object, deterministically from its seed. [1]"""
    solids, random = procedural_object(seed), np.random.default_rng([STREAM, seed])
    record = np.zeros(1, sample_type(views, side))
    for view, (azimuth, elevation) in enumerate(_cameras(random, views)):
        pose = camera_at(azimuth, elevation).numpy()
        colour, alpha, depth = render_solids(solids, pose, side)
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
    # Occupancy is evaluated at the rounded points.
    record["inside"][0] = inside(solids, record["points"][0].astype(np.float64))
    return record


def view_cameras(seed: int, views: int) -> list[tuple[float, float]]:
    """Azimuth and elevation of an object's cameras, in degrees."""
    return _cameras(np.random.default_rng([STREAM, seed]), views)


def _cameras(random: np.random.Generator, views: int) -> list[tuple[float, float]]:
    """Elevation is mostly low; 15% of the views are from above."""
    found = []
    for _ in range(views):
        elevation = random.uniform(3, 50) if random.random() < 0.85 else random.uniform(50, 85)
        found.append((random.uniform(0, 360), elevation))
    return found


def surface_points(solids: Solids, random: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Sample the surface by casting random rays from above and from the sides.

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


VERSION = 1
"""Version of the records; increase it whenever a seed gives a different record."""

SHARD = 256
"""Objects per file."""

RECORD = "pool.json"

Records = dict[str, Tensor]
"""Fields of `sample_type` by name, of several objects. [B, ...] each"""


class Pool:
    """Records of objects: on a GPU in its memory, else read from disk on demand.

    Args:
        shards: Memory-mapped records of `sample_type`. [SHARD] each
        device: Where records are wanted.
    """

    def __init__(self, shards: tuple[NDArray, ...], device: torch.device = CPU) -> None:
        self.shards, self.device = shards, device
        self.resident: Records | None = None
        if device.type != "cpu":
            names = shards[0].dtype.names or ()
            self.resident = {
                name: torch.cat([torch.tensor(shard[name], device=device) for shard in shards])
                for name in names
            }

    def __len__(self) -> int:
        return sum(len(shard) for shard in self.shards)

    def __getitem__(self, number: int) -> Any:
        """The record of an object by its index in the pool."""
        shard, index = divmod(number, SHARD)
        return self.shards[shard][index]

    def records(self, numbers: Tensor) -> Records:
        """The records of objects by their indices in the pool. [B]"""
        if self.resident is not None:
            numbers = numbers.to(self.device)
            return {name: values[numbers] for name, values in self.resident.items()}
        rows = np.stack([self[number] for number in numbers.tolist()])
        return {name: torch.tensor(rows[name]) for name in rows.dtype.names or ()}


def ensure_pool(
    folder: Path,
    seeds: range,
    *,
    views: int,
    side: int,
    device: torch.device = CPU,
    workers: int = 1,
    announce: Callable[[str], None] = print,
) -> Pool:
    """Records of all objects with these seeds; missing shards are generated.

    Args:
        folder: Folder of the shards; created if missing.
        seeds: Seeds of the objects, a whole number of shards.
        views: Images per object.
        side: Height and width of an image in pixels.
        device: Where the records are wanted.
        workers: Processes that generate shards; 1 for this one.
        announce: Receives progress messages.

    Raises:
        ConfigError: If the folder holds a pool with other settings, or its index is damaged.
    """
    if len(seeds) % SHARD:
        raise ConfigError(f"pool.objects={len(seeds)}: must be a multiple of {SHARD}")
    kind = {"version": VERSION, "first": seeds.start, "views": views, "side": side, "shard": SHARD}
    record = _read(folder, kind)
    paths = [folder / f"{number:05d}.npy" for number in range(len(seeds) // SHARD)]
    missing = [
        (path, seeds[number * SHARD : (number + 1) * SHARD], views, side)
        for number, path in enumerate(paths)
        if path.name not in record["sha256"] or record["sha256"][path.name] != _digest(path)
    ]
    for done, (name, digest) in enumerate(_generated(missing, workers), 1):
        record["sha256"][name] = digest
        write_json(folder / RECORD, record)
        if done % 8 == 0 or done == len(missing):
            announce(f"generated {done * SHARD} of {len(missing) * SHARD} missing objects")
    return Pool(tuple(np.load(path, mmap_mode="r") for path in paths), device)


Shard = tuple[Path, range, int, int]
"""File, seeds, views and side of a shard."""


def _generated(missing: list[Shard], workers: int) -> Iterator[tuple[str, str | None]]:
    """Generate shards; gives the name and SHA-256 of each file."""
    if min(workers, len(missing)) < 2:
        yield from map(_generate, missing)
        return
    draw_sample(missing[0][1][0], *missing[0][2:])  # Compiles, for all processes.
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as processes:
        yield from processes.map(_generate, missing)


def _generate(shard: Shard) -> tuple[str, str | None]:
    path, seeds, views, side = shard
    drawn = [draw_sample(seed, views, side) for seed in seeds]
    with replacing(path) as temporary:
        np.save(temporary, np.concatenate(drawn))
    return path.name, _digest(path)


def _read(folder: Path, kind: dict[str, int]) -> dict[str, Any]:
    path = folder / RECORD
    if not path.is_file():
        return {**kind, "sha256": {}}
    try:
        record = read_json(path)
    except ValueError as problem:
        raise ConfigError(
            f"pool.root={folder}: {problem}; delete it to generate the objects again"
        ) from problem
    found = {key: record.get(key) for key in kind}
    if found != kind:
        raise ConfigError(
            f"pool.root={folder} holds a pool with {found}, not {kind}: name another folder"
        )
    return record


def _digest(path: Path) -> str | None:
    """SHA-256 of a file; None if it does not exist."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


DITHER = 0.01
"""Standard deviation of the offset from the surface at which colours are supervised."""


TRIES = 3
"""Candidates per point near the surface; the farthest from the surface is used."""


class PretrainingBatch(NamedTuple):
    """Input images and supervision, in the model's frame.

    Attributes:
        images: RGB on white, in [0, 1]. [B, 3, S, S]
        points: Positions. [B, N, 3]
        inside: Their occupancy, 0 or 1. [B, N]
        surface: Positions near the surface. [B, M, 3]
        colours: Their colours, in [0, 1]. [B, M, 3]
        origins: Ray origins. [B, R, 3]
        directions: Unit ray directions. [B, R, 3]
        ray_colours: Colours of their pixels, on white. [B, R, 3]
        ray_alpha: Opacity of their pixels. [B, R]
        ray_hits: Distance to the surface, inf for rays that miss. [B, R]
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
        counts: Numbers of objects, points and rays; half of the rays are from the input view.
        seed: Seed of all random choices.
    """

    def __init__(
        self, pool: Pool, view: CanonicalView, counts: BatchSettings, *, seed: int
    ) -> None:
        self.pool, self.view, self.counts, self.seed = pool, view, counts, seed
        self.side = pool.shards[0]["pictures"].shape[2]
        self.scale = view.distance / CAMERA_DISTANCE

    def draw(self, step: int) -> PretrainingBatch:
        """The batch of a step; each epoch uses every object at most once."""
        device, side, counts = self.pool.device, self.side, self.counts
        count = counts.objects
        random = step_generator(self.seed, step, Stream.PRETRAINING_BATCHES, device)
        record = self.pool.records(self._objects(step))
        views = record["poses"].shape[1]
        source = torch.randint(views, (count,), generator=random, device=device)
        each = torch.arange(count, device=device)
        turn = self._turn(record["poses"][each, source])
        volume = torch.randint(VOLUME, (count, counts.volume), generator=random, device=device)
        chosen = torch.cat([self._near(record, random), SURFACE + volume], dim=1)
        points = _take(record["points"], chosen).float() @ turn.mT
        free = self._free_points(record, source, turn, random)
        inside = torch.cat([record["inside"].gather(1, chosen), torch.zeros_like(free[..., 0])], 1)
        at = torch.randint(SURFACE, (count, counts.colour), generator=random, device=device)
        shift = torch.randn(count, counts.colour, 3, generator=random, device=device)
        surface = _take(record["surface"], at).float() + DITHER * shift
        origins, directions, pixels, hits = self._rays(record, source, turn, random, counts.rays)
        image = record["pictures"][each, source, ..., :3].permute(0, 3, 1, 2)
        # Augmentation: mirroring and permuting the colour channels.
        mirror = torch.rand(count, 1, 1, 1, generator=random, device=device) < 0.5
        channels = torch.rand(count, 3, generator=random, device=device).argsort(dim=1)
        image = torch.where(mirror, image.flip(-1), image)
        image = image.gather(1, channels[..., None, None].expand(-1, -1, side, side))
        sign = torch.ones(count, 1, 3, device=device)
        sign[..., 0] = torch.where(mirror[:, 0, 0], -1.0, 1.0)

        def shown(colours: Tensor) -> Tensor:
            return colours.gather(2, channels[:, None].expand(colours.shape)) / 255

        return PretrainingBatch(
            images=image / 255,
            points=torch.cat([points, free], dim=1) * sign,
            inside=inside,
            surface=surface @ turn.mT * sign,
            colours=shown(_take(record["colours"], at)),
            origins=origins * sign,
            directions=directions * sign,
            ray_colours=shown(pixels[..., :3]),
            ray_alpha=pixels[..., 3] / 255,
            ray_hits=hits,
        )

    def _objects(self, step: int) -> Tensor:
        """Indices of a step's objects. [B]"""
        count = self.counts.objects
        turns = len(self.pool) // count
        epoch = step_generator(self.seed, step // turns, Stream.PRETRAINING_ORDER)
        start = step % turns * count
        return torch.randperm(len(self.pool), generator=epoch)[start : start + count]

    def _near(self, record: Records, random: torch.Generator) -> Tensor:
        """Indices of points near the surface: of `TRIES` candidates, the farthest from it. [B, N]

        Points much closer to the surface than one texel carry little information.
        """
        near = self.counts.near
        shape = self.counts.objects, near * TRIES
        tries = torch.randint(SURFACE, shape, generator=random, device=self.pool.device)
        apart = _take(record["points"], tries).float() - _take(record["surface"], tries).float()
        best = apart.square().sum(dim=-1).unflatten(1, (near, TRIES)).argmax(dim=2)
        return tries.gather(1, TRIES * torch.arange(near, device=best.device) + best)

    def _turn(self, poses: Tensor) -> Tensor:
        """Rotation and scale from objects' world to the model's frame. [B, 4, 4] -> [B, 3, 3]"""
        return self.scale * self.view.rotation_matrix().to(poses) @ poses[:, :3, :3].mT

    def _rays(
        self,
        record: Records,
        source: Tensor,
        turn: Tensor,
        random: torch.Generator,
        count: int,
        middle: bool = True,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Rays through pixels: origins, directions, pixels and hits, in the model's frame."""
        objects, views, side = record["pictures"].shape[:3]
        shape, device = (objects, count), self.pool.device
        own = torch.rand(shape, generator=random, device=device) < 0.5
        other = torch.randint(views, shape, generator=random, device=device)
        view = torch.where(own, source[:, None], other)
        tries = torch.randint(side * side, (2, *shape), generator=random, device=device)
        tries = tries + view * side * side
        # Of two candidates, take the second if the first is background: fewer background rays.
        pictures = record["pictures"].flatten(1, 3)
        pixel = torch.where(pictures[..., 3].gather(1, tries[0]) == 0, tries[1], tries[0])
        row, column = pixel % (side * side) // side, pixel % side
        # Depth belongs to the first of the 2 x 2 samples of a pixel.
        shift = 0.5 if middle else 0.25
        up = (0.5 - (row + shift) / side) / FOCAL
        right = ((column + shift) / side - 0.5) / FOCAL
        local = functional.normalize(torch.stack([right, up, -torch.ones_like(up)], dim=-1), dim=-1)
        poses = turn[:, None] @ record["poses"][..., :3, :]
        at = poses.flatten(2).gather(1, view[..., None].expand(-1, -1, 12)).unflatten(-1, (3, 4))
        directions = (at[..., :3] @ local[..., None])[..., 0] / self.scale
        depth = record["depths"].flatten(1).gather(1, pixel).float()
        hits = self.scale * (depth + CAMERA_DISTANCE)
        return at[..., 3], directions, _take(pictures, pixel), hits

    def _free_points(
        self, record: Records, source: Tensor, turn: Tensor, random: torch.Generator
    ) -> Tensor:
        """Points between the near bound of the box and the first hit of a ray. [B, F, 3]"""
        count = self.counts.free
        origins, directions, _, hits = self._rays(record, source, turn, random, count, middle=False)
        near, far = line_box(origins, directions, self.view.half_side)
        far = torch.minimum(far, hits - 0.01)
        share = torch.rand(near.shape, generator=random, device=self.pool.device)
        distance = near + share * (far - near).clamp_min(0)
        return origins + distance[..., None] * directions


def _take(values: Tensor, at: Tensor) -> Tensor:
    """Rows of each object. [B, N, C], [B, M] -> [B, M, C]"""
    return values.gather(1, at[..., None].expand(-1, -1, values.shape[-1]))
