"""Rays that no camera should send, through the renderer of every model."""

from pathlib import Path

import pytest
import torch

from tests.stress.models import MODELS, built, settings
from tests.stress.scenes import write_scene
from xplanes.streams import TrainingState

pytestmark = pytest.mark.stress

RAYS = {
    "no direction, inside": ((0.1, 0.2, 0.3), (0.0, 0.0, 0.0)),
    "no direction, outside": ((3.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "parallel to a face, inside": ((0.1, 0.2, -3.0), (0.0, 0.0, 1.0)),
    "parallel to a face, outside": ((1.5, 0.2, -3.0), (0.0, 0.0, 1.0)),
    "in a face": ((1.0, 0.0, -3.0), (0.0, 0.0, 1.0)),
    "along an edge": ((1.0, 1.0, -3.0), (0.0, 0.0, 1.0)),
    "from the middle": ((0.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    "from a corner inwards": ((1.0, 1.0, 1.0), (-0.57735, -0.57735, -0.57735)),
    "from a corner outwards": ((1.0, 1.0, 1.0), (0.57735, 0.57735, 0.57735)),
    "missing": ((3.0, 3.0, 3.0), (0.0, 0.0, 1.0)),
    "looking away": ((3.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    "grazing": ((-3.0, 0.9999999, 0.0), (0.99999994, 1e-8, 0.0)),
    "nearly parallel": ((0.0, 0.0, -3.0), (1e-30, 1e-38, 1.0)),
    "from far away": ((1e6, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    "from farther away": ((0.0, 1e18, 0.0), (0.0, -1.0, 0.0)),
}
UNSEEN = ("parallel to a face, outside", "missing", "looking away", "no direction, outside")
"""Rays whose opacity must be 0, unless a model samples a range of distances whatever lies there."""


def batch(names):
    origins, directions = (torch.tensor([RAYS[name][i] for name in names]) for i in (0, 1))
    count = len(names)
    return {
        "origins": origins,
        "directions": directions,
        "times": torch.linspace(0, 1, count),
        "background": torch.full((count, 3), 0.25),
        "target": torch.rand(count, 3),
        "alpha": torch.ones(count),
        "jitter": torch.linspace(0, 0.999, count),
    }


@pytest.fixture(scope="module", params=MODELS)
def module(request, tmp_path_factory: pytest.TempPathFactory):
    scene: Path = write_scene(tmp_path_factory.mktemp("scenes"), "ball")
    return built(settings(request.param, scene))


@pytest.mark.parametrize("loops", ["1", "0"])
def test_degenerate_rays(tally, module, monkeypatch, loops):
    """Degenerate rays, one at a time and together, forward and backward, all models"""
    monkeypatch.setenv("XPLANES_CPU_LOOPS", loops)
    state = TrainingState(seed=0, step=20, batch=0, rank=0)
    for names in ([name] for name in RAYS):
        check(tally, module, names, state)
    check(tally, module, list(RAYS), state)


def check(tally, module, names, state) -> None:
    rays = batch(names)
    rendering = module.sampler.render(module.field, rays, state)
    terms = module.model.losses(rendering, rays, state) | module.sampler.losses(rendering)
    sum(terms.values()).backward()
    module.sampler.observe(rendering)
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    assert gradients or len(names) == 1, "the rays together must reach the parameters"
    tally.finite(rendering.colour, rendering.opacity, rendering.depth, *terms.values(), *gradients)
    module.zero_grad(set_to_none=True)
    for name, opacity, colour in zip(
        names, rendering.opacity.tolist(), rendering.colour.detach(), strict=True
    ):
        assert -1e-4 <= opacity <= 1 + 1e-4, name
        if name in UNSEEN and getattr(module.renderer, "near", None) is None:
            assert opacity == pytest.approx(0, abs=1e-4), name
            torch.testing.assert_close(colour, rays["background"][0], atol=1e-4, rtol=0)
