"""What runs of Gaussians promise."""

import pytest
import torch

from tests.baselines.checks import check_reload, check_resume, scores
from tests.baselines.runs import baseline_config
from tests.training.runs import metrics
from xplanes.run import run

SMALL = (
    "data.resolution=24",
    "data.train_views=10",
    "model.count=200",
    "model.degree_every=10",
    "model.densify.every=6",
    "model.densify.first=4",
    "model.densify.reset_every=30",
    "model.densify.until=0.7",
    "trainer.max_steps=60",
)
MODELS = {
    "gaussians_hexplane": (
        *("model.resolution=8", "model.channels=4", "model.width=16", "model.time_resolution=4"),
    ),
    "gaussians_deform": ("model.depth=2", "model.width=16", "model.time_noise=0.1"),
    "gaussians_spacetime": ("lrm=field", "lrm.steps=60"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_run_learns_grows_resumes_and_is_loaded(scenes, tmp_path, name):
    cache = f"preparation.cache={tmp_path}/cache"
    config = baseline_config(scenes, f"model={name}", *SMALL, *MODELS[name], cache)
    folder = tmp_path / "whole"
    run(config, folder, [], resume=False)
    found = scores(folder)
    assert found[-1] > found[0] + 3, found
    assert metrics(folder)["steps_skipped"] == 0
    # Between two rounds of densification, in the second stage: rows, moments and statistics of
    # another number than the first are loaded.
    check_resume(config, folder, tmp_path / "broken", stop=27)
    field = check_reload(folder).module.field
    assert len(field) != 200
    assert field.deforms
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    moments = state["optimizer_states"][0]["state"]
    assert len(moments[0]["exp_avg"]) == len(field)
