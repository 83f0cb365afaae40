"""Runs that are compared at equal total time."""

import importlib
import json
import sys
import time
from pathlib import Path

import pytest

from tests.training.runs import SMALL
from xplanes.config import compose_plain
from xplanes.errors import ConfigError
from xplanes.rendering import grid_renderer
from xplanes.run import run
from xplanes.training.module import RadianceModule

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"

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
        return json.loads((tmp_path / "run" / "metrics.json").read_text())

    monkeypatch.syspath_prepend(str(FOLDER))
    total_time = importlib.import_module("total_time")
    monkeypatch.setattr(time, "perf_counter", lambda: clock() + ahead[0])
    monkeypatch.setattr(grid_renderer, "fill", slow)
    monkeypatch.setattr(RadianceModule, "on_train_batch_start", slower)
    yield train
    sys.modules.pop("total_time")


@pytest.mark.slow
def test_training_gets_what_the_preparation_leaves(train):
    budget = LONG + 10 * STEP
    seconds = train(f"{budget}")["seconds"]
    assert budget <= sum(seconds["prepare"].values()) + seconds["train"] < budget + 2 * STEP


def test_a_budget_smaller_than_the_preparation_is_refused(train):
    with pytest.raises(ConfigError, match=r"max_seconds=9000: the preparation took 1\d{4}\.\d s"):
        train("9000")


def test_a_budget_is_needed(train):
    with pytest.raises(ConfigError, match="max_seconds=null"):
        train("null")
