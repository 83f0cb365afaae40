"""What runs of K-Planes, and of others with its sampler, promise."""

from dataclasses import replace

import pytest
import torch

from tests.balls import ball_scene, ball_views
from tests.baselines.checks import check_learns, check_refused, check_reload, check_resume
from tests.baselines.runs import KPLANES, OCCUPANCY, PROPOSAL, baseline_config
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.models.initialisation import Method
from xplanes.rendering.sampler import Site, check_range
from xplanes.scenes.frame import CubeHints
from xplanes.training.module import RadianceModule

FAST = (*KPLANES, "model.channels=8", "model.learning_rate=0.03")


@pytest.mark.slow
def test_hybrid_run_learns_resumes_and_is_loaded(scenes, tmp_path):
    config = baseline_config(scenes, "model=kplanes", *FAST, *PROPOSAL, "trainer.max_steps=36")
    folder = check_learns(config, tmp_path / "whole", gain=3)
    check_resume(config, folder, tmp_path / "broken", stop=23)
    trained = check_reload(folder)
    assert set(trained.module.state_dict()) >= {"proposals.0.products.scales.0.xy"}


OTHERS = {
    "grid of cells": ("model=kplanes", "model/sampler=occupancy", *FAST, *OCCUPANCY),
    "X-Planes": (
        *("model/sampler=proposal", "model.resolution=16", "model.channels=4", *PROPOSAL),
        *("model.rays.per_batch=128", "trainer.max_steps=20"),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["grid of cells", "X-Planes"])
def test_others_learn(scenes, tmp_path, name):
    config = baseline_config(scenes, "trainer.max_steps=60", *OTHERS[name])
    check_learns(config, tmp_path / "run", gain=2)


def test_triplanes_and_losses_of_others_are_refused(scenes):
    words = r"lrm=file with model=kplanes: .* model=six_planes"
    check_refused(scenes, words, "model=kplanes", "lrm=file")
    losses = {
        name: baseline_config(scenes, f"model={name}")["model"]["loss"]
        for name in ("kplanes", "six_planes")
    }
    for model, other, problem in (
        ("kplanes", "six_planes", ": there is no such setting"),
        ("six_planes", "kplanes", ", floaters.*: they are not set"),
    ):
        config = baseline_config(scenes, f"model={model}")
        config["model"]["loss"] = losses[other]
        with pytest.raises(ConfigError, match=rf"model\.loss\.opacity{problem}"):
            Experiment.read(config)


def test_settings_that_do_not_go_together_are_refused(scenes):
    for override, words in (
        ("model.sampler.near=null", r"model\.sampler\.near=None with far=6\.0: set both in world"),
        ("model.sampler.near=7", r"model\.sampler\.near=7\.0: must be below far=6\.0"),
        (
            "model.sampler.resolutions=[64]",
            r"model\.sampler\..* with resolutions=\[64\]: both need one number per density field",
        ),
        ("model.scales=[]", r"model\.scales=\[\]: must be one or more numbers above 0"),
        ("model.space_low=0.9", r"model\.space_low=0\.9: must not be above space_high=0\.5"),
        ("trainer.devices=2", r"trainer\.devices=2 .*one device"),
    ):
        extra = ["trainer.strategy=ddp"] if "devices" in override else []
        check_refused(scenes, words, "model=kplanes", override, *extra)


def test_cameras_out_of_range_are_refused_or_named(scenes, caplog):
    settings = Method.read(baseline_config(scenes, "model=kplanes")).model
    views = ball_views(4, 0.6, distance=12.0)
    site = Site(settings.frame(views), views.times, 0, "32", views=views)
    with pytest.raises(ConfigError, match=r"model\.sampler\.far=6\.0: the cameras stand 12 to 12"):
        check_range(site, 2.0, 6.0)
    near = ball_views(4, 0.6, distance=5.8)
    check_range(replace(site, views=near), 2.0, 6.0)
    assert "far=6: the scene is 5." in caplog.text
    # The sampler asks.
    with pytest.raises(ConfigError, match=r"model\.sampler\.far=6\.0: the cameras stand 12 to 12"):
        settings.sampler.build(settings.build(site).field, site)


def test_cube_is_the_published_one_or_the_scenes(scenes):
    views = ball_views(4, 0.6)
    settings = Method.read(baseline_config(scenes, "model=kplanes")).model
    frame = settings.frame(views)
    assert frame.scale == pytest.approx(1 / 1.3)
    assert torch.equal(frame.centre, torch.zeros(3))
    assert replace(settings, half_side=None).frame(views).scale > 1


def test_a_cube_of_the_wrong_size_is_said(scenes, caplog):
    settings = Method.read(baseline_config(scenes, "model=kplanes")).model
    settings.frame(ball_views(6, 0.6))
    assert not caplog.records
    settings.frame(ball_views(6, 3.0, distance=12.0))
    assert "model.half_side=1.3: the scene reaches 3." in caplog.text


def test_two_cubes_are_refused(scenes):
    module = RadianceModule(baseline_config(scenes, "model=kplanes"))
    with pytest.raises(ConfigError, match=r"data\.half_side=1\.5 with model\.half_side=1\.3"):
        module.build(ball_scene(), hints=CubeHints(1.5))
    module = RadianceModule(baseline_config(scenes, "model=kplanes", "model.half_side=null"))
    module.build(ball_scene(), hints=CubeHints(1.5))
    assert module.frame.scale == pytest.approx(1 / 1.5)
