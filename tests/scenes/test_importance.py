"""Importance sampling of rays: unbiased, repeatable, and drawn to where errors are large."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from tests.balls import ball_views
from tests.scenes.common import assert_own_rays, numbered, same
from tests.scenes.test_batches import VIEWS, batches_of
from xplanes.scenes import importance
from xplanes.scenes.importance import (
    CANDIDATES,
    KEPT,
    LEAST,
    MOST_TILES,
    ErrorMap,
    Tiles,
    preferred,
)


def map_of(values: dict[int, float]) -> torch.Tensor:
    """Errors by tile: 0.1, but for some."""
    errors = torch.full((MOST_TILES,), 0.1)
    for tile, value in values.items():
        errors[tile] = value
    return errors


def test_weighted_means_over_preferred_pixels_are_unbiased():
    generator = torch.Generator().manual_seed(0)
    errors = torch.rand(4000, generator=generator) ** 4
    values = errors + torch.rand(4000, generator=generator)
    offsets = (torch.arange(200, dtype=torch.float64) + 0.5) / 200
    for share in (0.3, 0.5, 0.8):
        found = []
        for offset in offsets:
            chosen, weight = preferred(errors + 1e-3, share, 1000, offset)
            assert len(chosen) == len(weight) == 1000
            assert (chosen.diff() >= 0).all()
            found.append(float((weight * values[chosen]).mean()))
        assert torch.tensor(found).mean() == pytest.approx(float(values.mean()), rel=2e-3), share


def test_pixels_are_preferred_in_proportion_to_a_mixture_of_one_and_their_errors():
    errors = torch.tensor([1.0, 3.0]).repeat_interleave(2000)
    chosen, weight = preferred(errors, 0.5, 1000, torch.tensor(0.5))
    # Errors of half and one and a half times the mean, mixed with 1: 0.75 and 1.25.
    assert int((chosen >= 2000).sum()) == 625
    assert torch.equal(weight.unique(), torch.tensor([1 / 1.25, 1 / 0.75]))


def test_no_pixel_is_chosen_twice_because_of_a_single_bad_tile():
    errors = torch.full((4000,), 1e-3)
    errors[7] = 1e6
    chosen, weight = preferred(errors, 0.9, 1000, torch.tensor(0.99))
    assert int((chosen == 7).sum()) >= 1
    assert weight.isfinite().all()
    errors[7:1007] = 1e6
    chosen, _ = preferred(errors, 0.5, 1000, torch.tensor(0.3))
    assert len(chosen.unique()) == 1000


@pytest.mark.parametrize(("count", "size"), [(3, 24), (40, 100), (300, 64)])
def test_tiles_number_pixels_in_squares(monkeypatch, count, size):
    monkeypatch.setattr(importance, "MOST_TILES", 500)
    images = torch.zeros(count, size, size + 10, 4, dtype=torch.uint8)
    views = replace(ball_views(count, 0.5, size=8), images=images, intrinsics=30.0)
    tiles = Tiles.of(views)
    assert len(views) * tiles.rows * tiles.columns <= 500 or tiles.side >= size + 10
    half = tiles.side // 2
    finer = math.ceil(size / half) * math.ceil((size + 10) / half)
    assert tiles.side == 16 or len(views) * finer > 500
    place = torch.tensor([[0, 0, 0], [0, tiles.side - 1, tiles.side - 1], [1, 0, 0]])
    first, corner, other = tiles.number(*place.T).tolist()
    assert first == corner != other
    if size > tiles.side:
        below = torch.tensor([[0, tiles.side, 0], [0, 0, tiles.side]])
        assert len({first, *tiles.number(*below.T).tolist()}) == 3


def test_rays_are_drawn_where_errors_are_large_as_a_function_of_the_step():
    views = ball_views(5, 0.5, size=48)
    batches, uniform = batches_of(views, error_share=0.5), batches_of(views)
    assert batches.tiles is not None
    assert same({k: v for k, v in batches.draw(3).items() if k != "tile"}, uniform.draw(3))
    bad = int(batches.draw(0)["tile"][0])
    errors = map_of({bad: 2.0})
    drawn = batches.draw(4, 400, errors)
    assert same(drawn, batches_of(views, error_share=0.5).draw(4, 400, errors))
    assert not torch.equal(drawn["origins"], batches.draw(5, 400, errors)["origins"])
    assert {len(value) for value in drawn.values()} == {400}
    before = float((batches.draw(4, 400)["tile"] == bad).float().mean())
    hit = drawn["tile"] == bad
    assert float(hit.float().mean()) > 1.8 * before
    assert float(drawn["weight"][hit].max()) < 1 < float(drawn["weight"][~hit].min())
    # Those that are not asked to prefer any pixel do not.
    assert same(uniform.draw(4, 400, errors), uniform.draw(4, 400))


def test_preferred_pixels_have_their_own_colours_and_rays():
    views = numbered(VIEWS)
    batch = batches_of(views, error_share=0.5).draw(2, 200, map_of({0: 1.0}))
    assert_own_rays(batch, views)


@pytest.fixture
def errors(monkeypatch: pytest.MonkeyPatch) -> ErrorMap:
    """A map that is brought up to date with each second batch, and used after the fourth."""
    monkeypatch.setattr(importance, "REFRESH", 2)
    return ErrorMap(3)


def observe(errors: ErrorMap, tile: list[int], error: list[float]) -> None:
    """A batch of rays with these squared errors."""
    target = torch.zeros(len(tile), 3)
    colour = target + torch.tensor(error).sqrt()[:, None]
    errors.observe({"tile": torch.tensor(tile), "target": target}, colour)


def test_the_map_holds_recent_mean_errors(errors):
    for tile, error in (([2], [0.1]), ([2, 5], [0.3, 0.05]), ([2], [0.8])):
        observe(errors, tile, error)
        assert errors.errors is None
    observe(errors, [2], [0.4])
    recent = (0.4 * KEPT + 1.2) / (2 * KEPT + 2)
    overall = (0.45 * KEPT + 1.2) / (3 * KEPT + 2)
    expected = torch.full((MOST_TILES,), overall)
    expected[2], expected[5] = recent, 0.05
    assert torch.allclose(errors.errors, (expected + LEAST * overall).sqrt())


def test_batches_without_tiles_leave_no_errors(errors):
    for _ in range(6):
        errors.observe({"target": torch.zeros(2, 3)}, torch.ones(2, 3))
    assert errors.errors is None
    assert errors.state_dict()["sums"].numel() == 0


def test_a_batch_that_is_not_finite_leaves_the_map_usable(errors):
    for values in ([torch.nan, torch.inf], [0.5, 0.1], [0.5, 0.1], [0.5, 0.1]):
        observe(errors, [0, 1], values)
        found = errors.errors
        assert found is None or (found.isfinite().all() and (found > 0).all())
    assert errors.errors is not None
    chosen, weight = preferred(errors.errors[: CANDIDATES * 8], 0.5, 8, torch.tensor(0.2))
    assert weight.isfinite().all()
    assert len(chosen) == 8


def test_a_map_continues_from_a_checkpoint_to_the_same_bits(errors):
    again = ErrorMap(3)
    generator = torch.Generator().manual_seed(1)
    for step in range(9):
        tile = torch.randint(0, 50, (30,), generator=generator).tolist()
        error = torch.rand(30, generator=generator).tolist()
        observe(errors, tile, error)
        if step == 4:
            again.load_state_dict(copy.deepcopy(errors.state_dict()))
            assert torch.equal(errors.errors, again.errors)
        if step > 4:
            observe(again, tile, error)
            assert torch.equal(errors.errors, again.errors)
    assert torch.equal(errors.state_dict()["sums"], again.state_dict()["sums"])
    # What one process alone has observed counts once.
    again.drop_own()
    assert torch.equal(errors.state_dict()["sums"][0], again.state_dict()["sums"][0])
    assert errors.state_dict()["sums"][1].any()
    assert not again.state_dict()["sums"][1].any()
