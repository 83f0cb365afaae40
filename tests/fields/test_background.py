"""The background: contraction of space, colours against an oracle, rays that need none."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from xplanes.baselines.kplanes.field import contract_cube
from xplanes.config import CONF
from xplanes.fields.background import Background, contract
from xplanes.models import background as module
from xplanes.models.background import BackgroundSettings, weighted_median
from xplanes.rendering.behind import background_colour, behind
from xplanes.streams import Stream, TrainingState, initial_values


def contracted(point, length=lambda point: math.hypot(*point)):
    """Mip-NeRF 360, Eq. 10, in float64."""
    point = np.asarray(point, np.float64)
    length = length(point)
    return point if length <= 1 else (2 - 1 / length) * point / length


def world(samples=5, channels=3):
    with initial_values(3, Stream.BACKGROUND):
        background = Background(channels, 16, width=8, samples=samples)
    with torch.no_grad():
        background.planes.mul_(2000)  # Colours and densities that differ from place to place.
    return background


def some_rays(count, seed=0):
    """Rays from around the cube: most hit it, some miss it, some begin inside."""
    generator = torch.Generator().manual_seed(seed)
    origins = 4 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    origins[::7] *= 0.1
    target = 1.2 * torch.randn(count, 3, generator=generator)
    return origins, torch.nn.functional.normalize(target - origins, dim=1)


@pytest.mark.parametrize(
    ("function", "length"),
    [
        (contract, lambda points: points.norm(dim=-1)),
        (contract_cube, lambda points: points.abs().amax(dim=-1)),
    ],
    ids=["ball", "cube"],
)
def test_contraction_is_the_formula_and_keeps_the_unit_ball_or_cube(function, length):
    generator = torch.Generator().manual_seed(0)
    sizes = 10 ** (6 * torch.rand(500, 1, generator=generator) - 3)
    points = torch.randn(500, 3, generator=generator) * sizes
    found = function(points)
    expected = [
        contracted(point, lambda point: float(length(torch.tensor(point))))
        for point in points.double().numpy()
    ]
    assert np.abs(found.numpy() - np.stack(expected)).max() < 5e-7
    inside = length(points) < 0.999
    assert inside.sum() > 50
    assert torch.equal(found[inside], points[inside])
    assert (length(found) < 2 + 1e-6).all()


def settings_of(**changes):
    known = yaml.safe_load((CONF / "model" / "six_planes.yaml").read_text())["background"]
    return BackgroundSettings(**known | changes)


def exit_of(origin, direction):
    """Where a ray leaves the cube; None if it misses it."""
    near, far = 0.0, math.inf
    for o, d in zip(origin, direction, strict=True):
        first, second = sorted(((-1 - o) / d, (1 - o) / d))
        near, far = max(near, first), min(far, second)
    return far if far > near else None


@pytest.mark.parametrize(("samples", "jittered"), [(0, False), (1, True), (5, False), (5, True)])
def test_rays_are_composited_from_the_cube_to_infinity(samples, jittered):
    background = world(samples)
    origins, directions = some_rays(40)
    jitter = torch.linspace(0, 0.9, 40) if jittered else None
    found = background_colour(background, origins, directions, jitter).detach().numpy()
    misses, within = 0, [0.5] * 40 if jitter is None else jitter.tolist()
    for origin, direction, colour, place in zip(
        origins.double().numpy(), directions.double().numpy(), found, within, strict=True
    ):
        start = exit_of(origin, direction)
        misses += start is None
        start = start or 0.5 * np.linalg.norm(origin)
        steps = [start / (1 - i / samples) for i in range(samples)]
        middles = [start / (1 - (i + place) / samples) for i in range(samples)]
        edges = [*(contracted(origin + t * direction) for t in steps), 2 * direction]
        points = [*(contracted(origin + t * direction) for t in middles), 2 * direction]
        shown, density = background(torch.tensor(np.array(points), dtype=torch.float32))
        expected, light = np.zeros(3), 1.0
        for i, (own, thick) in enumerate(zip(shown.tolist(), density.tolist(), strict=True)):
            depth = math.inf
            if i < samples:
                depth = thick * np.linalg.norm(edges[i + 1] - edges[i])
            expected += light * (1 - math.exp(-depth)) * np.array(own)
            light *= math.exp(-depth)
        assert colour == pytest.approx(expected, abs=2e-5)
    assert 3 < misses < 30


def test_rays_without_light_left_look_no_further():
    background = world()
    origins, directions = some_rays(30)
    opacity = torch.linspace(0, 1, 30)
    opacity[::3] = 1.0
    seen = []
    background.decoder.register_forward_hook(lambda *given: seen.append(len(given[2][0])))
    plain = torch.ones(3)
    found = behind(SimpleNamespace(background=background), origins, directions, opacity, plain)
    whole = background_colour(background, origins, directions)
    stopped = opacity > 0.999
    assert seen == [6 * int((~stopped).sum()), 6 * 30]
    assert torch.equal(found[stopped], torch.zeros(int(stopped.sum()), 3))
    torch.testing.assert_close(found[~stopped], whole[~stopped])
    assert behind(SimpleNamespace(background=None), origins, directions, opacity, plain) is plain
    assert behind(lambda *_: None, origins, directions, opacity, plain) is plain


@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_gradients_reach_the_background_and_are_zero_where_nothing_is_seen(opacity):
    background = world()
    opacities = torch.full((30,), opacity)
    behind(
        SimpleNamespace(background=background), *some_rays(30), opacities, torch.ones(3)
    ).sum().backward()
    for parameter in background.parameters():
        assert parameter.grad is not None
        assert parameter.grad.any() == (opacity == 0)


def optimizer_of(background):
    planes = {"params": [background.planes], "lr": 0.2}
    decoder = {"params": background.decoder.parameters(), "lr": 0.005}
    return torch.optim.Adam([planes, decoder])


def test_what_no_ray_has_crossed_keeps_the_initial_colour():
    usual = torch.tensor([0.6, 0.3, 0.2])
    with initial_values(3, Stream.BACKGROUND):
        background = Background(8, 32, width=32, samples=8, colour=usual)
    origins, directions = some_rays(600)
    origins, seen = 0.1 * origins, directions[:, 2] > 0
    with torch.no_grad():
        at_first = background_colour(background, origins, directions)
    assert (at_first - usual).abs().max() < 0.005
    optimizer = optimizer_of(background)
    for _ in range(40):
        optimizer.zero_grad()
        error = background_colour(background, origins[seen], directions[seen]) - usual
        error.square().mean().backward()
        optimizer.step()
    with torch.no_grad():
        others = background_colour(background, origins[~seen], directions[~seen])
    assert error.abs().max() < 0.05
    assert (others - usual).abs().max() < 0.05


def test_darkest_and_brightest_initial_colours_can_be_left():
    usual = torch.tensor([0.0, 1.0, 0.5])
    background = Background(3, 16, width=8, samples=0, colour=usual)
    shown = background_colour(background, *some_rays(4)).detach()
    assert (shown - torch.tensor([0.02, 0.98, 0.5])).abs().max() < 0.005


@pytest.mark.parametrize(
    ("weights", "rows"), [([1.0, 1, 1, 0], (2, 2)), ([0.0, 1, 0, 2], (3, 3)), ([0.0] * 4, (1, 0))]
)
def test_medians_count_weights(weights, rows):
    values = torch.tensor([[3.0, 0.1], [1.0, 0.3], [2.0, 0.2], [9.0, 0.9]])
    found = weighted_median(values, torch.tensor(weights))
    assert found.tolist() == [values[rows[0], 0], values[rows[1], 1]]


def shown_elsewhere(weight):
    """What a background shows where no view looks, after most views have shown darkness."""
    with initial_values(3, Stream.BACKGROUND):
        background = Background(8, 32, width=32, samples=8, colour=torch.tensor([0.6, 0.3, 0.2]))
    settings = settings_of(unseen=weight)
    origins, directions = some_rays(600)
    origins = 0.1 * origins
    bright, other = directions[:, 1] > 0.9, directions[:, 0] < -0.9
    seen = bright | (directions[:, 2] > 0.8)
    rays = {"target": 0.8 * bright[seen, None].float().expand(-1, 3)}
    rendering: Any = SimpleNamespace(opacity=torch.zeros(len(rays["target"])), shown=None)
    optimizer = optimizer_of(background)
    for step in range(160):
        optimizer.zero_grad()
        shown = background_colour(background, origins[seen], directions[seen])
        error = (shown - rays["target"]).square().mean()
        terms = settings.losses(background, rendering, rays, TrainingState(0, step, step, 0))
        (error + sum(terms.values())).backward()
        optimizer.step()
    assert error < 1e-3, "what is seen does not give way"
    with torch.no_grad():
        return float(background_colour(background, origins[other], directions[other]).mean())


@pytest.mark.parametrize(
    ("opacity", "shown", "usual"),
    [
        ([0.0, 0.0, 1.0, 1.0, 1.0], None, 0.2),
        ([0.0, 0.0, 0.0, 0.0, 0.0], [True, True, False, False, False], 0.2),
        ([1.0, 1.0, 1.0, 1.0, 1.0], None, 0.5),  # No ray passes.
    ],
)
def test_the_usual_colour_is_that_of_rays_that_pass(monkeypatch, opacity, shown, usual):
    monkeypatch.setattr(module, "background_colour", lambda _, origins, __: 0 * origins)
    settings = settings_of()
    seen = None if shown is None else torch.tensor(shown)
    rendering: Any = SimpleNamespace(opacity=torch.tensor(opacity), shown=seen)
    rays = {"target": torch.tensor([0.2, 0.2, 0.5, 0.8, 0.9])[:, None].expand(-1, 3)}
    terms = settings.losses(None, rendering, rays, TrainingState(0, 0, 0, 0))  # type: ignore[arg-type]
    scale = module.UNSEEN_EVERY * settings.unseen
    assert float(terms["unseen"]) == pytest.approx(scale * usual**2)


def test_directions_that_no_view_shows_get_the_usual_colour():
    assert shown_elsewhere(0.01) < 0.1 < shown_elsewhere(0.0)
