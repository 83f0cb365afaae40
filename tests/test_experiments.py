"""The paper's tables and figures: sweeps whose jobs compose, build and do a step, in both sizes."""

import functools
import itertools
from collections.abc import Iterator

import pytest
import torch
from hydra import compose, initialize_config_dir

from tests.balls import ball_scene
from tests.test_contracts import built, small
from xplanes.config import CONF, compose_plain, group_options
from xplanes.evaluation.published import check_published, read_published
from xplanes.evaluation.sheet import check_what
from xplanes.experiment import Experiment
from xplanes.training.losses import loss_terms

PAPER = {
    "table1": (8, 7),
    "table2": (8, 8),
    "table3": (8, 8),
    "table4": (8, 8),
    "few_shot": (8, 9),
    "figure3": (2, 1),
    "figure6": (1, 4),
    "figures5_7_9_10": (8, 5),
    "rank": (8, 4),
    "fair": (8, 7),
    "ablation": (4, 30),
}
"""Scenes, and runs of each."""

DEMO = sorted(path.stem.removeprefix("demo_") for path in (CONF / "scale/experiment").glob("*"))


@functools.cache
def sweep(*overrides: str) -> tuple[dict[str, list[str]], dict]:
    """What an experiment goes through, and its settings."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("train", list(overrides), return_hydra_config=True)
    params = config.hydra.sweeper.params or {}
    assert str(config.hydra.mode) == "RunMode.MULTIRUN"
    return {key: str(values).split(",") for key, values in params.items()}, config


def test_sweeps_have_the_papers_scenes_and_rows() -> None:
    for name, (scenes, runs) in PAPER.items():
        params, config = sweep(f"experiment={name}")
        assert len(params["data.scene"]) == scenes, name
        assert len(list(itertools.product(*params.values()))) == scenes * runs, name
        if name != "ablation":
            assert config.data.name == "dnerf", name
            assert config.data.resolution == 400, name
            assert config.data.eval_split is None, name
            assert config.trainer.max_seconds is None, name
    assert set(DEMO) == set(PAPER)
    tables = {name: f"Table {name[-1]}" for name in PAPER if name.startswith("table")}
    for name, table in (tables | {"rank": "Rank"}).items():
        assert sweep(f"experiment={name}")[1].published == [table], name


def test_published_resolutions_and_lrms_are_those_that_are_swept() -> None:
    for name, key in (("table3", "lrm"), ("table4", "model.resolution")):
        column = key.split(".")[-1]
        params, _ = sweep(f"experiment={name}")
        entries = [e for e in read_published() if e["table"] == f"Table {name[-1]}"]
        assert {entry[column] for entry in entries} == set(params[key])
        assert {entry["model"] for entry in entries} == set(params["model"])


@pytest.mark.parametrize("scale", [None, "demo"])
def test_every_choice_of_every_sweep_exists(scale: str | None) -> None:
    options = {group: set(group_options(group)) for group in ("entry", "model", "lrm")}
    for name in PAPER if scale is None else DEMO:
        chosen = [f"experiment={name}"] + ([f"scale={scale}"] if scale else [])
        params, config = sweep(*chosen)
        for group in set(params) & set(options):
            assert set(params[group]) <= options[group], (name, group)
        check_published(list(config.published))
        check_what(config.sheet)
        if scale:
            assert (config.data.name, config.data.resolution) == ("demo", 64), name
            runs = len(list(itertools.product(*params.values())))
            assert config.trainer.max_steps * runs <= 9000, name


def jobs() -> Iterator[tuple[str, ...]]:
    """Command lines of all jobs of all sweeps that differ in more than numbers and scenes."""
    for scale, names in (((), PAPER), (("scale=demo",), DEMO)):
        for name in names:
            params, _ = sweep(f"experiment={name}", *scale)
            groups = {key: values for key, values in params.items() if "." not in key}
            groups.pop("seed", None)
            for values in itertools.product(*groups.values()):
                chosen = (f"{k}={v}" for k, v in zip(groups, values, strict=True))
                yield (f"experiment={name}", *scale, *chosen)


def test_jobs_build_and_do_a_step() -> None:
    done = list(jobs())
    assert len(done) > 60
    does_a_step(done[::9])


@pytest.mark.slow
def test_all_jobs_build_and_do_a_step() -> None:
    does_a_step(list(jobs()))


def does_a_step(cases: list[tuple[str, ...]]) -> None:
    scene = ball_scene()
    for overrides in cases:
        experiment = Experiment.read(small(*overrides))
        module, batches = built(experiment.config, scene)
        rays, state = batches.draw(0), module.state
        rendering = module.sampler.render(module.field, rays, state)
        loss = sum(loss_terms(module.parts, module.method.losses, rendering, rays, state).values())
        assert torch.isfinite(loss), overrides
        loss.backward()
        module.model.regularise(state)
        gradients = [p.grad for p in module.field.parameters() if p.grad is not None]
        assert any(bool(gradient.any()) for gradient in gradients), overrides


def test_fair_means_equal_rays_samples_and_terms() -> None:
    params, _ = sweep("experiment=fair")
    rays, samplers, losses = set(), set(), set()
    for entry in params["entry"]:
        plain = compose_plain("train", ["experiment=fair", f"entry={entry}"])
        experiment = Experiment.read(plain)
        model = experiment.method.model
        rays.add(str(model.rays))
        samplers.add(str(model.sampler))
        weights = plain["model"].get("loss", {})
        losses.add((weights.get("opacity", 0.0), weights.get("floaters", 0.0)))
        assert experiment.method.losses == {}
        assert experiment.trainer["max_steps"] == 30000
    assert len(rays) == len(samplers) == 1
    assert losses == {(0.0, 0.0)}


@pytest.mark.parametrize("chosen", [["recipe=paper", "lrm=tiny"], ["recipe=paper"], []])
def test_the_ablation_changes_one_thing_at_a_time(chosen: list[str]) -> None:
    params, _ = sweep("experiment=ablation")
    whole = compose_plain("train", chosen)
    for entry in params["entry"]:
        plain = compose_plain("train", [*chosen, f"entry={entry}"])
        changed = {group for group in whole if plain[group] != whole[group]}
        assert ("lrm" in changed) == ("random" in entry), entry
        assert plain["lrm"]["name"] == ("none" if "random" in entry else whole["lrm"]["name"])
        assert len(changed - {"lrm"}) <= 1, entry
