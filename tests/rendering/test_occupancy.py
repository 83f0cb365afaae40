"""The occupancy grid: updates, decay, sweeps and pruned cells."""

import itertools
import math

import pytest
import torch

from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.streams import counted_uniform

STEP = 0.05


def grid_of(resolution=4, bins=2, **options):
    return OccupancyGrid(
        resolution, bins, step=STEP, **{"threshold": 0.01, "decay": 0.5, **options}
    )


class Even:
    """A field of one density, which keeps the places and times that it is asked for."""

    def __init__(self, density):
        self.density, self.asked = density, []

    def __call__(self, points, times):
        self.asked.append((points, times))
        return torch.zeros(len(points), 3), torch.full((len(points),), float(self.density))

    def cells(self, grid):
        """The cell of each look."""
        return torch.cat([cells_of(grid, *places) for places in self.asked])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def update(grid, field, step, by_numbers):
    """64 looks, drawn by a generator or by numbers that are given."""
    if by_numbers:
        grid.update_by(field, counted_uniform(0, step, 1, (64, 8), torch.device("cpu")))
    else:
        grid.update(field, 64, generator(step))


def cells_of(grid, points, times):
    x, y, z = ((points + 1) / 2 * grid.resolution).floor().long().unbind(dim=-1)
    time_bin = (times * grid.time_bins).floor().long()
    return ((time_bin * grid.resolution + z) * grid.resolution + y) * grid.resolution + x


def presumed(*cells):
    """A grid of 2 x 4^3 cells of which all but these are presumed empty."""
    grid = grid_of()
    likely = torch.zeros(128, dtype=torch.bool)
    likely[list(cells)] = True
    grid.presume(likely.view(2, 4, 4, 4))
    return grid


def test_presumed_cells_fill_from_their_occupied_neighbours_on():
    # The corner (3, 0, 0) of the first time bin: its neighbours are 2, 7 and 19. The next cell in
    # memory, 4, lies across the grid, and 64 + 3 in the other bin.
    grid, field = presumed(3), Even(100.0)
    grid.update(field, 3000, generator())
    assert set(field.cells(grid).tolist()) == {2, 3, 7, 19}
    assert grid.occupied.nonzero()[:, 0].tolist() == [2, 3, 7, 19]
    for _ in range(8):
        grid.update(field, 3000, generator())
    assert grid.occupied[:64].all()
    assert not grid.occupied[64:].any()


def test_half_of_the_looks_go_where_the_scene_is():
    grid = grid_of(resolution=16, bins=3)
    ball = torch.zeros(3, 16, 16, 16)
    ball[1, 4:7, 4:7, 4:7] = 100.0
    hole = ((1 * 16 + 5) * 16 + 5) * 16 + 6
    grid.density.copy_(ball.view(-1))
    grid.density[hole] = 0
    grid.occupied.copy_(grid.density > 0)
    around = torch.zeros_like(ball, dtype=torch.bool)
    around[1, 3:8, 3:8, 3:8] = True
    near = []

    def field(points, times):
        cells = cells_of(grid, points, times)
        near.append(around.view(-1)[cells].float().mean())
        return torch.zeros(len(points), 3), ball.view(-1)[cells]

    grid.update(field, 2000, generator())
    assert near[0] == pytest.approx(0.5, abs=0.03)
    assert grid.occupied[hole]
    assert torch.equal(grid.occupied, ball.view(-1) > 0)


def test_looks_beside_the_scene_stay_in_the_cube_and_its_time():
    for corner in [0, 63]:
        grid = grid_of(bins=3)
        grid.occupied.zero_()
        grid.occupied[64 + corner] = True
        near = grid._near_occupied(2000, generator())
        block = {x + 4 * y + 16 * z for x in (0, 1) for y in (0, 1) for z in (0, 1)}
        assert set(near.tolist()) == {
            64 + (cell if corner == 0 else 63 - cell) for cell in block
        }, corner


def test_likely_cells_fill_wherever_they_are():
    grid = presumed(3, 60)
    grid.density.zero_()
    grid.occupied.zero_()
    grid.update(Even(100.0), 3000, generator())
    assert grid.occupied.nonzero()[:, 0].tolist() == [3, 60]


def test_a_cell_empties_when_its_initial_density_has_decayed():
    for decay in [0.0, 0.5, 0.95]:
        grid, cell = grid_of(decay=decay), torch.tensor([7])
        looks = 0
        while grid.occupied[7] and looks < 100:
            grid.observe(cell, torch.zeros(1))
            looks += 1
        # It starts at four times what counts as empty.
        expected = 1 if decay == 0 else math.ceil(math.log(0.25) / math.log(decay) - 1e-9)
        assert looks == expected, decay
        assert grid.occupied.sum() == len(grid.occupied) - 1, decay


def test_the_least_density_falls_at_once_and_rises_slowly():
    grid, cell = grid_of(), torch.tensor([4])
    assert grid.least[4] == 0
    for _ in range(5):
        grid.observe(cell, torch.tensor([5.0]))
    assert 1 < grid.least[4] < 3
    for _ in range(60):
        grid.observe(cell, torch.tensor([5.0]))
    assert grid.least[4] == pytest.approx(5, rel=0.01)
    grid.observe(torch.tensor([4, 4, 4]), torch.tensor([5.0, 0.2, 7.0]))
    assert grid.least[4] == pytest.approx(0.2)
    assert grid.density[4] == 7


def test_a_sweep_sees_that_a_cell_lets_light_through():
    grid = grid_of()
    cells = torch.arange(len(grid.density))
    for _ in range(60):
        grid.observe(cells, torch.full((len(cells),), 50.0))
    grid.sweep(Even(3.0), generator())
    assert (grid.least == 3).all()


def test_the_threshold_is_opacity_over_one_step():
    grid, cells = grid_of(decay=0.0), torch.arange(3)
    grid.observe(cells, torch.tensor([0.0099, 0.01, 0.0101]) / STEP)
    assert grid.occupied[:3].tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("looks", "found"),
    [
        ([0.0, 0.0, 0.0], 0.5 * 4 * 0.01 / STEP),  # Half of the initial density.
        *((looks, 7.0) for looks in itertools.permutations([0.5, 7.0, 1.0])),
    ],
)
def test_many_looks_at_once_decay_a_cell_once_and_the_largest_counts(looks, found):
    grid = grid_of()
    grid.observe(torch.tensor([5, 5, 5]), torch.tensor(looks))
    assert grid.density[5] == pytest.approx(found)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 3e38])
def test_a_cell_recovers_from_an_impossible_density(bad):
    grid, cell = grid_of(), torch.tensor([2])
    grid.observe(cell, torch.tensor([bad]))
    assert grid.density.isfinite().all()
    assert grid.least.isfinite().all()
    for _ in range(60):
        grid.observe(cell, torch.zeros(1))
    assert not grid.occupied[2]
    grid.observe(cell, torch.tensor([4.0]))
    assert grid.occupied[2]


def test_time_bins_share_out_zero_to_one():
    grid = grid_of(bins=8)
    times = torch.tensor([0.0, 0.124, 0.125, 0.5, 0.999, 1.0, 2.0, -1.0])
    assert grid.bins(times).tolist() == [0, 0, 1, 4, 7, 7, 7, 0]


def test_drawn_points_lie_in_their_cells():
    grid = grid_of(5, 3)
    cells = torch.arange(len(grid.density))
    for uniform in (torch.rand(len(cells), 4, generator=generator()), torch.zeros(len(cells), 4)):
        points, times = grid.draw(cells, uniform.clamp(0.001, 0.999))
        assert torch.equal(cells_of(grid, points, times), cells)
        assert torch.equal(grid.bins(times), cells // 125)
    assert points.abs().max() <= 1


def test_update_looks_at_random_allowed_cells_in_all_bins():
    grid, field = grid_of(4, 2), Even(0.0)
    allowed = torch.rand(2, 4, 4, 4, generator=generator(3)) < 0.5
    grid.allow(allowed)
    grid.update(field, 2000, generator())
    assert torch.equal(field.cells(grid).unique(), allowed.flatten().nonzero()[:, 0])


def test_update_empties_an_empty_grid_and_finds_what_appears():
    grid, draw = grid_of(), generator()
    for _ in range(20):
        grid.update(Even(0.0), 500, draw)
    assert grid.occupied_fraction == 0
    for _ in range(5):
        grid.update(Even(3.0), 500, draw)
    assert grid.occupied_fraction == 1


@pytest.mark.parametrize("live", [None, torch.ones(128, dtype=torch.bool)])
def test_kept_cells_never_empty_unless_they_are_ruled_out(live):
    grid, draw = grid_of(), generator()
    kept, allowed = (torch.rand(2, 2, 4, 4, 4, generator=draw) < 0.5).unbind(dim=0)
    grid.allow(allowed)
    grid.keep(kept)
    for seed in range(20):
        grid.observe(torch.arange(128), torch.zeros(128), live)
        update(grid, Even(0.0), seed, by_numbers=live is not None)
        grid.sweep(Even(0.0), draw)
    assert torch.equal(grid.occupied, (kept & allowed).flatten())
    assert torch.equal(grid.at(0.7).occupied, (kept & allowed)[1].flatten())


def test_cells_that_are_ruled_out_never_fill():
    grid = grid_of()
    allowed = torch.rand(2, 4, 4, 4, generator=generator()) < 0.5
    grid.allow(allowed)
    out = ~allowed.flatten()
    everywhere = torch.arange(len(grid.density))
    assert torch.equal(grid.occupied, ~out)
    for seed in range(3):
        grid.observe(everywhere, torch.full((len(everywhere),), 1e6))
        grid.update(Even(1e6), 300, generator(seed))
        grid.sweep(Even(1e6), generator(seed))
        assert not grid.occupied[out].any()
        assert (grid.density[out] == 0).all()
        assert grid.occupied[~out].all()


def ball(points, times):
    return torch.zeros_like(points), 50.0 * (points.norm(dim=-1) < 0.5).float()


def test_a_sweep_keeps_a_ball_and_its_surroundings_alone():
    grid = grid_of(16, 2)
    grid.sweep(ball, generator())
    cells = torch.arange(len(grid.density))
    centres, _ = grid.draw(cells, torch.full((len(cells), 4), 0.5))
    distance, diagonal = centres.norm(dim=-1), math.sqrt(3) / 16
    assert grid.occupied[distance < 0.5].all()
    assert not grid.occupied[distance > 0.5 + 3 * diagonal].any()


def test_swept_cells_without_content_of_their_own_have_one_more_look():
    for decay in (0.0, 0.3, 0.95, 1.0):
        grid = grid_of(16, 1, decay=decay)
        grid.sweep(ball, generator())
        kept = grid.occupied.nonzero()[:, 0]
        if decay > 0:
            grid.observe(kept, torch.zeros(len(kept)))
            assert grid.occupied[kept].all()
        assert grid.density.isfinite().all()


def test_a_sweep_does_not_bring_empty_cells_back_and_asks_only_the_occupied():
    grid, field = grid_of(8, 1, decay=0.0), Even(9.0)
    grid.observe(torch.arange(256), torch.zeros(256))
    grid.sweep(field, generator())
    assert [len(points) for points, _ in field.asked] == [256]
    assert not grid.occupied[:256].any()
    assert grid.occupied[256:].all()


def test_samples_that_do_not_count_change_nothing():
    drawn = generator()
    cells = torch.randint(128, (40,), generator=drawn)
    density, live = 5 * torch.rand(40, generator=drawn), torch.arange(40) < 23
    ours, theirs, untouched = grid_of(), grid_of(), grid_of()
    for grid in (ours, theirs, untouched):
        grid.density.copy_(torch.rand(128, generator=generator(1)))
        grid.least.copy_(torch.rand(128, generator=generator(2)))
        grid.occupied.copy_(grid.density > grid.empty_density)
    before = {name: value.clone() for name, value in untouched.state_dict().items()}
    ours.observe(cells, density, live)
    theirs.observe(cells[live], density[live])
    untouched.observe(cells, density, torch.zeros(40, dtype=torch.bool))
    for name, value in ours.state_dict().items():
        # Compiled loops and PyTorch round a weighted mean differently.
        torch.testing.assert_close(value, theirs.state_dict()[name], rtol=1e-6, atol=1e-7)
        assert torch.equal(untouched.state_dict()[name], before[name]), name
    assert not torch.equal(ours.density, before["density"])


def test_looks_by_given_numbers_reach_the_same_cells():
    """Half of them anywhere, half beside what is occupied; never where nothing may be."""
    reached = []
    for by_numbers in (False, True):
        grid = grid_of(resolution=6, bins=1)
        corner = torch.zeros(1, 6, 6, 6, dtype=torch.bool)
        corner[0, :3, :3, :3] = True
        grid.presume(corner)
        allowed = torch.ones(1, 6, 6, 6, dtype=torch.bool)
        allowed[0, 0] = False
        grid.allow(allowed)
        before, field = grid.occupied.clone(), Even(0.0)
        for step in range(200):
            grid.density.copy_(before * 10.0)
            grid.occupied.copy_(before)
            update(grid, field, step, by_numbers)
        reached.append(field.cells(grid).bincount(minlength=216))
    plain, counted = reached
    # The twin leaves out cells that must stay empty before it asks the field, the other after.
    asked = plain > 0
    share = counted[asked] / counted[asked].sum()
    torch.testing.assert_close(share, plain[asked] / plain[asked].sum(), atol=0.004, rtol=0.2)
    assert (plain > 0).sum() > 20


@pytest.mark.parametrize("by_numbers", [False, True])
def test_looks_never_fill_cells_that_must_stay_empty(by_numbers):
    grid = grid_of(resolution=6, bins=1)
    corner = torch.zeros(1, 6, 6, 6, dtype=torch.bool)
    corner[0, :2, :2, :2] = True
    grid.presume(corner)
    near = torch.zeros(6, 6, 6, dtype=torch.bool)
    near[:2, :2, :2] = near[2, :2, :2] = near[:2, 2, :2] = near[:2, :2, 2] = True
    for step in range(20):
        before = grid.density.clone(), grid.occupied.clone()
        update(grid, Even(100.0), step, by_numbers)
        assert not (grid.occupied.view(6, 6, 6) & ~near).any()
        grid.density.copy_(before[0])
        grid.occupied.copy_(before[1])
