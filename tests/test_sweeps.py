"""Sweeps, the paper's tables and figures among them: what they consist of, and their jobs."""

import functools
import itertools
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec

import pytest
import torch
import yaml
from hydra import initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from hydra_plugins.xplanes import ALIASES
from tests.balls import ball_scene
from tests.inside import train
from tests.test_contracts import built, small
from tests.test_train_command import with_hydra
from tests.training.runs import SMALL as SMALL_RUN
from tests.training.runs import changed
from xplanes.config import CONF, compose_plain, group_options
from xplanes.errors import ConfigError, LRMError
from xplanes.experiment import Experiment
from xplanes.files import read_json
from xplanes.launch import FORMER, prepare
from xplanes.sweeps import SMALL, jobs, look_ahead
from xplanes.tools.published import check_published, read_published
from xplanes.tools.sheet import check_what
from xplanes.training.building import loss_terms

PAPER = {
    "table1": (8, 7),
    "tables2_3": (8, 8),
    "table4": (8, 8),
    "few_shot": (8, 9),
    "figure6": (1, 4),
    "rank": (8, 4),
    "fair": (8, 7),
    "ablation": (4, 30),
}
"""Scenes, and runs of each."""

SWEEPS = sorted(path.stem for path in (CONF / "sweep").glob("*.yaml"))


@functools.cache
def multirun(*overrides: str) -> DictConfig:
    """The configuration of a multirun."""
    config = with_hydra(*(text for text in overrides if "," not in text))
    OmegaConf.update(config, "hydra.overrides.task", list(overrides))
    return config


def jobs_of(*overrides: str) -> list[list[str]]:
    return jobs(OmegaConf.to_container(multirun(*overrides).hydra, resolve=False))


def values_of(found: list[list[str]], key: str) -> list[str]:
    """Different values of a setting in jobs."""
    texts = itertools.chain(*found)
    return list(dict.fromkeys(t.partition("=")[2] for t in texts if t.startswith(f"{key}=")))


@pytest.mark.slow
def test_sweeps_have_the_papers_scenes_and_rows():
    for name, (scenes, runs) in PAPER.items():
        found = jobs_of(f"sweep={name}")
        assert len(values_of(found, "data.scene")) == scenes, name
        assert len({tuple(job) for job in found}) == len(found) == scenes * runs, name
        if name != "ablation":
            plain = changed((), *found[0])
            assert (plain["data"]["name"], plain["data"]["resolution"]) == ("dnerf", 400), name
            assert plain["data"]["eval_split"] is None, name
            assert plain["trainer"]["max_seconds"] is None, name
    tables = {"table1": ["Table 1"], "tables2_3": ["Table 2", "Table 3"], "table4": ["Table 4"]}
    for name, published in (tables | {"rank": ["Rank"]}).items():
        assert multirun(f"sweep={name}").hydra.callbacks.table.published == published, name


def test_published_resolutions_and_lrms_are_those_that_are_swept():
    swept = ("tables2_3", "Table 3", "lrm"), ("table4", "Table 4", "model.resolution")
    for name, table, key in swept:
        found = jobs_of(f"sweep={name}")
        entries = [entry for entry in read_published() if entry["table"] == table]
        for setting in (key, "model"):
            shown = {entry[setting.split(".")[-1]] for entry in entries}
            assert shown == set(values_of(found, setting)), (name, setting)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(), (SMALL,)], ids=str)
def test_every_sweep_has_its_tables_and_few_steps_on_small_scenes(size):
    for name in PAPER if size else SWEEPS:
        config = multirun(f"sweep={name}", *size)
        found = jobs_of(f"sweep={name}", *size)
        check_published(list(config.hydra.callbacks.table.published))
        check_what(config.hydra.callbacks.table.sheet)
        assert "params" in config.hydra.sweeper, name
        if size:
            assert (config.data.name, config.data.resolution) == ("demo", 64), name
            steps = values_of(found, "trainer.max_steps") or [config.trainer.max_steps]
            assert int(steps[0]) * len(found) <= 9000, name


def test_a_sweep_is_narrowed_down_on_the_command_line():
    found = jobs_of("sweep=table1", "model=kplanes,six_planes", "data.scene=lego")
    assert found == [
        ["data.scene=lego", "sweep=table1", "model=kplanes"],
        ["data.scene=lego", "sweep=table1", "model=six_planes", "recipe=paper"],
    ]
    # What only some rows set is the others' alone.
    found = jobs_of("sweep=ablation", "lrm=mini", "seed=3", "data.scene=balls")
    assert len(found) == 10
    assert sorted(values_of(found, "lrm")) == ["mini", "none"]
    assert jobs_of("sweep=table1", "model=tineuvox_s") == []
    # Without rows the grid is Hydra's own.
    assert jobs_of("model=a,b", "seed=0,1") == [
        [f"model={model}", f"seed={seed}"] for model in "ab" for seed in (0, 1)
    ]


def cases() -> Iterator[tuple[str, ...]]:
    """Jobs of all sweeps that differ in more than numbers and scenes, and kinds that have none."""
    yield from (("model=nine_planes", "model/sampler=proposal"), ("model=gaussians_deform",))
    for name, size in itertools.product(SWEEPS, ((), (SMALL,))):
        if size and name not in PAPER:
            continue
        left_out = ("seed", "data.scene", "data.views", "model.resolution")
        different = {
            tuple(text for text in job if text.partition("=")[0] not in left_out)
            for job in jobs_of(f"sweep={name}", *size)
        }
        yield from sorted(different)


@pytest.mark.slow
def test_all_jobs_build_and_do_a_step():
    found = list(cases())
    assert len(found) > 60
    scene = ball_scene()
    for overrides in found:
        experiment = Experiment.read(small(*overrides))
        module, batches = built(experiment.config, scene)
        rays, state = batches.draw(0), module.state
        rendering = module.sampler.render(module.field, rays, state)
        assert rendering.colour.shape == rays["target"].shape, overrides
        assert len(rendering.colour) == (module.ray_settings.most_rays or 16 * 16), overrides
        assert rendering.colour.isfinite().all(), overrides
        loss = sum(loss_terms(module.parts, module.method.losses, rendering, rays, state).values())
        assert torch.isfinite(loss), overrides
        loss.backward()
        module.model.regularise(state)
        gradients = [p.grad for p in module.field.parameters() if p.grad is not None]
        assert any(bool(gradient.any()) for gradient in gradients), overrides


def test_fair_means_equal_rays_samples_and_terms():
    rays, samplers, losses = set(), set(), set()
    for overrides in jobs_of("sweep=fair", "data.scene=lego"):
        plain = changed((), *overrides)
        experiment = Experiment.read(plain)
        model = experiment.method.model
        rays.add(str(model.rays))
        samplers.add(str(model.sampler))
        weights = plain["model"].get("loss", {})
        losses.add((weights.get("opacity", 0.0), weights.get("floaters", 0.0)))
        assert experiment.method.losses == {}
    assert len(rays) == len(samplers) == 1
    assert losses == {(0.0, 0.0)}


@pytest.mark.parametrize(
    "chosen", [pytest.param(["recipe=paper", "lrm=tiny"], marks=pytest.mark.slow), []]
)
def test_the_ablation_changes_one_thing_at_a_time(chosen):
    whole = changed((), *chosen)
    for overrides in jobs_of("sweep=ablation", "data.scene=excavator", "seed=0", *chosen):
        plain = changed((), *overrides)
        others = {group for group in whole if plain[group] != whole[group]}
        random = "lrm=none" in overrides
        assert ("lrm" in others) == random, overrides
        assert plain["lrm"]["name"] == ("none" if random else whole["lrm"]["name"])
        assert len(others - {"lrm"}) <= 1, overrides


def test_published_lrms_have_their_own_names_beside_the_papers():
    assert set(ALIASES) <= set(group_options("lrm"))
    for alias, name in ALIASES.items():
        plain = changed((), f"lrm={alias}")["lrm"]
        assert plain == changed((), f"lrm={name}")["lrm"]
        assert plain["architecture"].startswith(alias.replace("_", "-"))


def test_one_gpu_has_no_limit_of_time():
    trainer = compose_plain("train", ["trainer=gpu"])["trainer"]
    assert (trainer["max_seconds"], trainer["max_steps"]) == (None, 30000)


# Before the first job


def looked_ahead(*overrides: str) -> str:
    """What is said of a sweep before its first job."""
    config = multirun(*overrides)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return look_ahead(config)


def test_a_sweep_is_run_with_the_flag(tmp_path):
    done = train("sweep=table1", "model=kplanes", cwd=tmp_path, code=1)
    assert done.stderr.startswith("error: a sweep has many runs: ")
    assert done.stderr.endswith(" -m sweep=table1 model=kplanes\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("sweep=table1,fair", r"one sweep at a time.* -m sweep=table1; .*sweep=fair"),
        ("sweep=table1 model=tineuvox_s", r"no row .* model=nine_planes recipe=paper"),
        (f"sweep=suite {SMALL}", "sweep=suite has no small version"),
    ],
)
def test_a_sweep_that_cannot_be_is_refused(given, words):
    with pytest.raises(ConfigError, match=words):
        looked_ahead(*given.split())


def test_a_sweep_looks_for_its_data_and_weights_first(tmp_path):
    place = f"hydra.sweep.dir={tmp_path / 'sweep'}"
    few = ("lrm=small", "data.scene=bouncingballs,hook")
    done = train("-m", "sweep=rank", *few, place, cwd=tmp_path, code=1)
    assert "bouncingballs does not exist" in done.stderr
    assert "xplanes download dnerf" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())
    (tmp_path / "lego").mkdir()
    given = ("data.scene=lego", f"data.root={tmp_path}", "lrm=small")
    with pytest.raises(LRMError, match=r"none\.safetensors is not a file"):
        looked_ahead("sweep=rank", *given, f"lrm.weights={tmp_path / 'none.safetensors'}")


def test_how_long_a_sweep_takes_is_said():
    assert looked_ahead("sweep=suite", "data.scene=dark,rig").startswith("2 runs, at most 2 min")
    assert looked_ahead("seed=0,1", "trainer.max_seconds=null").startswith("2 runs, 60000 steps")
    # Jobs refuse their own settings, and Hydra says what it cannot compose.
    assert looked_ahead("seed=0,1", "model.channels=0").startswith("2 runs, ")
    assert looked_ahead("model=six_planes,nothing") == ""


@pytest.mark.parametrize(
    ("former", "now"),
    [
        ("experiment=table1", "-m sweep=table1"),
        ("experiment=table3 scale=demo seed=1", "-m sweep=tables2_3 experiment=demo seed=1"),
        ("-m experiment=figures5_7_9_10", "-m sweep=table1"),
        ("scale=demo", "experiment=demo"),
    ],
)
def test_former_names_are_answered_with_those_of_today(former, now):
    with pytest.raises(ConfigError, match="that is now") as caught:
        prepare(former.split())
    (line,) = str(caught.value).splitlines()[1:]
    assert line.split(" train ")[-1].split("train.py ")[-1] == now
    assert jobs_of(*(text for text in now.split() if text != "-m"))
    assert prepare(now.split()) == now.split()


@pytest.mark.parametrize("name", FORMER)
def test_what_former_sweeps_are_now_exists(name):
    assert jobs_of(*shlex.split(FORMER[name]))
    assert name not in SWEEPS


def test_a_run_that_began_with_former_names_says_so(tmp_path):
    (tmp_path / "overrides.txt").write_text("scale=demo\nseed=1\n")
    with pytest.raises(ConfigError, match="settings of an earlier version") as caught:
        prepare([f"resume={tmp_path}"])
    assert str(caught.value).endswith("experiment=demo seed=1")


@pytest.mark.slow
def test_a_sweep_says_how_long_it_takes_and_its_jobs_go_on(scenes, tmp_path):
    own = tmp_path / "conf" / "sweep"
    own.mkdir(parents=True)
    sweep = {
        "defaults": [{"override /experiment": "demo"}],
        "hydra": {
            "callbacks": {"table": {"sheet": "runs"}},
            "sweeper": {"params": {"seed": "3"}, "rows": ["lrm=none", "model.resolution=12"]},
        },
    }
    text = "# @package _global_\n" + yaml.safe_dump(sweep, sort_keys=False)
    (own / "mine.yaml").write_text(text)
    tiny = (
        *("data.resolution=32", "data.train_views=10", "data.test_views=3", "data.val_views=2"),
        *("model.rays.per_batch=64", "model.rays.samples_per_batch=1024", "lrm=none"),
        *("model.sampler.grid_resolution=12", "model.sampler.samples=32", "media=false"),
        *("logger=none", f"data.root={scenes}"),
    )
    place, conf = tmp_path / "sweep", f"hydra.searchpath=[file://{tmp_path / 'conf'}]"
    given = ("-m", "sweep=mine", conf, *tiny, f"hydra.sweep.dir={place}")
    first = train(*given, "trainer.max_steps=2", cwd=tmp_path)
    assert first.stdout.startswith("2 runs, 4 steps in all")
    runs = sorted(place.glob("*/metrics.json"))
    assert len(runs) == 2
    assert (place / "table.md").is_file()
    assert (place / "sheet.png").is_file()
    train(*given, "trainer.max_steps=3", "resume=auto", cwd=tmp_path)
    train(f"resume={runs[0].parent}", "trainer.max_steps=4", cwd=tmp_path)
    steps = [yaml.safe_load(path.read_text())["step"] for path in runs]
    assert steps == [4, 3]


@pytest.mark.slow
@pytest.mark.skipif(
    not find_spec("submitit") or not find_spec("hydra_plugins.hydra_submitit_launcher"),
    reason="jobs of a cluster need the extra sweep",
)
def test_a_job_of_a_cluster_that_was_killed_goes_on(tmp_path):
    folder, root = tmp_path / "sweep", f"data.root={tmp_path / 'scenes'}"
    launcher = ["hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=1"]
    words = ["-m", *launcher, f"hydra.sweep.dir={folder}", "resume=auto", root]
    words += [*SMALL_RUN, "seed=0,1,2,3", "callbacks.checkpoints.every=5", "trainer.max_steps=150"]
    command = [sys.executable, str(CONF.parent / "train.py"), *words]
    silent: dict = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
    process = subprocess.Popen(command, **silent)
    try:
        killed = "2_*_s2/checkpoints/last.ckpt"
        while not (found := list(folder.glob(killed))) and process.poll() is None:
            time.sleep(0.05)
        run = found[0].parent.parent
        os.kill(read_json(run / "run.json")["process"], signal.SIGKILL)
        assert process.wait(240) != 0
    finally:
        process.kill()
    others = [folder / f"{n}_excavator_six_planes_none_s{n}" for n in (0, 1, 3)]
    assert not (run / "metrics.json").exists()
    assert all((other / "metrics.json").is_file() for other in others)
    kept = [read_json(other / "metrics.json")["test"] for other in others]
    subprocess.run(command, check=True, timeout=240, **silent)
    assert read_json(run / "run.json")["resumed"] == 1
    assert read_json(run / "metrics.json")["step"] == 150
    assert [read_json(other / "metrics.json")["test"] for other in others] == kept
    assert len((folder / "table.csv").read_text().splitlines()) == 5
