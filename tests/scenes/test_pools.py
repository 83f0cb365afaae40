"""Pixels that rays are drawn through: every pixel of each kind, and little memory for them."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from xplanes.scenes import pools
from xplanes.scenes.pools import PixelPools


def masks(shape, seed=0):
    """Random pixels that are near, plain and valid, the last image far and valid throughout."""
    generator = torch.Generator().manual_seed(seed)
    near, plain, valid = (torch.rand(shape, generator=generator) < p for p in (0.4, 0.3, 0.8))
    near[-1], valid[-1] = False, True
    return near, plain, valid


@pytest.mark.parametrize(("block", "side"), [(16, 20), (1024, 20), (2**16, 20), (2**16, 300)])
def test_the_list_holds_each_pixel_once_kind_by_kind(monkeypatch, block, side):
    monkeypatch.setattr(pools, "BLOCK", block)
    near, plain, valid = masks((3, side, side + 1))  # Up to indices of 19 bits.
    kinds = [~near & valid, near & plain & valid, near & ~plain & valid]
    expected = [kind.flatten().nonzero()[:, 0] for kind in kinds]
    found = PixelPools(near.clone(), plain, valid)
    assert found.sizes == tuple(map(len, expected))
    assert torch.equal(found.numbers(torch.arange(found.total)), torch.cat(expected))


def test_plain_pixels_are_no_kind_where_all_near_ones_are_plain():
    near, *_ = masks((2, 8, 9))
    far = int((~near).sum())
    everywhere = PixelPools(near.clone(), torch.ones_like(near))
    nowhere = PixelPools(near.clone(), torch.zeros_like(near))
    assert everywhere.sizes == nowhere.sizes == (far, 0, near.numel() - far)


@pytest.mark.parametrize("near", [True, False])
def test_pixels_of_one_kind_take_no_list(near):
    found = PixelPools(torch.full((2, 5, 7), near))
    found.share(0.0 if near else 1.0, 0.0)
    assert found.listed is None
    uniform = torch.linspace(0, 1, 71, dtype=torch.float64)
    far, pixels = found.pick(torch.full_like(uniform, 0.5), uniform)
    assert torch.equal(far, torch.full_like(far, not near))
    assert torch.equal(pixels, (uniform * 70).long().clamp(max=69))


GROWTH = """
from pathlib import Path
import torch
from tests.scenes.test_store import FRAME, RAYS, replace
from tests.balls import ball_views
from xplanes.scenes.batches import RayBatches

def peak():
    # Not that of getrusage, in which the parent's counts.
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line.split()[1] for line in lines if line.startswith("VmHWM")))


torch.set_num_threads(1)
settings = replace(RAYS, skip_background=True)
RayBatches(ball_views(2, 0.5, size=40), FRAME, settings, seed=0)
views = ball_views(150, 0.5, size=300)
before = peak()
RayBatches(views, FRAME, settings, seed=0)
print((peak() - before) / views.nbytes)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="needs Linux's /proc")
def test_drawing_is_prepared_in_little_more_memory_than_the_images_take():
    call = [sys.executable, "-c", GROWTH]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert 0.3 < float(done.stdout) < 1.8
