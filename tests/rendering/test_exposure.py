"""Exposures of cameras: gains that are learnt, used in training alone, and stored."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from tests.training.test_surroundings import built
from xplanes.rendering.base import Rendering
from xplanes.rendering.exposure import ExposureSampler
from xplanes.rendering.sampler import Sampler
from xplanes.scenes.frame import CameraGroups
from xplanes.streams import TrainingState

GAINS = torch.tensor([[0.8, 1.0, 1.1], [1.25, 1.0, 1.0], [1.0, 1.0, 1 / 1.1]])
"""Three cameras whose geometric mean is 1 in each channel."""

CAMERAS = CameraGroups(torch.tensor([0, 1, 1, 2]), torch.zeros(3, 3))


class Painted(Sampler):
    """Renders one colour for each ray, whatever the field."""

    renderer = None  # type: ignore[assignment]

    def __init__(self) -> None:
        self.colour = torch.full((4, 3), 0.5, requires_grad=True)
        self.samples: Any = None

    def render(self, field, rays, state):
        nothing = torch.zeros(4)
        return Rendering(self.colour, nothing, nothing, nothing, self.samples)  # type: ignore[arg-type]


def test_gains_of_cameras_are_found_and_their_mean_is_one():
    inner = Painted()
    sampler = ExposureSampler(inner, CAMERAS, start=5)
    true = torch.rand(1, 3, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.3
    rays = {"view": torch.arange(4)}
    target = true * GAINS[CAMERAS.index]
    (group,) = sampler.groups()
    optimizer = torch.optim.Adam([*group["params"], inner.colour], lr=0.01)
    for step in range(400):
        rendering = sampler.render(None, rays, TrainingState(0, step, step, 0))
        assert (rendering.colour is inner.colour) == (step < 5)
        # What the cameras see is the same.
        same = (inner.colour - inner.colour.mean(dim=0)).square().sum()
        error = (rendering.colour - target).square().sum() + same
        loss = error + sum(sampler.losses(rendering).values())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    torch.testing.assert_close(sampler.exposures(torch.tensor([0, 1, 3])), GAINS, rtol=0, atol=0.01)
    torch.testing.assert_close(inner.colour, true.expand(4, 3), rtol=0, atol=0.01)
    spread = GAINS.log().square().mean().sqrt()
    assert sampler.scalars()["sampler/exposures_spread"] == pytest.approx(float(spread), abs=0.01)


def test_gains_learn_nothing_from_rays_that_were_left_out():
    inner = Painted()
    inner.samples = SimpleNamespace(shown=torch.tensor([True, False, False, True]))
    sampler = ExposureSampler(inner, CAMERAS, start=0)
    rays = {"view": torch.arange(4)}
    sampler.render(None, rays, TrainingState(0, 0, 0, 0)).colour[1:3].sum().backward()
    assert not sampler.exposures.logarithms.grad.any()


@pytest.mark.parametrize(
    ("kind", "overrides", "matched"),
    [
        ("world", (), True),
        ("white", (), False),
        ("world", ("model.rays.match_exposure=false",), False),
        ("world", ("recipe=fair",), False),
    ],
)
def test_exposures_are_matched_where_images_show_surroundings(kind, overrides, matched):
    module = built(kind, *overrides)
    assert ("exposures" in module.sampler.modules) == matched
    assert ("exposures.logarithms" in module.state_dict()) == matched
