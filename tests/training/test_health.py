"""Numbers that are not finite reach neither parameters nor checkpoints."""

import math
import re
import shutil
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any
from unittest.mock import Mock, patch

import pytest
import torch
from torch import nn

from tests.refusals import assert_refused, flip
from tests.training.runs import (
    UNSCORED,
    after_each_batch,
    also,
    checkpoint,
    same_state,
    small_config,
    status,
)
from xplanes.errors import ConfigError
from xplanes.files import read_rows
from xplanes.models.base import LossTerm
from xplanes.models.x_planes import XPlanesModel
from xplanes.optional import MissingExtraError
from xplanes.run import run
from xplanes.training import building, module
from xplanes.training.building import loss_terms
from xplanes.training.checkpoints import find_resumable, load_checkpoint
from xplanes.training.diagnosis import (
    TrainingError,
    broken_flag,
    not_finite,
    unusable_gradients,
    usable,
)
from xplanes.training.module import RadianceModule
from xplanes.training.record import claim, keeping_settings

OFTEN = ("callbacks.checkpoints.every=5", "data.eval_views=1", *UNSCORED)
LONG = ("trainer.max_steps=40", *OFTEN)
"""More steps than may be left out in a row."""

FEW = ("trainer.max_steps=12", *OFTEN)
SCORED = (*FEW, "callbacks.evaluation.at=[0.4]")


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last], ids=str)
@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.0, True), (1e18, True), (2e19, False), (math.inf, False), (math.nan, False)],
)
def test_a_gradient_is_usable_if_adam_can_square_it(value, expected, layout):
    gradient = torch.zeros(1, 4, 3, 5).to(memory_format=layout)
    gradient[0, 2, 1, 3] = value
    assert usable(gradient) is expected
    others = [nn.Parameter(torch.zeros(7)), nn.Parameter(torch.zeros_like(gradient))]
    others[0].grad, others[1].grad = torch.ones(7), gradient
    for terms, broken in (([0.3], not expected), ([0.3, math.nan], True)):
        assert float(broken_flag(others, list(map(torch.tensor, terms)))) == broken


def test_names_are_those_of_the_broken():
    layer = nn.Linear(2, 1)
    layer.bias.grad = torch.tensor([math.inf])
    assert unusable_gradients(layer.named_parameters()) == ["bias"]
    assert not_finite(layer.named_parameters()) == []
    with torch.no_grad():
        layer.weight[0, 1] = math.nan
        layer.bias.fill_(3e38)
    assert not_finite(layer.named_parameters()) == ["weight"]


def spoil_gradient(monkeypatch: pytest.MonkeyPatch, value: float, steps: range) -> None:
    def spoil(model, state) -> None:
        if state.batch in steps:
            model.field.space.grad[0, 0, 0, 0] = value

    also(monkeypatch, XPlanesModel, "regularise", spoil)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few steps in a row that are left out end training."""
    monkeypatch.setattr(module, "PATIENCE", 3)


def refused(words: str, config: dict, folder: Path) -> str:
    """Training ends with an error that says this. Returns what it says."""
    train = partial(run, config, folder, [], resume=False)
    return assert_refused(TrainingError, words, train, folder.name)


def test_gradients_that_stay_bad_end_training_with_a_message(scenes, tmp_path, monkeypatch):
    spoil_gradient(monkeypatch, math.nan, range(8, 1000))
    words = r"20 steps.*from step 7 on.*gradient of field\.space.*resume="
    refused(words, small_config(scenes, *LONG), tmp_path)
    kept = checkpoint(tmp_path)
    # Left out, a step counts, and changes nothing.
    assert kept["global_step"] == 25
    assert {float(each["step"]) for each in kept["optimizer_states"][0]["state"].values()} == {7}


def initialised_as(known: bool, monkeypatch: pytest.MonkeyPatch, spoil: bool = False) -> None:
    """Fields that were, or were not, initialised with what shows the scene already."""
    original = building.build_parts

    def build_parts(*rest, **options) -> building.Parts:
        parts = original(*rest, **options)
        if spoil:
            with torch.no_grad():
                parts.field.decoder.layers[0].bias.fill_(math.nan)
        return replace(parts, site=replace(parts.site, initialised=known))

    monkeypatch.setattr(module, "build_parts", build_parts)


@dataclass(frozen=True, kw_only=True)
class Spoiled(LossTerm):
    """NaN from some step on."""

    first: int

    def value(self, field, rendering, rays, state) -> torch.Tensor:
        return rendering.opacity.mean() * (math.nan if state.step >= self.first else 1.0)


@dataclass(frozen=True, kw_only=True)
class Shaped(LossTerm):
    """The rays' opacity in some shape."""

    form: str

    def value(self, field, rendering, rays, state) -> Any:
        forms = {
            "rays": rendering.opacity,
            "list": [rendering.opacity],
            "one": rendering.opacity.mean()[None],
            "number": 0.5,
        }
        return forms[self.form]


def with_loss(scenes: Path, first: int) -> dict:
    term = {"_target_": f"{__name__}.Spoiled", "weight": 1.0, "first": first}
    return small_config(scenes, *LONG) | {"losses": {"mine": term}, "plugins": [__name__]}


def terms_with(name: str, form: str, own: Any = 0.0) -> dict[str, torch.Tensor]:
    """The terms of a loss: one of a model's own, and another of this name."""
    model = Mock(losses=lambda *_: {"own": own})
    parts = Mock(model=model, sampler=Mock(losses=lambda _: {}))
    rendering = Mock(opacity=torch.tensor([0.25, 0.75]), colour=torch.zeros(2, 3))
    return loss_terms(parts, {name: Shaped(weight=2.0, form=form)}, rendering, {}, Mock())


def test_a_term_of_the_loss_is_one_number_and_takes_no_other_ones_place():
    for form in ("one", "number"):
        found = terms_with("mine", form)
        assert found == {"own": 0.0, "mine": 1.0}
        assert {term.shape for term in found.values()} == {()}
    words = "returned a tensor of shape [2]; return one number, such as its mean"
    for form, own, said in (
        ("rays", 0.0, f"losses.mine: {words}"),
        ("list", 0.0, "losses.mine: returned list; "),
        ("one", torch.ones(2), f"loss term own: {words}"),
    ):
        call = partial(terms_with, "mine", form, own)
        assert_refused(TrainingError, f"^{re.escape(said)}", call, form)
    with pytest.raises(ConfigError, match=r"^losses\.own: the loss has a term of this name"):
        terms_with("own", "one")


NOT_FINITE = (
    r"the loss was nan.*from step {} on; not finite: losses\.mine; largest.*The rendering is "
)
NOT_FINITE += r"finite: correct losses\.mine or omit it{}"


@pytest.mark.parametrize(
    ("spoiled", "initialised", "first", "words"),
    [
        (
            "gradient",
            False,
            None,
            r"step 0 on.*gradient of field\.space.*check the val.*of XPlanes",
        ),
        ("gradient", False, 99, r"step 0 on.*of XPlanes and losses\.mine"),
        ("gradient", True, None, r"step 0 on.*initialisation is the cause.*lrm=none"),
        ("bias", True, None, r"initialisation is the cause.*set lrm=none"),
        ("bias", False, None, r"No step .*completed: check the values and gradients of XPlanes"),
        ("nothing", False, 0, NOT_FINITE.format(0, "$")),
        ("nothing", False, 7, NOT_FINITE.format(7, "; resume=")),
    ],
)
def test_what_is_to_blame_is_named(
    scenes, tmp_path, monkeypatch, impatient, spoiled, initialised, first, words
):
    """An initialisation, where there was one, a field, or a loss that was added from some step."""
    if spoiled == "gradient":
        spoil_gradient(monkeypatch, 1e30, range(1000))
    initialised_as(initialised, monkeypatch, spoil=spoiled == "bias")
    config = small_config(scenes, *LONG) if first is None else with_loss(scenes, first)
    assert ("initialisation" in refused(words, config, tmp_path)) == initialised


def test_a_checkpoint_never_holds_what_is_not_finite(train, tmp_path, monkeypatch):
    def spoil(_, trainer, module) -> None:
        if trainer.global_step == 10:
            with torch.no_grad():
                module.field.decoder.layers[0].bias[0] = math.inf

    after_each_batch(monkeypatch, spoil)
    with pytest.raises(TrainingError, match=r"step 10: field\.decoder\.layers\.0\.bias"):
        train(*FEW)
    assert checkpoint(tmp_path / "run")["global_step"] == 5
    monkeypatch.undo()
    assert checkpoint(train(*FEW, resume=True))["global_step"] == 12


@pytest.fixture(scope="module")
def whole(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with a best checkpoint on the way."""
    folder = tmp_path_factory.mktemp("health") / "whole"
    run(small_config(scenes, *SCORED), folder, [], resume=False)
    return folder


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    """The finished run, to be changed."""
    return Path(shutil.copytree(whole, tmp_path / "run"))


def test_a_resumed_run_takes_new_learning_rates(train, folder, monkeypatch):
    seen = []

    def note(module, *_) -> None:
        optimizer = module.optimizers().optimizer
        seen.append([group["lr"] for group in optimizer.param_groups])

    also(monkeypatch, RadianceModule, "on_train_batch_start", note)
    changed = ("trainer.max_steps=14", "model.plane_lr=0.02", "model.warmup_steps=0")
    train(*FEW, *changed, resume=True)
    assert len(seen) == 2
    assert all(rates[0] < 0.021 for rates in seen)
    assert seen[0][1] == pytest.approx(10 * seen[0][0])


def test_a_damaged_checkpoint_gives_way_to_the_best(train, whole, folder, caplog):
    last, best = (folder / "checkpoints" / f"{name}.ckpt" for name in ("last", "best"))
    content = last.read_bytes()
    last.write_bytes(content[:-1000])
    assert find_resumable(last.parent) == last
    assert last.read_bytes() == best.read_bytes() != content
    last.write_bytes(content)
    flip(last, len(content) // 2)
    caplog.clear()
    train(*SCORED, resume=True)
    assert "last.ckpt cannot be read" in caplog.text
    assert "Continuing from" in caplog.text
    same_state(checkpoint(whole)["state_dict"], checkpoint(folder)["state_dict"])


def test_a_lost_checkpoint_gives_way_to_the_best_or_is_missed_aloud(folder, caplog):
    last, best = (folder / "checkpoints" / f"{name}.ckpt" for name in ("last", "best"))
    last.unlink()
    with pytest.raises(ConfigError, match="already holds a run"):
        claim(folder, resume=False)
    assert find_resumable(last.parent) == last
    assert last.read_bytes() == best.read_bytes()
    assert "last.ckpt does not exist; try best.ckpt beside it. Continuing from" in caplog.text
    for name in ("metrics.json", "curve.csv"):
        shutil.rmtree(last.parent, ignore_errors=True)
        caplog.clear()
        assert find_resumable(last.parent) is None
        assert "training starts again at step 0" in caplog.text
        (folder / name).unlink()


def test_damaged_checkpoints_alone_are_refused_with_a_message(tmp_path):
    assert find_resumable(tmp_path / "checkpoints") is None
    for name in ("last.ckpt", "best.ckpt"):
        (tmp_path / name).write_bytes(b"half")
        with pytest.raises(ConfigError, match=r"last\.ckpt cannot be read.*start again, delete"):
            find_resumable(tmp_path)


def test_a_sound_checkpoint_that_cannot_be_read_is_not_called_damaged(tmp_path):
    path = tmp_path / "last.ckpt"
    torch.save({"place": PurePosixPath("anywhere")}, path)
    with pytest.raises(ConfigError, match=r"last\.ckpt is not plain data \(pathlib\.PurePos"):
        load_checkpoint(path)
    with (
        patch("zipfile.ZipFile", side_effect=PermissionError(13, "Permission denied")),
        pytest.raises(ConfigError, match=r"last\.ckpt cannot be read: Permission denied$"),
    ):
        load_checkpoint(path)


def test_checkpoints_without_a_record_are_not_overwritten(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").touch()
    with pytest.raises(ConfigError, match=r"holds checkpoints, but no run\.json\. Choose another"):
        claim(tmp_path, resume=False)


@pytest.mark.parametrize("refusal", [ConfigError, MissingExtraError])
def test_a_refused_resume_keeps_the_earlier_settings(tmp_path, refusal):
    (tmp_path / "config.yaml").write_text("seed: 1\n")
    with pytest.raises(refusal), keeping_settings(tmp_path, {"seed": 2}, ["seed=2"]):
        raise refusal("no")
    assert (tmp_path / "config.yaml").read_text() == "seed: 1\n"


def test_a_damaged_record_does_not_end_a_run(train, folder, caplog):
    (folder / "run.json").write_text('{"status": "runn')
    with pytest.raises(ConfigError, match=r"already holds a run \(damaged\)"):
        train(*SCORED)
    train(*SCORED, resume=True)
    assert "starting a new record of this run" in caplog.text
    record = status(folder)
    assert (record["status"], record["resumed"]) == ("finished", 1)
    # What was evaluated again stands in the curve once.
    assert [row["step"] for row in read_rows(folder / "curve.csv")] == ["5", "12"]
