"""Short pretraining runs: losses fall, and resumed runs equal uninterrupted ones."""

import copy
import json
import os
import shutil
import signal

import pytest
import torch

from tests.synthetic.pretraining.small import OVERRIDES, same, small_config, small_pool, small_sizes
from xplanes.cli import main
from xplanes.errors import ConfigError
from xplanes.locks import alone_in
from xplanes.lrm import load
from xplanes.synthetic.pretraining import pool as pool_module
from xplanes.synthetic.pretraining.initialisation import init_model
from xplanes.synthetic.pretraining.module import PATIENCE, PretrainingModule, Upkeep
from xplanes.synthetic.pretraining.pool import PretrainingBatches
from xplanes.synthetic.pretraining.run import CHECKPOINT


@pytest.fixture(scope="module", autouse=True)
def short_shards():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool_module, "SHARD", 8)
        patch.setattr("xplanes.synthetic.pretraining.run.SHARD", 8)
        yield


@pytest.fixture(scope="module")
def pool_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("pool")


def command(run, pool, *overrides):
    paths = [f"run={run}", f"pool.root={pool}", "pool.objects=8"]
    return main(["pretrain-lrm", *OVERRIDES, *paths, *overrides])


def state(run):
    return torch.load(run / CHECKPOINT, weights_only=True)


def test_a_resumed_training_equals_an_uninterrupted_one(tmp_path, pool_folder, monkeypatch, capsys):
    steps = "schedule.max_steps=6"
    assert command(tmp_path / "whole", pool_folder, steps) == 0
    real = Upkeep.on_train_batch_end

    def stops(self, trainer, module, *others):
        real(self, trainer, module, *others)
        if module.steps == 4:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Upkeep, "on_train_batch_end", stops)
    assert command(tmp_path / "cut", pool_folder, steps) == 130
    monkeypatch.setattr(Upkeep, "on_train_batch_end", real)
    assert state(tmp_path / "cut")["progress"]["steps"] == 4
    assert command(tmp_path / "cut", pool_folder, steps) == 0
    assert "resuming" in capsys.readouterr().out
    whole, cut = state(tmp_path / "whole"), state(tmp_path / "cut")
    assert whole["progress"]["steps"] == cut["progress"]["steps"] == 6
    assert same(whole["state_dict"], cut["state_dict"])
    weights = tmp_path / "cut" / "tiny.safetensors"
    assert weights.read_bytes() == (tmp_path / "whole" / "tiny.safetensors").read_bytes()
    assert load(json.loads(weights.with_suffix(".json").read_text()), weights).image_size == 24
    assert list((tmp_path / "cut" / "tb").glob("events*"))


@pytest.fixture(scope="module")
def finished(tmp_path_factory, pool_folder, short_shards):
    """The folder of a pretraining of one step."""
    folder = tmp_path_factory.mktemp("finished")
    assert command(folder, pool_folder, "schedule.max_steps=1") == 0
    return folder


def test_finer_planes_alone_are_initialised_from_a_finished_run(
    finished, tmp_path, pool_folder, capsys
):
    """Neither are other models, nor is another one resumed in the same folder."""
    coarse = ("schedule.max_steps=1", f"init_from={finished}/tiny.safetensors")
    assert command(tmp_path / "fine", pool_folder, *coarse, "model.low_resolution=8") == 0
    for run, words, overrides in (
        (tmp_path / "wrong", "init_from=", (*coarse, "model.low_resolution=8", "model.width=24")),
        (tmp_path / "other", "init_from=", (*coarse, "model.distance=5")),
        (finished, f"run={finished}", ("schedule.max_steps=1", "model.width=24")),
    ):
        assert command(run, pool_folder, *overrides) == 1
        assert words in capsys.readouterr().err


def test_a_damaged_or_used_run_is_said_in_words(finished, tmp_path, pool_folder, capsys):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    steps = "schedule.max_steps=2"
    with alone_in(run):
        assert command(run, pool_folder, steps) == 1
    assert "in use" in capsys.readouterr().err
    for name, words in (
        (CHECKPOINT, "last.ckpt is damaged: delete it"),
        ("config.json", "config.json is damaged"),
    ):
        whole = (run / name).read_bytes()
        (run / name).write_bytes(whole[: len(whole) // 2])
        assert command(run, pool_folder, steps) == 1
        assert words in capsys.readouterr().err
        (run / name).write_bytes(whole)
    assert command(run, pool_folder, steps) == 0


def test_a_score_that_fails_loses_no_step(tmp_path, pool_folder, monkeypatch):
    def fail(*_):
        raise RuntimeError("no score")

    monkeypatch.setattr("xplanes.synthetic.pretraining.quick.QuickLook.scores", fail)
    with pytest.raises(RuntimeError, match="no score"):
        command(tmp_path, pool_folder, "schedule.max_steps=3")
    assert state(tmp_path)["progress"]["steps"] == 3


def module(*overrides):
    """The settings, and a module that learns without a trainer."""
    config = small_config("schedule.max_steps=40", "schedule.render_from=0", *overrides)
    model = init_model(small_sizes(), 0)
    taught = PretrainingModule(model, config.batch, config.schedule, 0, bf16=False)
    optimizers = taught.configure_optimizers()
    taught.optimizers = lambda: optimizers
    taught.manual_backward = lambda loss: loss.backward()
    return config, taught


def test_losses_fall():
    config, taught = module("schedule.muon_lr=0.02", "schedule.adam_lr=0.01")
    data = PretrainingBatches(small_pool(3), taught.model.view, config.batch, seed=0)
    loss, parts = taught.losses(data.draw(0))
    first, options = float(loss.detach()), config.schedule
    parts = {name: float(value) for name, value in parts.items()}
    rendered = parts["render"] + 0.3 * parts["opacity"]
    total = parts["occupancy"] + options.colour_weight * parts["colour"]
    assert first == pytest.approx(total + options.render_weight * rendered, rel=1e-5)
    start = copy.deepcopy(taught.model.state_dict())
    for step in range(20):
        taught.training_step(data.draw(step), step)
    assert taught.steps == 20
    assert float(taught.losses(data.draw(0))[0].detach()) < 0.6 * first
    assert {"occupancy", "colour", "render", "opacity"} <= set(taught.last)
    average = taught.average.state_dict()
    for name, value in taught.model.named_parameters():
        assert not torch.equal(value, start[name]), name
        assert not torch.equal(value, average[name]), name


def test_every_parameter_has_one_optimizer_and_rates_rise_stay_and_fall():
    _, taught = module("schedule.warmup_steps=4", "schedule.decay_share=0.5")
    listed = [p for o in taught.configure_optimizers() for g in o.param_groups for p in g["params"]]
    assert len(listed) == len(set(map(id, listed))) == len(list(taught.model.parameters()))
    expected = {0: 0.25, 3: 1, 10: 1, 20: 1, 30: 0.5, 40: 0}
    for taught.steps, rate in expected.items():
        assert taught.rate == rate


@pytest.mark.parametrize("kind", ["loss", "gradient"])
def test_what_is_not_finite_changes_no_weight_and_ends_training_with_a_message(monkeypatch, kind):
    _, taught = module()
    first = next(taught.model.parameters())
    start = first.detach().clone()

    def broken(_batch):
        none = (first - first).sum()
        return (none * torch.nan if kind == "loss" else none.sqrt()), {}

    monkeypatch.setattr(taught, "losses", broken)
    for step in range(PATIENCE - 1):
        taught.training_step(None, step)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"schedule\.muon_lr"):
        taught.training_step(None, PATIENCE)  # type: ignore[arg-type]
    assert taught.steps == 0
    assert torch.equal(first, start)
