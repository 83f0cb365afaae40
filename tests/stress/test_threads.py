"""Results do not depend on the number of threads and are deterministic given the seed."""

import numba
import pytest
import torch

from tests.stress.models import MODELS, SLOW, settings, trained
from tests.stress.references import worst
from tests.stress.scenes import write_scene
from tests.stress.test_fields import field_of, seen
from xplanes.backend import threads

pytestmark = pytest.mark.stress

needs_two = pytest.mark.skipif(
    numba.config.NUMBA_NUM_THREADS < 2, reason="one core only: nothing to compare"
)


@needs_two
@pytest.mark.parametrize("precision", ["32", "bf16"])
@pytest.mark.parametrize("plane_set", ["three", "six", "nine"])
def test_values_and_gradients(tally, plane_set, precision):
    """Threads: values and gradients with 1 and 2"""
    results = []
    for count in (1, 2):
        with threads(count):
            field = field_of(1.0, plane_set, precision, "softplus")
            rendering, gradients = seen(field, 256, rays=512)
            results.append([rendering.colour.detach(), rendering.depth, *gradients])
    tally.finite(*results[0], *results[1])
    for one, two in zip(*results, strict=True):
        tally.error(worst(two, one), 1e-5 if precision == "32" else 2e-2)


@needs_two
@pytest.mark.parametrize("model", MODELS)
def test_training(tally, tmp_path, model):
    """Threads: parameters after 10 steps with 1 and 2, all models"""
    config = settings(model, write_scene(tmp_path, "ball"), "trainer.max_steps=10")
    states = []
    for count in (1, 2):
        with threads(count):
            states.append(trained(config, tmp_path / f"run{count}"))
    tally.finite(*(value.float() for state in states for value in state.values()))
    for name, one in states[0].items():
        if name.startswith("field"):
            tally.error(worst(states[1][name], one), 1e-2)


@pytest.mark.parametrize("precision", ["32", "bf16"])
@pytest.mark.parametrize("model", MODELS)
def test_same_seed(tally, tmp_path, model, precision):
    """Same seed twice, trainer.deterministic=true: bit-identical, all models"""
    if precision == "bf16" and model in SLOW:
        pytest.skip("this model computes in float32 alone")
    scene = write_scene(tmp_path, "ball")
    changed = ("trainer.deterministic=true", f"model.precision={precision}")
    config = settings(model, scene, *changed)
    try:
        states = [trained(config, tmp_path / f"run{number}") for number in (1, 2)]
    finally:
        torch.use_deterministic_algorithms(False)
    tally.finite(*(value.float() for value in states[0].values()))
    for name, one in states[0].items():
        assert torch.equal(one, states[1][name]), name
