"""Objects on disk, drawn once: shards that are checked, and go on where they stopped."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplanes.config import ConfigError
from xplanes.files import read_json, replacing, write_json
from xplanes.pretraining.samples import draw_sample

VERSION = 1
"""Raised when the same seed would come out as another record."""

SHARD = 256
"""Objects in a file."""

RECORD = "pool.json"


@dataclass(frozen=True)
class Pool:
    """Records of objects, read from disk as they are needed.

    Attributes:
        shards: Records of `sample_type`, mapped into memory. [SHARD] each
    """

    shards: tuple[NDArray, ...]

    def __len__(self) -> int:
        return sum(len(shard) for shard in self.shards)

    def __getitem__(self, number: int) -> Any:
        """The record of an object by its place in the pool."""
        shard, index = divmod(number, SHARD)
        return self.shards[shard][index]


def ensure_pool(
    folder: Path,
    seeds: range,
    *,
    views: int,
    side: int,
    announce: Callable[[str], None] = print,
) -> Pool:
    """The records of all objects with these seeds; what is missing on disk is drawn.

    Args:
        folder: Where the shards lie; made if missing.
        seeds: Seeds of the objects, a whole number of shards.
        views: Pictures of each object.
        side: Their pixels along each side.
        announce: Takes a line now and then while objects are drawn.

    Raises:
        ConfigError: If the folder holds a pool of another kind, or its record is damaged.
    """
    if len(seeds) % SHARD:
        raise ConfigError(f"pool.objects={len(seeds)}: must be a multiple of {SHARD}")
    kind = {"version": VERSION, "first": seeds.start, "views": views, "side": side, "shard": SHARD}
    record = _read(folder, kind)
    shards = []
    for number in range(len(seeds) // SHARD):
        path = folder / f"{number:05d}.npy"
        if path.name not in record["sha256"] or record["sha256"][path.name] != _digest(path):
            first = seeds[number * SHARD]
            drawn = [draw_sample(seed, views, side) for seed in range(first, first + SHARD)]
            with replacing(path) as temporary:
                np.save(temporary, np.concatenate(drawn))
            record["sha256"][path.name] = _digest(path)
            write_json(folder / RECORD, record)
            if number % 8 == 7 or (number + 1) * SHARD == len(seeds):
                announce(f"drawn {(number + 1) * SHARD} of {len(seeds)} objects")
        shards.append(np.load(path, mmap_mode="r"))
    return Pool(tuple(shards))


def _read(folder: Path, kind: dict[str, int]) -> dict[str, Any]:
    path = folder / RECORD
    if not path.is_file():
        return {**kind, "sha256": {}}
    try:
        record = read_json(path)
    except ValueError as problem:
        raise ConfigError(
            f"pool.root={folder}: {problem}; delete it, and the objects are drawn again"
        ) from problem
    found = {key: record.get(key) for key in kind}
    if found != kind:
        raise ConfigError(
            f"pool.root={folder} holds a pool of {found}, wanted is {kind}: name another folder"
        )
    return record


def _digest(path: Path) -> str | None:
    """SHA-256 of a file; None where there is none."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
