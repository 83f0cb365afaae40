"""What runs of Tensor4D promise."""

import pytest

from tests.balls import ball_views
from tests.baselines.checks import check_learns, check_refused, check_reload, check_resume
from tests.baselines.runs import NEUS, OCCUPANCY, TENSOR4D, baseline_config
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.models.initialisation import Method
from xplanes.rendering.sampler import Site
from xplanes.scenes.frame import scene_frame
from xplanes.streams import TrainingState


@pytest.mark.slow
def test_surface_run_learns_resumes_and_is_loaded(scenes, tmp_path):
    schedule = ("model.fine_from=6", "model.blur_until=15", "trainer.max_steps=20")
    config = baseline_config(scenes, "model=tensor4d", *TENSOR4D, *NEUS, *schedule)
    whole = check_learns(config, tmp_path / "whole", gain=1.5)
    # When it stops the fine level has joined, and planes are still averaged down.
    check_resume(config, whole, tmp_path / "broken", stop=13)
    trained = check_reload(whole)
    assert bool(trained.module.field.canonical_planes.fine)
    assert not bool(trained.module.field.canonical_planes.blurred)


@pytest.mark.slow
def test_density_run_learns_and_is_loaded(scenes, tmp_path):
    config = baseline_config(
        scenes,
        "model=tensor4d_density",
        *TENSOR4D,
        *OCCUPANCY,
        "model.rays.per_batch=128",
        "model.rays.samples_per_batch=1024",
        "trainer.max_steps=20",
    )
    check_reload(check_learns(config, tmp_path / "run", gain=1.5))


def model(scenes, *overrides):
    settings = Method.read(baseline_config(scenes, "model=tensor4d", *overrides)).model
    views = ball_views(4, 0.6)
    frame = settings.frame(views)
    assert frame.scale == scene_frame(views).scale
    return settings.build(Site(frame, views.times, 0, "32"))


def test_planes_of_the_flow_are_trained_unless_left_out_as_released(scenes):
    for train in (True, False):
        made = model(scenes, *TENSOR4D, f"model.flow_planes={str(train).lower()}")
        trained = {id(p) for group in made.groups() for p in group["params"]}
        left_out = {name for name, p in made.field.named_parameters() if id(p) not in trained}
        assert all(name.startswith("flow_planes.") for name in left_out)
        assert (len(left_out) == 0) == train
        # What is left out gathers no gradients, which nothing would clear.
        assert {n for n, p in made.field.named_parameters() if not p.requires_grad} == left_out


def test_fine_level_joins_and_planes_get_sharp_at_their_steps(scenes):
    made = model(scenes, *TENSOR4D)
    for step, fine, blurred in ((0, 0, 1), (14, 0, 1), (15, 1, 1), (29, 1, 1), (30, 1, 0)):
        made.before_step(TrainingState(0, step, step, 0), made.optimizer(made.groups()))
        for part in (made.field.canonical_planes, made.field.flow_planes):
            assert (bool(part.fine), bool(part.blurred)) == (fine, blurred)


def test_other_samplers_triplanes_and_losses_that_lack_terms_are_refused(scenes):
    for override, words in (
        ("model/sampler=occupancy", r"model\.sampler\.name=occupancy: .* model/sampler=neus"),
        ("model/sampler=proposal", r"model\.sampler\.name=proposal: .* model/sampler=neus"),
        ("model/sampler=fixed_step", r"model\.sampler\.name=fixed_step: .* model/sampler=neus"),
        ("lrm=file", "lrm=file with model=tensor4d"),
    ):
        check_refused(scenes, words, "model=tensor4d", override)
    config = baseline_config(scenes, "model=tensor4d")
    del config["model"]["loss"]["eikonal"]
    with pytest.raises(ConfigError, match=r"model\.loss\.eikonal: it is not set"):
        Experiment.read(config)
