"""Controls of the LRM, what each exchanges and leaves alone; and runs at equal total time."""

import functools
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from tests import inside
from tests.training.runs import SMALL, metrics
from xplanes.config import compose_plain
from xplanes.errors import ConfigError
from xplanes.fields import XPlanes
from xplanes.models.initialisation import Initialisation
from xplanes.preparation import TriplaneSequence, save_triplanes
from xplanes.rendering import grid_renderer
from xplanes.run import run
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.training.module import RadianceModule

LRM = ("lrm=tiny", "model.channels=32", "model.decoder.width=64", "preparation.frames=3")

Made = tuple[Initialisation, RadianceModule]
Make = Callable[..., Made]


@pytest.fixture(scope="module")
def controls() -> Iterator:
    with inside.benchmark("controls") as module:
        yield module


@pytest.fixture(scope="module")
def make(controls, scenes: Path) -> Make:
    """A field of 24 texels from `tiny`, with a control or none; not to be changed."""

    @functools.cache
    def make(control: str | None, file: Path | None = None) -> Made:
        given = [*SMALL, *LRM, f"data.root={scenes}", "preparation.cache=null"]
        if control is not None:
            given += [*controls.overrides(control, file), "plugins=[controls]"]
        module, data = RadianceModule.compose(*given), SceneDataModule.compose(*given)
        data.setup("fit")
        module.build(data.scene, say=lambda _: None)
        assert module.initialisation is not None
        return module.initialisation, module

    return make


@pytest.fixture(scope="module")
def plain(make: Make) -> Made:
    return make(None)


def planes(found: Initialisation) -> dict[str, torch.Tensor]:
    assert found.values is not None
    return dict(found.values.planes)


def same_decoder(a: RadianceModule, b: RadianceModule) -> bool:
    assert isinstance(a.field, XPlanes)
    assert isinstance(b.field, XPlanes)
    pairs = zip(a.field.decoder.parameters(), b.field.decoder.parameters(), strict=True)
    return all(torch.equal(one, other) for one, other in pairs)


@pytest.mark.slow
@pytest.mark.parametrize("control", ["random_planes", "mean", "one_frame", "other_scene", "median"])
def test_planes_are_exchanged_the_decoder_stays_and_nothing_is_held_still(make, plain, control):
    found, module = make(control)
    assert module.model.sparse is None or control not in ("random_planes", "mean", "one_frame")
    before, after = planes(plain[0]), planes(found)
    assert same_decoder(module, plain[1])
    assert all(not torch.equal(before[name], after[name]) for name in ("xy", "xz", "yz"))
    assert all(plane.shape == before[name].shape for name, plane in after.items())
    assert torch.equal(found.frame.centre, plain[0].frame.centre)


@pytest.mark.slow
def test_a_fresh_decoder_leaves_the_planes(make, plain):
    found, module = make("fresh_decoder")
    assert not same_decoder(module, plain[1])
    assert all(torch.equal(plane, planes(plain[0])[name]) for name, plane in planes(found).items())


@pytest.mark.slow
def test_the_oracle_is_what_the_file_holds(make, plain, tmp_path):
    own = 2 * torch.rand(1, 3, 32, 24, 24, generator=torch.Generator().manual_seed(0)) - 1
    field = plain[1].field
    assert isinstance(field, XPlanes)
    decoder = field.decoder
    save_triplanes(
        tmp_path / "true.safetensors",
        TriplaneSequence(own.expand(3, -1, -1, -1, -1), decoder.state_dict(), decoder.options),
    )
    found = planes(make("oracle", tmp_path / "true.safetensors")[0])
    torch.testing.assert_close(found["xy"], own[0, 0], atol=0.02, rtol=0.02)


def test_the_oracle_needs_a_file_and_no_other_control_takes_one(make, tmp_path):
    with pytest.raises(ConfigError, match=r"control=oracle with lrm.triplanes=None"):
        make("oracle")
    with pytest.raises(ConfigError, match=r"control=mean with lrm.triplanes=.*\.pt"):
        make("mean", tmp_path / "a.pt")


# Runs that are compared at equal total time


LONG, STEP = 10_000.0, 100.0
"""Seconds that filling the grid and a step of training take here."""


@pytest.fixture
def train(monkeypatch, scenes: Path, tmp_path: Path):
    """A run from `tiny` with so many seconds: its metrics."""
    clock, ahead, fill = time.perf_counter, [0.0], grid_renderer.fill
    step = RadianceModule.on_train_batch_start

    def slow(*args, **named) -> None:
        fill(*args, **named)
        ahead[0] += LONG

    def slower(self, *args) -> None:
        step(self, *args)
        ahead[0] += STEP

    def train(seconds: str) -> dict:
        given = [*SMALL, f"data.root={scenes}", "lrm=tiny", "preparation.cache=null"]
        given += ["model.channels=32", "model.decoder.width=64", "preparation.frames=2"]
        given += ["trainer.max_steps=1000000", f"trainer.max_seconds={seconds}"]
        given += total_time.OVERRIDES
        run(compose_plain("train", given), tmp_path / "run", [], resume=False)
        return metrics(tmp_path / "run")

    monkeypatch.setattr(time, "perf_counter", lambda: clock() + ahead[0])
    monkeypatch.setattr(grid_renderer, "fill", slow)
    monkeypatch.setattr(RadianceModule, "on_train_batch_start", slower)
    with inside.benchmark("total_time") as total_time:
        yield train


@pytest.mark.slow
def test_training_gets_what_the_preparation_leaves(train):
    budget = LONG + 10 * STEP
    seconds = train(f"{budget}")["seconds"]
    assert budget <= sum(seconds["prepare"].values()) + seconds["train"] < budget + 2 * STEP


@pytest.mark.parametrize(
    ("seconds", "words"),
    [("9000", r"=9000: the preparation took 1\d{4}\.\d s"), ("null", "=null")],
)
def test_a_budget_is_needed_that_is_larger_than_the_preparation(train, seconds, words):
    with pytest.raises(ConfigError, match=f"max_seconds{words}"):
        train(seconds)
