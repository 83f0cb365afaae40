"""What runs of Gaussians promise."""

import torch

from tests.baselines.checks import check_reload, check_resume, metrics, scores
from tests.baselines.runs import baseline_config
from xplanes.pipeline import run

SMALL = (
    "model.count=200",
    "model.resolution=8",
    "model.channels=4",
    "model.width=16",
    "model.time_resolution=4",
    "model.network_lr=0.005",
    "model.degree_every=10",
    "model.densify.every=6",
    "model.densify.first=4",
    "model.densify.reset_every=30",
    "model.densify.until=0.7",
    "trainer.max_steps=60",
)


def test_run_learns_grows_resumes_and_is_loaded(scenes, tmp_path, monkeypatch):
    config = baseline_config(
        scenes, "model=gaussians_hexplane", *SMALL, "data.resolution=24", "data.train_views=10"
    )
    folder = tmp_path / "whole"
    run(config, folder, [], resume=False)
    found = scores(folder)
    assert found[-1] > found[0] + 3, found
    assert metrics(folder)["steps_skipped"] == 0
    # Between two rounds of densification, in the second stage: rows, moments and statistics of
    # another number than the first are loaded.
    check_resume(config, folder, tmp_path / "broken", monkeypatch, stop=27)
    field = check_reload(folder).module.field
    assert len(field) != 200
    assert field.deforms
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    moments = state["optimizer_states"][0]["state"]
    assert len(moments[0]["exp_avg"]) == len(field)
