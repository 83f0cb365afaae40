"""What runs of Gaussians promise."""

import pytest

from tests.baselines.runs import under
from tests.baselines.test_runs import check_run
from tests.training.runs import checkpoint

SMALL = (
    *("data.resolution=24", "data.train_views=10", "trainer.max_steps=60"),
    *("model.count=200", "model.degree_every=10"),
    *under("model.densify", every=6, first=4, reset_every=30, until=0.7),
)
MODELS = {
    "gaussians_hexplane": (
        3,
        under("model", resolution=8, channels=4, width=16, time_resolution=4),
    ),
    "gaussians_deform": (3, under("model", depth=2, width=16, time_noise=0.1)),
    "gaussians_spacetime": (2, ("lrm=field", "lrm.steps=60")),  # Begins as a field after 60 steps.
}
"""Least gain in dB, and overrides."""


@pytest.mark.parametrize("name", MODELS)
def test_a_run_learns_grows_resumes_to_the_same_bits_and_is_loaded(scenes, tmp_path, name):
    gain, own = MODELS[name]
    overrides = (f"model={name}", *SMALL, *own)
    # Stopped between two rounds of densification, in the second stage: rows, moments and
    # statistics of another number than the first are loaded.
    trained, whole = check_run(scenes, tmp_path, gain, 27, overrides)
    field = trained.module.field
    assert len(field) != 200
    assert field.deforms
    moments = checkpoint(whole)["optimizer_states"][0]["state"]
    assert len(moments[0]["exp_avg"]) == len(field)
