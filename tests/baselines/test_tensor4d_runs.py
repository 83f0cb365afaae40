"""What runs of Tensor4D promise."""

import pytest

from tests.baselines.checks import check_learns, check_refused, check_reload, check_resume
from tests.baselines.runs import NEUS, OCCUPANCY, TENSOR4D, baseline_config
from tests.synthetic import ball_views
from xplanes.checks import parse
from xplanes.training.assembly.site import Site, scene_cube
from xplanes.training.assembly.tensor4d import tensor4d_method
from xplanes.training.sampling.base import Moment


def test_surface_run_learns_goes_on_and_is_loaded(scenes, tmp_path, monkeypatch):
    schedule = ("model.fine_from=6", "model.blur_until=15", "trainer.max_steps=20")
    config = baseline_config(scenes, "model=tensor4d", *TENSOR4D, *NEUS, *schedule)
    whole = check_learns(config, tmp_path / "whole", gain=1.5)
    # When it stops the fine level has joined, and planes are still averaged down.
    check_resume(config, whole, tmp_path / "broken", monkeypatch, stop=13)
    trained = check_reload(whole)
    assert bool(trained.module.field.canonical_planes.fine)
    assert not bool(trained.module.field.canonical_planes.blurred)


def test_density_run_learns_and_is_loaded(scenes, tmp_path):
    config = baseline_config(
        scenes,
        "model=tensor4d_density",
        *TENSOR4D,
        *OCCUPANCY,
        "trainer.rays_per_batch=128",
        "trainer.samples_per_batch=1024",
        "trainer.max_steps=20",
    )
    check_reload(check_learns(config, tmp_path / "run", gain=1.5))


def method(scenes, *overrides):
    config = parse(baseline_config(scenes, "model=tensor4d", *TENSOR4D, *overrides))
    views = ball_views(4, 0.6)
    return tensor4d_method(config, Site(views, scene_cube(config, views), "32"))


def test_planes_of_the_flow_are_trained_unless_left_out_as_released(scenes):
    for train in (True, False):
        made = method(scenes, f"model.flow_planes={str(train).lower()}")
        trained = {id(p) for group in made.groups() for p in group["params"]}
        left_out = {name for name, p in made.field.named_parameters() if id(p) not in trained}
        assert all(name.startswith("flow_planes.") for name in left_out)
        assert (len(left_out) == 0) == train
        # What is left out gathers no gradients, which nothing would clear.
        assert {n for n, p in made.field.named_parameters() if not p.requires_grad} == left_out


def test_fine_level_joins_and_planes_get_sharp_at_their_steps(scenes):
    made = method(scenes)
    for step, fine, blurred in ((0, 0, 1), (14, 0, 1), (15, 1, 1), (29, 1, 1), (30, 1, 0)):
        made.before_step(Moment(0, step, step, 0), made.optimizer(made.groups()))
        for part in (made.field.canonical_planes, made.field.flow_planes):
            assert (bool(part.fine), bool(part.blurred)) == (fine, blurred)


def test_learning_rates_are_the_published_ones(scenes):
    config = parse(baseline_config(scenes, "model=tensor4d"))
    views = ball_views(4, 0.6)
    made = tensor4d_method(config, Site(views, scene_cube(config, views), "32"))
    rates = {group["name"]: group["lr"] for group in made.groups()}
    assert rates.pop("canonical_planes") == rates.pop("flow_planes") == 0.0025
    assert set(rates.values()) == {0.0005}
    assert set(rates) == {"surface", "flow", "compression", "tint", "steepness"}
    assert made.rate(10**6, 1.0) == pytest.approx(0.1)


def test_other_samplers_triplanes_and_losses_that_lack_terms_are_refused(scenes):
    for override, words in (
        ("sampler=occupancy", "sampler=occupancy with model=tensor4d: .* neus"),
        ("sampler=proposal", "sampler=proposal with model=tensor4d: .* neus"),
        ("sampler=fixed_step", "sampler=fixed_step with model=tensor4d: .* neus"),
        ("lrm=file", "lrm=file with model=tensor4d"),
        ("loss=tensor4d_density", r"loss\.eikonal .* set loss=tensor4d"),
    ):
        check_refused(scenes, words, "model=tensor4d", override)
