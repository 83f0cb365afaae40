import functools

import pytest
import torch

from tests.refusals import assert_refused
from xplanes.decomposition import time_planes, unexplained_energy
from xplanes.decomposition.conversion import rank1_factors
from xplanes.fields.xplanes import PLANE_SETS, TIME_PLANES


def moving(frames=6, channels=3, size=12, seed=0):
    """Discs that move, different in every orientation, with exact zeros around them."""
    generator = torch.Generator().manual_seed(seed)
    sparse = torch.zeros(frames, 3, channels, size, size, dtype=torch.float64)
    grid = torch.arange(size, dtype=torch.float64)
    for frame in range(frames):
        for index in range(3):
            x, y = 4 + 0.6 * frame, 5 + index - 0.3 * frame
            inside = (grid - x) ** 2 + (grid[:, None] - y) ** 2 < 9
            colour = torch.randn(channels, 1, 1, generator=generator, dtype=torch.float64)
            sparse[frame, index] = inside * (colour + 0.3 * torch.sin(grid[:, None]))
    return sparse


def products(first, second):
    return second.mT[..., None] * first.mT[..., None, :]


def test_nine_planes_reach_the_best_rank_one_residual():
    planes = moving()[:, 0]
    wide, tall = rank1_factors(planes)
    values = torch.linalg.svdvals(planes)
    best = values[..., 1:].square().sum()
    left = (planes - products(wide, tall)).square().sum()
    assert left <= best * (1 + 1e-6) + 1e-12
    # Half of the magnitude lies in each factor.
    assert torch.allclose(wide.norm(dim=1), values[..., 0].sqrt())
    assert torch.allclose(tall.norm(dim=1), values[..., 0].sqrt())


def test_zero_slices_stay_zero():
    planes = moving()[:, 0]
    planes[2] = 0
    planes[:, 1] = 0
    wide, tall = rank1_factors(planes)
    assert not wide[2].any()
    assert not tall[..., 1].any()
    assert torch.isfinite(wide).all()


def test_rank_one_explains_more_than_random_initialisation():
    for plane_set in ["six", "nine"]:
        sparse = moving()
        rows = PLANE_SETS[plane_set]
        left = {
            dynamic: unexplained_energy(
                time_planes(sparse, plane_set=plane_set, dynamic=dynamic), sparse, rows=rows
            )
            for dynamic in ("random", "rank1")
        }
        assert left["random"] == pytest.approx(1, abs=0.01), plane_set
        assert left["rank1"] < 0.6, plane_set


SEVEN = ((0, 1), (0, 2), (3, 2))
"""A second yt."""

FURTHER = {
    "six": (PLANE_SETS["six"], [{0, 1, 2}]),
    "nine": (PLANE_SETS["nine"], [{0, 1}, {2, 3}, {4, 5}]),
    "seven": (SEVEN, [{0, 1, 2, 3}]),
    "eight": (((0, 1), (2, 3), (4, 3)), [{0, 1}, {2, 3, 4}]),  # Only zt is shared.
    "swapped": (((2, 0), (2, 1), (0, 1)), [{0, 1, 2}]),  # six in another storage order
}
"""Rows of sets of planes, and which planes their products join."""


@pytest.mark.parametrize("plane_set", FURTHER)
def test_plane_sets_and_those_of_others_recover_their_factors(monkeypatch, plane_set):
    rows, joined = FURTHER[plane_set]
    count = 1 + max(place for pair in rows for place in pair)
    monkeypatch.setitem(PLANE_SETS, plane_set, rows)
    monkeypatch.setitem(TIME_PLANES, plane_set, tuple(f"plane {n}" for n in range(count)))
    generator = torch.Generator().manual_seed(1)
    truth = [torch.randn(5, 8, 2, generator=generator, dtype=torch.float64) for _ in range(count)]
    sparse = torch.stack([products(truth[a], truth[b]) for a, b in rows], 1)
    planes = time_planes(sparse, plane_set=plane_set, noise=0)
    assert planes.shape == (count, 5, 8, 2)
    assert unexplained_energy(planes, sparse, rows=rows) < 1e-6
    # Halfway between frames too: signs do not jump.
    blend = time_planes(sparse.abs(), plane_set=plane_set, noise=0)
    for group in joined:
        agreement = sum((blend[p, 1:] * blend[p, :-1]).sum(1) for p in group)
        assert (agreement >= -1e-12).all()


def test_planes_without_a_product_and_without_a_name_are_refused(monkeypatch):
    for rows, names in [
        (((0, 1), (0, 2), (4, 2)), "xt yt zt wt yt'"),
        (SEVEN, "xt yt zt"),
        (SEVEN, "xt yt zt yt' more"),
        (SEVEN, ""),
    ]:
        monkeypatch.setitem(PLANE_SETS, "own", rows)
        monkeypatch.setitem(TIME_PLANES, "own", tuple(names.split()))
        for dynamic in ("rank1", "random"):
            call = functools.partial(time_planes, moving(), plane_set="own", dynamic=dynamic)
            words = rf"plane_set='own'.*TIME_PLANES names {len(names.split())}"
            assert_refused(ValueError, words, call, (rows, names))


def test_nothing_moves():
    sparse = torch.zeros(3, 3, 2, 4, 4)
    for plane_set in ["six", "nine"]:
        rows = PLANE_SETS[plane_set]
        planes = time_planes(sparse, plane_set=plane_set, noise=0)
        assert not planes.any()
        assert unexplained_energy(planes, sparse, rows=rows) == 0


def test_six_planes_need_square_triplanes():
    oblong = torch.ones(2, 3, 1, 4, 6)
    with pytest.raises(ValueError, match=r"plane_set='six'.*square triplanes, not 4 x 6"):
        time_planes(oblong, plane_set="six", resolution=4)
    # Nine share none, so that each plane has its own axis.
    assert time_planes(oblong, plane_set="nine", resolution=4).shape == (6, 2, 4, 1)


def test_signs_do_not_jump_between_frames():
    rows = torch.tensor([[1, -1.1], [1.1, -1], [1, -1.1]], dtype=torch.float64)
    planes = rows[:, None, :, None] * torch.arange(1.0, 6, dtype=torch.float64)
    wide, tall = rank1_factors(planes)
    alike = (wide[1:] * wide[:-1]).sum(dim=1) + (tall[1:] * tall[:-1]).sum(dim=1)
    assert (alike > 0).all()
