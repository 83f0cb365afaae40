"""Records of objects on disk, and batches drawn from them."""

import json
import shutil

import numpy as np
import pytest
import torch

from tests.refusals import flip
from tests.synthetic.pretraining.small import SIDE, VIEW, same, small_pool
from xplanes.errors import ConfigError
from xplanes.streams import step_generator
from xplanes.synthetic.pretraining import pool as pool_module
from xplanes.synthetic.pretraining.objects import TRAINING_SEEDS, procedural_object
from xplanes.synthetic.pretraining.pool import (
    FOCAL,
    PretrainingBatches,
    cast,
    draw_sample,
    ensure_pool,
    inside,
)
from xplanes.synthetic.pretraining.settings import BatchSettings


@pytest.fixture
def short_shards(monkeypatch):
    monkeypatch.setattr(pool_module, "SHARD", 2)


def drawn(folder, count=6, **other):
    kind = {"views": 2, "side": 16, "announce": lambda _: None, **other}
    return ensure_pool(folder, TRAINING_SEEDS[:count], **kind)


def content(pool):
    return [pool[i].tobytes() for i in range(len(pool))]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a pool of three shards. Copy it before changing anything in it."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool_module, "SHARD", 2)
        drawn(folder)
    return folder


def test_records_depend_on_their_seed_only(short_shards, whole):
    pool = drawn(whole)
    assert len(pool) == 6
    assert content(pool)[3] == draw_sample(3, 2, 16)[0].tobytes()
    assert set(json.loads((whole / "pool.json").read_text())["sha256"]) == {
        *("00000.npy", "00001.npy", "00002.npy")
    }


def test_an_interrupted_pool_is_resumed(short_shards, whole, tmp_path, monkeypatch):
    calls, real = [], pool_module.draw_sample

    def stops(seed, views, side):
        calls.append(seed)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return real(seed, views, side)

    monkeypatch.setattr(pool_module, "draw_sample", stops)
    with pytest.raises(KeyboardInterrupt):
        drawn(tmp_path)
    assert content(drawn(tmp_path)) == content(drawn(whole))
    assert calls[4:] == [2, 3, 4, 5]
    calls.clear()
    drawn(tmp_path)
    assert not calls


def test_a_damaged_shard_is_generated_again(short_shards, whole, tmp_path):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    flip(tmp_path / "00001.npy", -7)
    assert content(drawn(tmp_path)) == content(drawn(whole))


def test_pools_of_another_kind_and_parts_of_shards_are_refused(whole, tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match=r"pool\.objects=100"):
        drawn(tmp_path, count=100)
    monkeypatch.setattr(pool_module, "SHARD", 2)
    with pytest.raises(ConfigError, match=f"{whole}.*'side': 16.*'side': 8"):
        drawn(whole, side=8)


def test_records_tell_the_truth():
    record, solids = draw_sample(8, 2, SIDE)[0], procedural_object(8)
    truth = inside(solids, record["points"].astype(np.float64))
    assert (truth == record["inside"]).all()
    # Seen from outside along the normal, the kept surface points are surface.
    nudged = record["surface"].astype(np.float64)
    points = torch.from_numpy(nudged)
    gaps = [part.shape.signed_distance(part.to_own(points)) for part in solids.posed().parts]
    assert torch.stack(gaps).amin(dim=0).abs().quantile(0.95) < 2e-3


def batches(pool, **other):
    counts = {"objects": 3, "near": 200, "volume": 100, "free": 100, "colour": 50, "rays": 60}
    settings = BatchSettings(**{**counts, "samples": 8, **other})
    return PretrainingBatches(pool, VIEW, settings, seed=3)


def test_batches_depend_on_seed_and_step_alone():
    pool = small_pool()
    first, again = batches(pool), batches(pool)
    again.draw(0)
    for a, b in zip(first.draw(5), again.draw(5), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(first.draw(4).points, first.draw(5).points)


def test_every_object_is_used_once_per_epoch():
    data = batches(small_pool(6))
    assert sorted(torch.cat([data._objects(0), data._objects(1)]).tolist()) == list(range(6))
    assert data._objects(2).tolist() != data._objects(0).tolist()


def test_images_points_and_rays_lie_in_one_frame():
    """Points project to where the picture shows them, mirrored or not."""
    data = batches(small_pool(6))
    for step in range(4):
        batch = data.draw(step)
        for i in range(3):
            points = batch.points[i][batch.inside[i] > 0]
            depth = points[:, 1] + VIEW.distance
            column = (points[:, 0] / depth * FOCAL + 0.5) * SIDE
            row = (0.5 - points[:, 2] / depth * FOCAL) * SIDE
            shown = batch.images[i][:, row.long().clamp(0, 23), column.long().clamp(0, 23)]
            assert ((shown.min(dim=0).values < 0.995).float().mean()) > 0.97
            own = (batch.origins[i] - torch.tensor([0, -VIEW.distance, 0])).norm(dim=-1) < 1e-4
            pixel = batch.directions[i][own]
            column = ((pixel[:, 0] / pixel[:, 1] * FOCAL + 0.5) * SIDE).long()
            row = ((0.5 - pixel[:, 2] / pixel[:, 1] * FOCAL) * SIDE).long()
            assert torch.equal(batch.images[i][:, row, column].T, batch.ray_colours[i][own])
            assert 10 < own.sum() < 60


def one_object(**counts):
    """Batches of one object, its record, and the turn of one of its views."""
    data = batches(small_pool(1), objects=1, **counts)
    record = data.pool.records(torch.tensor([0]))
    return data, record, data._turn(record["poses"][:, 1])


def test_free_points_are_empty_and_in_the_box():
    solids, (data, record, turn) = procedural_object(0), one_object(near=0, volume=0, free=400)
    points = data._free_points(record, torch.tensor([1]), turn, step_generator(0, 0))[0]
    assert points.abs().max() <= 1 + 1e-6
    world = points @ torch.linalg.inv(turn[0]).T
    assert inside(solids, world.double().numpy()).mean() < 0.005
    assert np.ptp(points.numpy(), axis=0).min() > 1.2


def test_rays_hit_where_the_object_is():
    solids, (data, record, turn) = procedural_object(0), one_object()
    origins, directions, _, hits = (
        part[0].double().numpy()
        for part in data._rays(
            record, torch.tensor([1]), turn, step_generator(1, 0), 200, middle=False
        )
    )
    back = torch.linalg.inv(turn[0]).double().numpy()
    distance = cast(solids, origins @ back.T, directions @ back.T * data.scale)[0] * data.scale
    both = np.isfinite(hits) & np.isfinite(distance)
    assert (np.isfinite(hits) == np.isfinite(distance)).mean() > 0.98
    assert np.quantile(np.abs(hits[both] - distance[both]), 0.95) < 3e-3


def test_a_pool_in_memory_gives_what_one_on_disk_gives():
    disk, numbers = small_pool(6), torch.tensor([4, 1])
    names = disk.shards[0].dtype.names
    disk.resident = {name: torch.tensor(disk.shards[0][name]) for name in names}
    held, disk.resident = disk.records(numbers), None
    read = disk.records(numbers)
    assert same(held, read)
    assert [held[name].dtype for name in read] == [value.dtype for value in read.values()]


def test_processes_generate_the_same_shards(short_shards, whole, tmp_path):
    drawn(tmp_path, workers=2)
    one, two = ((folder / "pool.json").read_text() for folder in (whole, tmp_path))
    assert one == two
