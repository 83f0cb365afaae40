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
from tests.training.runs import broken_off, checkpoint, metrics, same_state
from xplanes.files import read_rows
from xplanes.run import run
from xplanes.tools.evaluate import evaluate
from xplanes.tools.render import VideoOptions, render_video
from xplanes.tools.runs import load_run

FAST = ("model=kplanes", *KPLANES, "model.channels=8", "model.learning_rate=0.03")

GAUSSIANS = (
    *("data.resolution=24", "data.train_views=10", "trainer.max_steps=60"),
    *("model.count=200", "model.degree_every=10"),
    *under("model.densify", every=6, first=4, reset_every=30, until=0.7),
)

RUNS = {
    "kplanes": (3, 23, (*FAST, *PROPOSAL, "trainer.max_steps=36")),
    "kplanes in cells": (
        2,
        None,
        (*FAST, "model/sampler=occupancy", *OCCUPANCY, "trainer.max_steps=60"),
    ),
    "six_planes with proposals": (
        2,
        None,
        (
            *("model/sampler=proposal", *PROPOSAL, "model.rays.per_batch=128"),
            *under("model", resolution=16, channels=4),
            "trainer.max_steps=20",
        ),
    ),
    # Stopped between two growths: the grid and the moments of another size are loaded.
    "tineuvox": (
        3,
        23,
        (
            *("model=tineuvox_s", *TINEUVOX, "model.network_learning_rate=0.004"),
            "trainer.max_steps=34",
        ),
    ),
    # Stopped when the fine level has joined, and planes are still averaged down.
    "tensor4d": (
        1.5,
        13,
        (
            *("model=tensor4d", *TENSOR4D, *NEUS, *under("model", fine_from=6, blur_until=15)),
            "trainer.max_steps=20",
        ),
    ),
    "tensor4d_density": (
        1.5,
        None,
        (
            *("model=tensor4d_density", *TENSOR4D, *OCCUPANCY, "trainer.max_steps=20"),
            *under("model.rays", per_batch=128, samples_per_batch=1024),
        ),
    ),
    # Stopped between two rounds of densification, in the second stage: rows, moments and
    # statistics of another number than the first are loaded.
    "gaussians_hexplane": (
        3,
        27,
        (
            *("model=gaussians_hexplane", *GAUSSIANS),
            *under("model", resolution=8, channels=4, width=16, time_resolution=4),
        ),
    ),
    "gaussians_deform": (
        3,
        27,
        ("model=gaussians_deform", *GAUSSIANS, *under("model", depth=2, width=16, time_noise=0.1)),
    ),
    "gaussians_spacetime": (
        3,
        27,
        ("model=gaussians_spacetime", *GAUSSIANS, "lrm=field", "lrm.steps=60"),
    ),
}
"""Least gain in dB, the step at which another run fails and is resumed, and the overrides."""


def scores(folder):
    return [float(row["psnr"]) for row in read_rows(folder / "curve.csv")]


@pytest.mark.parametrize("name", RUNS)
def test_a_run_learns_resumes_to_the_same_bits_and_is_loaded(scenes, tmp_path, name):
    gain, stop, overrides = RUNS[name]
    config = baseline_config(scenes, *overrides, f"preparation.cache={tmp_path}/cache")
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    run(config, whole, [], resume=False)
    found = scores(whole)
    assert found[-1] > found[0] + gain, found
    content = metrics(whole)
    assert content["parameters"] > 0
    assert (content["samples_per_ray"] > 0) == ("gaussians" not in name)
    assert content["steps_skipped"] == 0

    if stop:
        broken_off((stop,), config, broken)
        run(config, broken, [], resume=True)
        assert scores(broken) == found
        same_state(*(checkpoint(folder)["state_dict"] for folder in (whole, broken)))

    trained = load_run(whole, device="cpu")
    scored = evaluate(trained, "none")["test"]["psnr"]
    assert scored == pytest.approx(content["test"]["psnr"], abs=1e-6)
    assert render_video(trained, VideoOptions(frames=2, size=8)).stat().st_size > 0
    field = trained.module.field
    if name == "kplanes":
        assert "proposals.0.products.scales.0.xy" in trained.module.state_dict()
    if name == "tineuvox":
        assert int(field.voxels) == 20**3
    if name == "tensor4d":
        assert bool(field.canonical_planes.fine)
        assert not bool(field.canonical_planes.blurred)
    if name.startswith("gaussians"):
        assert len(field) != 200
        assert field.deforms
        moments = checkpoint(whole)["optimizer_states"][0]["state"]
        assert len(moments[0]["exp_avg"]) == len(field)
