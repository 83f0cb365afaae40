"""What runs of Tensor4D promise."""

import pytest

from tests.baselines.checks import check_learns, check_reload, check_resume
from tests.baselines.runs import NEUS, OCCUPANCY, TENSOR4D, baseline_config
from tests.synthetic import ball_views
from xplanes.checks import parse
from xplanes.config import ConfigError
from xplanes.pipeline import run
from xplanes.training.assembly.site import Site, scene_cube
from xplanes.training.assembly.tensor4d import tensor4d_method
from xplanes.training.sampling.base import Moment


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return tmp_path_factory.mktemp("scenes")


def test_surface_run_goes_on(scenes, tmp_path, monkeypatch):
    """When it stops the fine level has joined, and planes are still averaged down."""
    short = ("trainer.max_steps=28", "trainer.evaluate_at=[]", "data.eval_views=1")
    config = baseline_config(scenes, "model=tensor4d", *TENSOR4D, *NEUS, *short)
    run(config, tmp_path / "whole", [], resume=False)
    check_resume(config, tmp_path / "whole", tmp_path / "broken", monkeypatch, stop=23)


def test_surface_run_learns_and_is_loaded(scenes, tmp_path):
    config = baseline_config(scenes, "model=tensor4d", *TENSOR4D, *NEUS, "trainer.max_steps=100")
    trained = check_reload(check_learns(config, tmp_path / "whole", gain=1.5))
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
        "trainer.max_steps=100",
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


@pytest.mark.parametrize("sampler", ["occupancy", "proposal", "fixed_step"])
def test_a_surface_needs_its_own_sampler(scenes, sampler):
    with pytest.raises(ConfigError, match=f"sampler={sampler} with model=tensor4d: .* neus"):
        parse(baseline_config(scenes, "model=tensor4d", f"sampler={sampler}"))


def test_triplanes_are_refused(scenes):
    with pytest.raises(ConfigError, match="lrm=file with model=tensor4d"):
        parse(baseline_config(scenes, "model=tensor4d", "lrm=file"))


def test_a_loss_that_lacks_terms_is_refused(scenes):
    with pytest.raises(ConfigError, match=r"loss\.eikonal .* set loss=tensor4d"):
        parse(baseline_config(scenes, "model=tensor4d", "loss=tensor4d_density"))
