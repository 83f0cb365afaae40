"""What runs of K-Planes, and of others with its sampler, promise."""

import pytest
import torch

from tests.baselines.checks import check_learns, check_refused, check_reload, check_resume
from tests.baselines.runs import (
    KPLANES,
    OCCUPANCY,
    PROPOSAL,
    TENSOR4D,
    TINEUVOX,
    baseline_config,
)
from tests.synthetic import ball_scene, ball_views
from xplanes.checks import parse
from xplanes.config import ConfigError
from xplanes.launch import check_keys
from xplanes.training.assembly.kplanes import kplanes_frame
from xplanes.training.assembly.site import Site, check_range
from xplanes.training.builder import build_frame, build_module

FAST = (*KPLANES, "model.channels=8", "model.learning_rate=0.03")


def test_hybrid_run_learns_goes_on_and_is_loaded(scenes, tmp_path, monkeypatch):
    config = baseline_config(scenes, "model=kplanes", *FAST, *PROPOSAL, "trainer.max_steps=36")
    folder = check_learns(config, tmp_path / "whole", gain=3)
    check_resume(config, folder, tmp_path / "broken", monkeypatch, stop=23)
    trained = check_reload(folder)
    assert set(trained.module.state_dict()) >= {"proposals.0.products.scales.0.xy"}


@pytest.mark.parametrize(
    "overrides",
    [
        ("model=kplanes_explicit", *FAST, *PROPOSAL),
        ("model=kplanes", "sampler=occupancy", *FAST, *OCCUPANCY, "trainer.max_steps=40"),
        (
            "sampler=proposal",
            "model.resolution=16",
            "model.channels=4",
            *PROPOSAL,
            "trainer.rays_per_batch=128",
            "trainer.max_steps=20",
        ),
        (
            "model=tineuvox_s",
            "sampler=proposal",
            "model.half_side=1.5",
            *[o for o in TINEUVOX if not o.startswith("sampler")],
            "model.network_learning_rate=0.004",
            *PROPOSAL,
        ),
        (
            "model=tensor4d_density",
            "sampler=proposal",
            *TENSOR4D,
            *PROPOSAL,
            "trainer.rays_per_batch=64",
            "trainer.max_steps=24",
        ),
    ],
    ids=["explicit", "grid of cells", "X-Planes", "TiNeuVox", "Tensor4D"],
)
def test_others_learn(scenes, tmp_path, overrides):
    config = baseline_config(scenes, "trainer.max_steps=30", *overrides)
    check_learns(config, tmp_path / "run", gain=2)


def test_triplanes_and_losses_of_others_are_refused(scenes):
    for words, *overrides in (
        (r"lrm=file with model=kplanes: .* model=six_planes", "model=kplanes", "lrm=file"),
        ("set loss=kplanes", "model=kplanes", "loss=default"),
        ("set loss=default", "model=six_planes", "loss=kplanes"),
    ):
        check_refused(scenes, words, *overrides)


def test_settings_that_do_not_go_together_are_refused(scenes):
    for override, words in (
        ("sampler.near=null", "set both in world units"),
        ("sampler.near=7", "must be below sampler.far=6.0"),
        ("sampler.resolutions=[64]", "one number for each density field"),
        ("model.scales=[]", "one or more numbers above 0"),
        ("model.space_low=0.9", "model.space_high=0.5"),
        ("trainer.devices=2", "one device"),
    ):
        extra = ["trainer.strategy=ddp"] if "devices" in override else []
        message = check_refused(scenes, words, "model=kplanes", override, *extra)
        assert override.split("=")[0] in message, override


def test_learning_rates_of_xplanes_are_refused():
    with pytest.raises(ConfigError, match=r"trainer\.plane_lr: .*model\.learning_rate"):
        check_keys(["model=kplanes", "trainer.plane_lr=0.1"])
    check_keys(["model=six_planes", "trainer.plane_lr=0.1"])
    check_keys(["model=kplanes", "model.learning_rate=0.1"])


def test_cameras_out_of_range_are_refused(scenes):
    config = parse(baseline_config(scenes, "model=kplanes"))
    views = ball_views(4, 0.6, distance=12.0)
    site = Site(views, kplanes_frame(config, views), "32")
    with pytest.raises(ConfigError, match=r"sampler\.far=6\.0: the cameras stand 12 to 12"):
        check_range(site, 2.0, 6.0)


def test_cube_is_the_published_one_or_the_scenes(scenes):
    views = ball_views(4, 0.6)
    config = parse(baseline_config(scenes, "model=kplanes"))
    frame = kplanes_frame(config, views)
    assert frame.scale == pytest.approx(1 / 1.3)
    assert torch.equal(frame.centre, torch.zeros(3))
    config.model.half_side = None
    assert kplanes_frame(config, views).scale > 1


def test_a_cube_of_the_wrong_size_is_said(scenes, caplog):
    config = parse(baseline_config(scenes, "model=kplanes"))
    kplanes_frame(config, ball_views(6, 0.6))
    assert not caplog.records
    kplanes_frame(config, ball_views(6, 3.0, distance=12.0))
    assert "model.half_side=1.3: the scene reaches 3." in caplog.text


def test_two_cubes_are_refused(scenes):
    words = r"data\.half_side=1\.5 with model\.half_side=1\.3"
    check_refused(scenes, words, "model=kplanes", "data.half_side=1.5")
    parse(baseline_config(scenes, "model=kplanes", "data.half_side=1.5", "model.half_side=null"))


def test_published_settings_have_the_published_number_of_parameters(scenes):
    for model, count in [("kplanes", 36_467_008), ("kplanes_explicit", 36_551_936)]:
        config = parse(baseline_config(scenes, f"model={model}"))
        scene = ball_scene(50)
        frame = build_frame(config, scene.splits["train"])
        module = build_module(config, scene, frame)
        assert sum(p.numel() for p in module.parameters() if p.requires_grad) == count, model
