"""What runs of the baselines promise: they learn, resume to the same bits, and are loaded."""

import pytest

from tests.baselines.runs import (
    KPLANES,
    NEUS,
    OCCUPANCY,
    PROPOSAL,
    TENSOR4D,
    TINEUVOX,
    baseline_config,
    under,
)
from tests.training.runs import broken_off, checkpoint, metrics, same_state, scores
from xplanes.run import run
from xplanes.tools.evaluate import evaluate
from xplanes.tools.render import VideoOptions, render_video
from xplanes.tools.runs import load_run

FAST = ("model=kplanes", *KPLANES, "model.channels=8", "model.learning_rate=0.03")

FEW_RAYS = under("model.rays", per_batch=128, samples_per_batch=1024)
PLANES = (*under("model", resolution=16, channels=4), FEW_RAYS[0])
CELLS = (*OCCUPANCY, *FEW_RAYS)
SOON = under("model", fine_from=6, blur_until=15)

RUNS = {
    "kplanes": (3, 23, 36, (*FAST, *PROPOSAL)),
    "kplanes in cells": (2, None, 60, (*FAST, "model/sampler=occupancy", *OCCUPANCY)),
    "six_planes with proposals": (2, None, 20, ("model/sampler=proposal", *PROPOSAL, *PLANES)),
    # Stopped between two growths: the grid and the moments of another size are loaded.
    "tineuvox": (3, 23, 34, ("model=tineuvox_s", *TINEUVOX, "model.network_learning_rate=0.004")),
    # Stopped when the fine level has joined, and planes are still averaged down.
    "tensor4d": (1.5, 13, 20, ("model=tensor4d", *TENSOR4D, *NEUS, *SOON)),
    "tensor4d_density": (1.5, None, 20, ("model=tensor4d_density", *TENSOR4D, *CELLS)),
}
"""Least gain in dB, the step at which another run fails and is resumed, steps, and overrides."""


def check_run(scenes, folder, gain, stop, overrides):
    """A run learns, repeats its bits after a failure, and is loaded. Returns it, and its folder."""
    config = baseline_config(scenes, *overrides, f"preparation.cache={folder}/cache")
    whole, broken = folder / "whole", folder / "broken"
    run(config, whole, [], resume=False)
    found = scores(whole)
    assert found[-1] > found[0] + gain, found
    content = metrics(whole)
    assert content["parameters"] > 0
    assert content["steps_skipped"] == 0
    if stop:
        broken_off((stop,), config, broken)
        run(config, broken, [], resume=True)
        assert scores(broken) == found
        same_state(*(checkpoint(each)["state_dict"] for each in (whole, broken)))
    trained = load_run(whole)
    scored = evaluate(trained, "none")["test"]["psnr"]
    assert scored == pytest.approx(content["test"]["psnr"], abs=1e-6)
    assert render_video(trained, VideoOptions(frames=2, size=8)).stat().st_size > 0
    return trained, whole


@pytest.mark.parametrize("name", RUNS)
def test_a_run_learns_resumes_to_the_same_bits_and_is_loaded(scenes, tmp_path, name):
    gain, stop, steps, overrides = RUNS[name]
    overrides = (*overrides, f"trainer.max_steps={steps}")
    trained, whole = check_run(scenes, tmp_path, gain, stop, overrides)
    assert metrics(whole)["samples_per_ray"] > 0
    field = trained.module.field
    if name == "kplanes":
        assert "proposals.0.products.scales.0.xy" in trained.module.state_dict()
    if name == "tineuvox":
        assert int(field.voxels) == 20**3
    if name == "tensor4d":
        assert bool(field.canonical_planes.fine)
        assert not bool(field.canonical_planes.blurred)
