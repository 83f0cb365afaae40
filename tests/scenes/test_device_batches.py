"""Rays drawn on a device: the same bits everywhere, distributed like those of the CPU."""

import itertools
from dataclasses import replace

import pytest
import torch

from tests import fake_device
from tests.scenes.common import same
from tests.scenes.test_batches import batches_of
from xplanes.scenes.batches import DeviceBatches
from xplanes.scenes.importance import MOST_TILES
from xplanes.streams import counted_uniform, step_generator

CPU = torch.device("cpu")


def splitmix(key, place):
    """A number of the generator of Steele, Lea and Flood, in Python's whole numbers."""
    bits = (key + place * 0x9E3779B97F4A7C15) % 2**64
    bits = ((bits ^ bits >> 30) * 0xBF58476D1CE4E5B9) % 2**64
    bits = ((bits ^ bits >> 27) * 0x94D049BB133111EB) % 2**64
    return bits ^ bits >> 31


def test_numbers_are_those_of_splitmix():
    for seed, step, stream in itertools.product((0, 3), (0, 10**9), (0, 1_000_003)):
        key = step_generator(seed, step, stream).initial_seed()
        expected = [(splitmix(key, place) >> 11) / 2**53 for place in range(6)]
        found = counted_uniform(seed, step, stream, (2, 3), CPU)
        assert found.flatten().tolist() == expected, (seed, step, stream)


def test_numbers_are_even_and_independent():
    found = counted_uniform(1, 2, 3, (20000, 4), CPU)
    assert 0 <= found.min() < 1e-4
    assert 1 - 1e-4 < found.max() < 1
    counts = torch.stack([torch.histc(column, 20, 0, 1) for column in found.T])
    # A chi-squared of 19 degrees of freedom is above 44 once in a thousand.
    assert ((counts - 1000).square() / 1000).sum(dim=1).max() < 50
    assert (found.T.corrcoef() - torch.eye(4)).abs().max() < 0.03
    following = counted_uniform(1, 3, 3, (20000, 4), CPU)
    assert torch.stack([found.flatten(), following.flatten()]).corrcoef()[0, 1].abs() < 0.02


@pytest.mark.parametrize(
    ("slopes", "options"),
    [
        *((slopes, {"background": kind}) for slopes in (False, True) for kind in ("white", "one")),
        (True, {"background": "random"}),
        (False, {"background": "random", "error_share": 0.5}),
    ],
    ids=str,
)
def test_batches_have_the_same_bits_on_every_device(fake_gpu, slopes, options):
    batches = batches_of(background_jitter=0.1, seed=2, rank=1, **options)
    if slopes:
        batches.add_slopes()
    errors = torch.full((MOST_TILES,), 0.1)
    errors[[0, 3]] = torch.tensor([1.0, 0.5])
    here, there = DeviceBatches(batches, CPU), DeviceBatches(batches, fake_gpu)
    errors_there = errors.to(fake_gpu)
    for step in (0, 7, 10**9):
        with fake_device.counted() as counts:
            drawn = there.draw(step, 48, errors_there)
        assert counts.totals[1:] == (0, 0)
        assert {value.device for value in drawn.values()} == {fake_gpu}
        expected = here.draw(step, 48, errors)
        assert same({name: value.cpu() for name, value in drawn.items()}, expected)
        assert len(drawn["times"]) == 48
        # Errors from a checkpoint may lie on the host.
        assert same(drawn, there.draw(step, 48, errors))
    assert here.draw(3).keys() == batches.draw(3).keys()
    assert not torch.equal(here.draw(3)["jitter"], here.draw(4)["jitter"])


def test_batches_are_distributed_like_those_of_the_cpu():
    plain = batches_of(per_batch=4000, background="random", background_jitter=0.1)
    drawn, expected = DeviceBatches(plain, CPU).draw(1), plain.draw(1)
    assert drawn["target"].dtype == expected["target"].dtype
    for name in ("origins", "directions", "times", "target", "background", "alpha", "jitter"):
        ours, theirs = drawn[name].double(), expected[name].double()
        spread = 2**0.5 * theirs.std(dim=0) / 4000**0.5
        assert ((ours.mean(dim=0) - theirs.mean(dim=0)).abs() < 5 * spread + 1e-9).all(), name
        torch.testing.assert_close(ours.std(dim=0), theirs.std(dim=0), rtol=0.1, atol=1e-9)
    times = plain.views.times
    moved = (drawn["times"][:, None] - times).abs().amin(dim=1) > 1e-6
    assert moved.any()
    assert not drawn["alpha"][moved].any()


def test_who_can_be_served(fake_gpu, monkeypatch):
    batches = batches_of()
    assert DeviceBatches.can_serve(batches, fake_gpu)
    assert not DeviceBatches.can_serve(batches, CPU)
    monkeypatch.setattr("xplanes.scenes.batches.memory_left", lambda _: 3.9 * batches.views.nbytes)
    assert not DeviceBatches.can_serve(batches, fake_gpu)
    batches.views = replace(batches.views)
    monkeypatch.setattr(type(batches.views), "is_stored", True)
    monkeypatch.setattr("xplanes.scenes.batches.memory_left", lambda _: float("inf"))
    assert not DeviceBatches.can_serve(batches, fake_gpu)
