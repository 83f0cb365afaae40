"""What the choice of a baseline brings along, and who has the last word."""

import pytest
import yaml
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


ENTRIES = sorted(path.stem for path in (CONF / "entry").glob("*.yaml"))


@pytest.mark.parametrize("entry", ENTRIES)
def test_entries_of_comparisons_are_what_they_are_called(entry):
    config = parse(composed(f"entry={entry}"))
    start = "none" if config.lrm.name == "none" else config.lrm.name
    extra = "_occupancy" if entry.endswith("_occupancy") else ""
    planes = f"_{start}" if config.model.name in ("six_planes", "nine_planes") else ""
    assert entry == f"{config.model.name}{extra}{planes}"
    assert (config.sampler.name == "occupancy") >= bool(extra)


@pytest.mark.parametrize("name", ["table1", "lego_models"])
def test_comparisons_give_all_models_the_same(name):
    text = yaml.safe_load((CONF / "experiment" / f"{name}.yaml").read_text())
    entries = text["hydra"]["sweeper"]["params"]["entry"].split(",")
    assert set(entries) <= set(ENTRIES)
    lines = [f"experiment={name}", "data.scene=lego"]
    found = [parse(composed(*lines, f"entry={entry}")) for entry in entries]
    assert {c.trainer.max_seconds for c in found} == {text["trainer"]["max_seconds"]}
    assert {c.trainer.max_steps for c in found} == {text["trainer"]["max_steps"]}
    assert {(c.data.resolution, c.data.eval_split) for c in found} == {
        (text["data"]["resolution"], text["data"]["eval_split"])
    }
