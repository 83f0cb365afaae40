"""Whole renderings against closed forms."""

import math

import pytest
import torch

from tests.training.runs import changed
from xplanes.rendering import front_to_back, grid_renderer
from xplanes.rendering.grid_renderer import (
    BORDER,
    DIAGONAL,
    GridRenderer,
    OccupancySampler,
    OccupancySettings,
)
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.sampler import Site
from xplanes.scenes.frame import cube_frame
from xplanes.streams import TrainingState

COLOUR = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
WHITE = torch.ones(3, dtype=torch.float64)


def renderer_of(samples=64, resolution=4, **options):
    return GridRenderer(OccupancyGrid(resolution, 1, step=DIAGONAL / samples), samples, **options)


def settings_of(**changes):
    known = changed(())["model"]["sampler"]
    del known["_target_"]
    return OccupancySettings(**known | changes)


def fog(density):
    """A field of one colour and one density; a tensor density gets gradients."""

    def field(points, times):
        level = torch.as_tensor(density, dtype=points.dtype)
        return COLOUR.to(points.dtype).expand(len(points), 3), level.expand(len(points))

    return field


def diagonal_rays(dtype=torch.float64):
    """Rays through the cube's four diagonals: exactly as many steps as `samples` long."""
    corner = torch.tensor([[1.0, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, -1]], dtype=dtype)
    directions = -corner / math.sqrt(3)
    return 3 * corner, directions, torch.full((4,), 0.5, dtype=dtype)


def rays_of(count, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(count, 3, generator=generator, dtype=dtype)
    origins = 3 * origins / origins.norm(dim=-1, keepdim=True)
    target = torch.rand(count, 3, generator=generator, dtype=dtype) * 1.6 - 0.8
    directions = target - origins
    directions = directions / directions.norm(dim=-1, keepdim=True)
    return origins, directions, torch.rand(count, generator=generator, dtype=dtype)


@pytest.mark.parametrize("samples", [32, 64])
@pytest.mark.parametrize("density", [0.0, 1e-6, 0.1, 1.0, 10.0, 1e4, 1e8])
def test_fog_in_the_cube_stops_the_light_of_beer_and_lambert(samples, density):
    seen = renderer_of(samples, occlusion=0.0).render(fog(density), *diagonal_rays(), WHITE)
    opacity = -math.expm1(-density * DIAGONAL)
    assert seen.opacity.tolist() == pytest.approx([opacity] * 4, rel=1e-9, abs=1e-15)
    expected = (opacity * COLOUR + (1 - opacity) * WHITE).expand(4, 3)
    torch.testing.assert_close(seen.colour, expected, atol=1e-9, rtol=0)
    assert len(seen.samples) == 4 * samples


def test_depth_in_fog_is_the_mean_free_path_cut_at_the_far_side():
    for density in [0.5, 2.0]:
        seen = renderer_of(2000, occlusion=0.0).render(fog(density), *diagonal_rays(), WHITE)
        near, length = 3 * math.sqrt(3) - math.sqrt(3), DIAGONAL
        left = math.exp(-density * length)
        mean = 1 / density - length * left / (1 - left)
        assert seen.depth.tolist() == pytest.approx([near + mean] * 4, rel=1e-5), density


def test_dropping_what_lies_behind_costs_less_than_its_threshold():
    rays = rays_of(300)
    renderer = renderer_of(128, occlusion=0.0)
    renderer.grid.least.fill_(5.0)
    all_of_it = renderer.render(fog(5.0), *rays, WHITE)
    for occlusion in (1e-4, 1e-2):
        quick = GridRenderer(renderer.grid, 128, occlusion=occlusion)
        less = quick.render(fog(5.0), *rays, WHITE)
        assert less.samples.occluded > 0
        assert ((less.colour - all_of_it.colour).abs() <= occlusion).all()


def test_empty_cells_cost_nothing_where_there_is_nothing():
    renderer, rays = renderer_of(128, 16), rays_of(300)

    def ball(points, times):
        inside = points.norm(dim=-1) < 0.5
        return COLOUR.expand(len(points), 3), torch.where(inside, 20.0, 0.0).double()

    whole = renderer.render(ball, *rays, WHITE)
    centres = (torch.arange(16) + 0.5) / 8 - 1
    grid = torch.stack(torch.meshgrid(centres, centres, centres, indexing="ij"), dim=-1)
    renderer.grid.allow((grid.norm(dim=-1) < 0.5 + math.sqrt(3) / 16)[None])
    less = renderer.render(ball, *rays, WHITE)
    assert less.samples.empty > 0.5 * less.samples.candidates
    torch.testing.assert_close(less.colour, whole.colour, atol=1e-12, rtol=0)
    every = GridRenderer(renderer.grid, 128, skip_empty=False, occlusion=0.0)
    assert every.render(ball, *rays, WHITE).samples.empty == 0


def test_each_ray_has_its_own_time_and_background():
    def clock(points, times):
        return times[:, None].expand(-1, 3), torch.full_like(times, 1e4)

    origins, directions, _ = diagonal_rays()
    times = torch.tensor([0.1, 0.3, 0.6, 0.9]).double()
    seen = renderer_of().render(clock, origins, directions, times, WHITE)
    torch.testing.assert_close(seen.colour, times[:, None].expand(4, 3))
    own = torch.rand(4, 3, dtype=torch.float64)
    clear = renderer_of().render(fog(0.0), origins, directions, times, own)
    assert torch.equal(clear.colour, own)
    assert (clear.opacity == 0).all()
    assert (clear.depth == 0).all()


def clouds(points, times):
    """From air to what stops all light within a few samples."""
    return points.abs(), (40 * points.prod(dim=-1)).exp()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_image_is_what_training_renders_but_for_what_surfaces_hide(dtype):
    origins, directions, _ = rays_of(200, dtype)
    times, white = torch.full((200,), 0.3, dtype=dtype), WHITE.to(dtype)
    for occlusion, allowed in ((0.0, 1e-5), (1e-3, 1e-3), (0.1, 0.1)):
        renderer = renderer_of(128, occlusion=occlusion)
        whole = renderer.render(clouds, origins, directions, times, white)
        image = renderer.image(clouds, origins, directions, 0.3, white)
        for name in ("colour", "opacity"):
            apart = (image[name] - getattr(whole, name)).abs()
            assert (apart <= allowed).all(), (name, occlusion)
        assert image["colour"].dtype == dtype


def test_an_image_does_not_depend_on_how_many_samples_are_taken_at_a_time(monkeypatch):
    rays = rays_of(50, torch.float32)[:2]
    for renderer in (renderer_of(128), renderer_of(128, occlusion=0.0)):
        expected = renderer.image(clouds, *rays, 0.3, WHITE.float())
        for samples in (1, 130):
            monkeypatch.setattr(front_to_back, "AT_ONCE", samples)
            image = renderer.image(clouds, *rays, 0.3, WHITE.float())
            for name, value in image.items():
                assert torch.equal(value, expected[name]), (name, samples)


def test_an_image_does_not_ask_for_what_surfaces_hide(monkeypatch):
    monkeypatch.setattr(front_to_back, "AT_ONCE", 64)
    monkeypatch.setattr(grid_renderer, "UNPRUNED", 1.0)
    asked = []

    def wall(points, times):
        asked.append(len(points))
        return points.abs(), torch.where(points[:, 2] < 0, 1e4, 0.0)

    origins = torch.zeros(64, 3).index_fill_(1, torch.tensor(2), 3)
    directions = torch.tensor([0.0, 0, -1]).expand(64, 3)
    for occlusion, share in ((1e-3, 0.5), (0.0, 1.0)):
        asked.clear()
        renderer = renderer_of(1024, occlusion=occlusion)
        renderer.image(wall, origins, directions, 0.0, WHITE.float())
        along = 64 * 2 / renderer.step
        assert sum(asked) == pytest.approx(share * along, rel=0.01)


def test_an_image_takes_one_snapshot_of_the_field_at_its_time(monkeypatch):
    monkeypatch.setattr(GridRenderer, "rays_at_once", 7)
    taken = []

    class Clock:
        def snapshot(self, time):
            taken.append(time)
            return fog(9.0)

    origins, directions, _ = rays_of(20, torch.float32)
    image = renderer_of().image(Clock(), origins, directions, 0.3, WHITE.float())
    assert taken == [0.3]
    assert (image["opacity"] > 0).any()


def test_jitter_moves_samples_within_their_steps():
    origins, directions, times = diagonal_rays()
    renderer = renderer_of(8)
    jitter = torch.tensor([0.0, 0.25, 0.5, 0.9]).double()
    samples = renderer.render(fog(0.1), origins, directions, times, WHITE, jitter).samples
    first = samples.distances[samples.starts]
    expected = 2 * math.sqrt(3) + jitter * renderer.step
    torch.testing.assert_close(first, expected)


class Fog(torch.nn.Module):
    """One density everywhere."""

    def __init__(self, density: float) -> None:
        super().__init__()
        self.density = torch.nn.Parameter(torch.tensor(density, dtype=torch.float64))

    def forward(self, points, times):
        return COLOUR.expand(len(points), 3), self.density.expand(len(points))


def test_random_points_of_occupied_cells_pay_for_their_opacity():
    renderer, field = renderer_of(64, 6), Fog(0.7)
    sampler = OccupancySampler(renderer, settings_of(sparsity=0.5, update_every=4))
    step = DIAGONAL / 64
    once = 0.5 * 4 * step * math.exp(-0.7 * step)
    sampler.regularise(field, TrainingState(0, 3, 3, 0))
    assert field.density.grad is None
    for steps, times in ((4, 1), (8, 2), (12, 2)):
        if steps == 12:
            renderer.grid.occupied.zero_()
        sampler.regularise(field, TrainingState(0, steps, steps, 0))
        assert float(field.density.grad) == pytest.approx(times * once, rel=1e-6), steps


@pytest.mark.parametrize(("term", "other"), [("distortion", "border"), ("border", "distortion")])
def test_fog_before_a_background_pays_for_its_distortion_and_for_the_border(term, other):
    settings = settings_of(**{term: 0.5, other: 0.0}, coarse_first=False)
    batch = dict(zip(("origins", "directions", "times"), rays_of(8), strict=True))
    batch |= {"background": WHITE.expand(8, 3), "jitter": batch["times"]}
    state = TrainingState(0, 1, 1, 0)
    level = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)

    def terms(settings):
        sampler = OccupancySampler(renderer_of(), settings)
        return sampler.losses(sampler.render(fog(level), batch, state))

    site = Site(cube_frame(1.0, torch.zeros(3)), torch.zeros(12), 0, "32")
    assert terms(settings.with_constant_background(site)) == {}
    found = terms(settings.with_learnt_background())
    assert set(found) == {term}
    measured = renderer_of(surrounded=True).render(fog(level), *rays_of(8), WHITE, batch["times"])
    expected = 0.5 * float(getattr(measured, term).detach())
    assert float(found[term].detach()) == pytest.approx(expected, rel=1e-12)
    found[term].backward()
    assert level.grad != 0


@pytest.mark.parametrize(("centre", "half"), [(0.0, 0.1), (0.7, 0.1), (0.0, 1.0)])
def test_what_is_near_the_faces_of_the_cube_costs_most(centre, half):
    """A ray along x, offset from the axis, through fog between two walls."""
    density, renderer = 3.0, renderer_of(2048, surrounded=True, skip_empty=False, occlusion=0.0)

    def field(points, times):
        inside = (points[:, 0] - centre).abs() <= half
        return COLOUR.expand(len(points), 3), density * inside.to(points)

    origins = torch.tensor([[-3.0, 0.25, -0.6]], dtype=torch.float64)
    directions = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    found = renderer.render(field, origins, directions, torch.zeros(1).double(), WHITE).border
    places = torch.linspace(centre - half, centre + half, 100_001, dtype=torch.float64)
    light = density * torch.exp(-density * (places - places[0]))
    wanted = torch.trapezoid(light * places.abs().clamp_min(0.6) ** BORDER, places)
    assert float(found) == pytest.approx(float(wanted), rel=0.01)


def test_points_of_occupied_cells_lie_in_all_of_them_and_in_no_others():
    grid = OccupancyGrid(5, 3, step=0.1)
    chosen = torch.rand(len(grid.occupied), generator=torch.Generator().manual_seed(0)) < 0.2
    grid.occupied.copy_(chosen)
    uniform = torch.rand(4000, 5, generator=torch.Generator().manual_seed(1))
    cells = grid.cells(*grid.occupied_points(uniform))
    assert torch.equal(cells.unique(), chosen.nonzero()[:, 0])


@pytest.mark.parametrize(
    ("views", "timesteps", "given", "bins"),
    [
        (50, 50, "auto", 8),
        (45, 15, "auto", 8),  # Three views show each timestep.
        (60, 15, "auto", 15),
        (400, 100, "auto", 16),
        (20, 5, "auto", 8),
        (60, 15, 4, 4),
        (9, 1, "auto", 1),
        (9, 1, 4, 1),
    ],
)
def test_bins_along_time_follow_timesteps_that_several_views_show(views, timesteps, given, bins):
    times = torch.linspace(0, 1, timesteps).repeat(views // timesteps)
    assert settings_of(time_bins=given).bins(times) == bins
