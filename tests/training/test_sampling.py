"""Numbers of samples in training steps and in images."""

from pathlib import Path

import pytest
import torch

from tests.training.runs import same_state, small_config
from xplanes.errors import ConfigError
from xplanes.models.initialisation import Method
from xplanes.rendering import grid_renderer
from xplanes.rendering.grid_renderer import OccupancySampler
from xplanes.rendering.sampler import Site
from xplanes.scenes.frame import cube_frame
from xplanes.streams import TrainingState

STEPS_OF_A_RAY = {"training": 16, "filled": 24, "pictures": 40}


def fog(points, times):
    return torch.ones_like(points), torch.ones_like(points[:, 0])


def sampler(field, *overrides: str, times=None, **site) -> OccupancySampler:
    """What draws samples of a field of the whole cube."""
    settings = Method.read(small_config(Path(), *overrides)).model.sampler
    times = torch.zeros(1) if times is None else times
    frame = cube_frame(1.0, torch.zeros(3))
    return settings.build(field, Site(frame, times=times, seed=0, precision="32", **site))


def along_the_diagonal() -> dict[str, torch.Tensor]:
    ray = torch.full((1, 3), 3**-0.5)
    return {
        "origins": -3 * ray,
        "directions": ray,
        "times": torch.zeros(1),
        "background": torch.ones(3),
        "jitter": torch.full((1,), 0.5),
    }


class Surrounded:
    """Fog in front of a learnt background."""

    background = object()
    __call__ = staticmethod(fog)


@pytest.mark.parametrize(
    ("field", "positions", "filled"),
    [(fog, 50, "training"), (Surrounded(), 49, "training"), (Surrounded(), 50, "filled")],
)
def test_images_of_the_trained_field_have_samples_of_their_own(
    monkeypatch, field, positions, filled
):
    changes = "model.sampler.samples=16", "model.sampler.render_samples=40"
    sampling = sampler(field, *changes, positions=positions)
    for name, kind in (("", "training"), ("UNPRUNED", filled), ("HALF_EMPTY", "pictures")):
        if name:
            monkeypatch.setattr(grid_renderer, name, 1.0)
        seen = sampling.renderer.render(fog, **along_the_diagonal())
        assert len(seen.samples) == STEPS_OF_A_RAY[kind]
    state = TrainingState(0, sampling.pruned_at, 0, 0)
    trained = sampling.render(fog, along_the_diagonal(), state)
    assert len(trained.samples) == STEPS_OF_A_RAY["training"]
    assert sampling.renderer.grid is sampling.grid


def test_room_follows_the_samples_of_batches_and_pictures_need_none():
    sampling = sampler(fog, samples_per_batch=8192)
    assert sampling._training_renderer.room == 10240
    for samples, room in ((3000, 4096), (1, 1024), (10**6, 10240)):
        sampling.expect(samples)
        assert sampling._training_renderer.room == room, samples
    assert sampling.renderer.room is None
    assert sampler(fog)._training_renderer.room is None


def test_no_samples_for_images_are_refused():
    with pytest.raises(ConfigError, match=r"model\.sampler\.render_samples=0: must be above 0"):
        sampler(fog, "model.sampler.render_samples=0")


def test_images_find_empty_space_that_the_grid_has_not_pruned_yet():
    asked = []

    def half(points, times):
        """Colourful fog on one side of the cube."""
        asked.append(points)
        return (0.5 + 0.5 * points).clamp(0, 1), 3.0 * (points[:, 0] < 0)

    options = ("model.sampler.grid_resolution=8", "model.sampler.samples=64")
    sampling = sampler(half, *options, times=torch.rand(6))
    before = {name: value.clone() for name, value in sampling.grid.named_buffers()}
    heights = torch.linspace(-0.9, 0.9, 8**3)
    origins = torch.stack([torch.full_like(heights, -3.0), heights, 0.3 * heights], dim=1)
    rays = origins, torch.tensor([1.0, 0, 0]).expand_as(origins)
    found = sampling.renderer.image(half, *rays, 0.4, torch.ones(3))
    searched = sum(map(len, asked[1:]))
    assert len(asked[0]) == 8**3  # All cells of one bin, once.
    asked.clear()
    few = sampling.renderer.image(half, *(ray[:20] for ray in rays), 0.4, torch.ones(3))
    alike = {name: value[:20] for name, value in found.items()}
    torch.testing.assert_close(few, alike, atol=1e-5, rtol=0)
    unsearched = sum(map(len, asked)) * len(heights) / 20
    assert 0.5 * unsearched < searched < 0.7 * unsearched
    same_state(before, dict(sampling.grid.named_buffers()))


def test_images_search_for_what_is_there_at_their_time():
    def passing(points, times):
        """A ball that crosses the cube, by a field without a snapshot."""
        centre = torch.stack([1.4 * times - 0.7, 0 * times, 0 * times], dim=1)
        near = (points - centre).norm(dim=1) < 0.25
        return 0.5 + 0.5 * points, 50.0 * near

    options = ("model.sampler.grid_resolution=16", "model.sampler.samples=64")
    sampling = sampler(passing, *options, times=torch.rand(6))
    grid = torch.linspace(-0.95, 0.95, 32)
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    origins = torch.stack([x, y, torch.full_like(x, 3.0)], dim=-1).view(-1, 3)
    rays = origins, torch.tensor([0.0, 0, -1]).expand_as(origins)
    for time in (0.1, 0.5, 0.9):
        found = sampling.renderer.image(passing, *rays, time, torch.ones(3))
        times = torch.full((len(origins),), time)
        whole = sampling.renderer.render(passing, *rays, times, torch.ones(3))
        torch.testing.assert_close(found["opacity"], whole.opacity, atol=2e-3, rtol=0)
