"""What the choice of a baseline brings along, and who has the last word."""

import functools
import itertools

import pytest
import yaml

from tests.baselines.runs import under
from tests.test_sweeps import jobs_of
from tests.training.runs import changed
from xplanes.config import CONF
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.tools.sweep import RunRow, flatten
from xplanes.tools.tabulate import differing

PUBLISHED = {
    "kplanes": ("proposal", 4096, 30000),
    "kplanes_explicit": ("proposal", 4096, 30000),
    "tineuvox_s": ("fixed_step", 4096, 20000),
    "tineuvox_b": ("fixed_step", 4096, 20000),
    "tensor4d": ("neus", 512, 200000),
}


SETTINGS = yaml.safe_load("""
kplanes:
  model: {half_side: 1.3, resolution: 64, scales: [1, 2, 4, 8], time_resolution: null, channels: 32,
    space_low: 0.1, space_high: 0.5, width: 64, learning_rate: 0.01, warmup_steps: 512}
  rays: {background: one}
  loss: {variation: coded, total_variation: 0.0001, time_smoothness: 0.01, time_identity: 0.0001}
  sampler: {near: 2, far: 6, proposal_samples: [256, 128], samples: 48, resolutions: [64, 128],
    time_resolution: 50, channels: 8, width: 64, linear: false, space_low: 0.1, space_high: 0.15,
    padding: 0.01, anneal_steps: 1000, anneal_slope: 10, update_every: 5, update_warmup: 5000,
    histogram: 1, variation: coded, total_variation: 0.0001, time_smoothness: 0.001,
    time_identity: 0.0001, learning_rate: 0.01}
kplanes_explicit:
  model: {width: 128}
  sampler: {linear: true}
tineuvox_s:
  model: {near: 2, far: 6, margin: 1.05, resolution: 100, channels: 4, width: 64,
    alpha_start: 0.01, point_octaves: 10, time_octaves: 8, direction_octaves: 4,
    feature_octaves: 2, grow_at: [2000, 4000, 6000], grid_learning_rate: 0.08,
    deformation_learning_rate: 0.0006, network_learning_rate: 0.0008, decay_steps: 20000}
  rays: {background: white}
  loss: {entropy: 0.001, sample_colour: 0.01}
  sampler: {near: 2, far: 6, step: 0.5, threshold: 0.0001}
tineuvox_b:
  model: {resolution: 160, channels: 6, width: 256, alpha_start: 0.001}
tensor4d:
  model: {resolution: 128, fine_resolution: 512, time_resolution: 128, channels: 32,
    fine_channels: 16, width: 256, point_octaves: 8, time_octaves: 6, direction_octaves: 3,
    fine_from: 5000, blur_until: 7500, blur_resolution: 64, learning_rate: 0.0005,
    plane_learning_rate: 0.0025, warmup_steps: 2000, final_rate: 0.1, radius: 0.5, sharpness: 0.3}
  loss: {masked: true, eikonal: 0.2, opacity: 0.3, smoothness: 0.01, smoothness_distance: 0.001}
  sampler: {samples: 64, more_samples: 65, coarse_sharpness: 64}
""")
"""Settings of the released code."""


OURS = (
    *under("model.rays", per_batch="auto", samples_per_batch="auto", error_share=0.5),
    *under("model.rays", background="white", background_share=0.4, background_jitter=0.1),
    *under("model.rays", skip_background="true", match_exposure="true"),
)
"""The rays of X-Planes, for models that bring others."""


composed = functools.partial(changed, ())


def test_a_baseline_brings_its_published_steps():
    for model, experiment in itertools.product(PUBLISHED, ([], ["experiment=published"])):
        case = model, *experiment
        config = Experiment.read(composed(f"model={model}", *experiment))
        sampler, rays, steps = PUBLISHED[model]
        found = config.method.model
        assert (found.sampler.name, found.rays.per_batch) == (sampler, rays), case
        assert config.method.lrm.name == "none", case
        assert not found.rays.skip_background, case
        assert (config.trainer["max_seconds"] is None) == bool(experiment), case
        if experiment:
            assert config.trainer["max_steps"] == steps, case
            longer = composed(f"model={model}", *experiment, "trainer.max_steps=7")
            assert longer["trainer"]["max_steps"] == 7, case


def test_a_model_brings_its_initialisation_and_changes_no_other_group():
    for path in sorted((CONF / "model").glob("*.yaml")):
        chosen = [node for node in yaml.safe_load(path.read_text())["defaults"] if node != "_self_"]
        groups = {name for node in chosen if isinstance(node, dict) for name in node}
        assert groups <= {"sampler", "override sampler", "/lrm@_global_.lrm"}, path.name
        own = "auto" if path.stem in ("six_planes", "nine_planes") else "none"
        assert composed(f"model={path.stem}")["lrm"]["name"] == own, path.name
    for model in ("nine_planes", "kplanes"):
        assert composed("lrm=mini", f"model={model}")["lrm"]["name"] == "mini", model
    with pytest.raises(ConfigError, match=r"^lrm=tiny with model=kplanes: .* set lrm=none"):
        Experiment.read(composed("model=kplanes", "lrm=tiny"))
    lacking = {name: node for name, node in composed().items() if name != "lrm"}
    with pytest.raises(ConfigError, match=r"^lrm: model=six_planes chooses none; add `- /lrm"):
        Experiment.read(lacking)


def test_a_baseline_has_its_published_settings():
    for model, groups in SETTINGS.items():
        config = composed(f"model={model}")["model"]
        for group, settings in groups.items():
            part = config if group == "model" else config[group]
            found = {key: part[key] for key in settings}
            assert found == settings, (model, group)


def test_a_baseline_can_be_trained_on_the_rays_of_others():
    """Given overrides win over what the baseline brings."""
    ours, plain = composed(), composed("model=kplanes", *OURS)
    assert plain["trainer"] == ours["trainer"]
    assert plain["data"] == ours["data"]
    assert plain["model"]["rays"] == ours["model"]["rays"]


def row(config, *overridden):
    return RunRow("run", flatten(config), frozenset(overridden))


def test_tables_leave_out_what_follows_from_the_model_and_the_sampler():
    samplers = ([], ["model/sampler=occupancy"])
    rows = [row(composed("model=kplanes", *choice)) for choice in samplers]
    assert set(differing(rows)) == {"model.sampler.name"}
    models = ("six_planes", "kplanes", "tineuvox_s")
    names = {"model.sampler.name", "model.name"}
    rows = [row(composed("lrm=none", f"model={model}")) for model in models]
    assert set(differing(rows)) == names
    typed = "model.rays.background"
    rows[1] = row(composed("model=kplanes", "model.rays.background=white"), typed)
    assert set(differing(rows)) == names
    rows[2] = row(composed("model=tineuvox_s", "model.rays.background=random"), typed)
    assert set(differing(rows)) == {*names, typed}


@pytest.mark.parametrize(("sweep", "steps"), [("fair", 30000), ("lego_models", 1000000)])
def test_comparisons_give_all_models_the_same(sweep, steps):
    plains = [composed(*job) for job in jobs_of(f"sweep={sweep}", "data.scene=lego")]
    assert {plain["trainer"]["max_steps"] for plain in plains} == {steps}
    found = {(plain["trainer"]["max_seconds"], plain["data"]["resolution"]) for plain in plains}
    assert len(found) == 1


def test_the_papers_first_table_has_the_published_steps():
    for job in jobs_of("sweep=table1", "data.scene=lego"):
        plain = composed(*job)
        name = plain["model"]["name"]
        steps = PUBLISHED.get(name, (None, None, 30000))[2]
        steps = 23000 if name == "gaussians_hexplane_published" else steps
        trainer = plain["trainer"]
        assert (trainer["max_seconds"], trainer["max_steps"]) == (None, steps), job
        spacetime = name == "gaussians_spacetime_published"
        assert trainer["accumulate_grad_batches"] == (2 if spacetime else 1), job
