"""What the choice of a baseline brings along, and who has the last word."""

import pytest
from hydra import compose, initialize_config_dir

from xplanes.checks import parse
from xplanes.config import CONF, register_schemas, to_plain
from xplanes.evaluation.sweep import RunRow
from xplanes.evaluation.tabulate import differing

PUBLISHED = {
    "kplanes": ("proposal", 4096, 30000),
    "kplanes_explicit": ("proposal", 4096, 30000),
    "tineuvox_s": ("fixed_step", 4096, 20000),
    "tineuvox_b": ("fixed_step", 4096, 20000),
    "tensor4d": ("neus", 512, 200000),
}


def composed(*overrides):
    register_schemas()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return to_plain(compose("train", list(overrides)))


@pytest.mark.parametrize("model", PUBLISHED)
@pytest.mark.parametrize("experiment", [[], ["experiment=published"]])
def test_a_baseline_brings_its_published_steps(model, experiment):
    config = parse(composed(f"model={model}", *experiment))
    sampler, rays, steps = PUBLISHED[model]
    assert config.sampler.name == sampler
    assert config.trainer.rays_per_batch == rays
    assert config.trainer.max_steps == steps
    assert config.lrm.name == "none"
    assert not config.data.skip_background
    assert (config.trainer.max_seconds is None) == bool(experiment)


def test_without_its_recipe_a_baseline_trains_on_the_rays_of_others():
    ours, plain = composed(), composed("model=kplanes", "recipe=none")
    assert plain["trainer"] == ours["trainer"]
    assert plain["data"] == ours["data"]
    assert plain["loss"]["background"] == "white"


def test_the_command_line_has_the_last_word():
    config = composed("model=kplanes", "trainer.rays_per_batch=7", "loss.background=white")
    assert config["trainer"]["rays_per_batch"] == 7
    assert config["loss"]["background"] == "white"


def test_no_recipe_is_left_in_the_configuration():
    assert "recipe" not in composed("model=kplanes")


def row(config, *overridden):
    settings = {
        f"{group}.{key}": value
        for group, keys in config.items()
        if isinstance(keys, dict)
        for key, value in keys.items()
    }
    return RunRow("run", settings, frozenset(overridden))


def test_tables_leave_out_what_follows_from_the_model():
    models = ("six_planes", "kplanes", "tineuvox_s")
    rows = [row(composed("lrm=none", f"model={model}")) for model in models]
    assert set(differing(rows)) == {"sampler.name", "model.name"}
    typed = "loss.background"
    rows[1] = row(composed("model=kplanes", "loss.background=white"), typed)
    assert set(differing(rows)) == {"sampler.name", "model.name"}
    rows[2] = row(composed("model=tineuvox_s", "loss.background=random"), typed)
    assert set(differing(rows)) == {"sampler.name", "model.name", typed}
