"""Training that has converged: when that is said, and how it ends."""

import json
import math
from pathlib import Path

import pytest
import torch

from tests.training.runs import small_config
from xplanes.config import ConfigError
from xplanes.pipeline import run
from xplanes.training import plateau
from xplanes.training.methods.xplanes import XPlanesMethod
from xplanes.training.plateau import LEAST, converged


def errors_at(count: int, *, rise: float, level: float = 0.0) -> list[float]:
    """Errors whose PSNR rises by ``rise`` dB per doubling, on a floor of ``level``."""
    return [10 ** (-0.1 * (15 + rise * math.log2(n + 1))) + level for n in range(count)]


@pytest.mark.parametrize("rise", [0.1, 0.5, 2.0])
@pytest.mark.parametrize("count", [20, 64, 500])
def test_the_gain_of_a_doubling_is_what_is_judged(rise, count):
    errors = errors_at(count, rise=rise)
    assert converged(errors, 1.15 * rise)
    assert not converged(errors, 0.85 * rise)


def test_a_floor_ends_a_rise():
    errors = errors_at(4000, rise=3.0, level=1e-3)
    ends = [n for n in range(LEAST, 4000, 2) if converged(errors[:n], 0.2)]
    assert 100 < ends[0] < 2000


@pytest.mark.parametrize("count", [0, 1, LEAST - 1, LEAST + 1])
def test_too_little_is_not_judged(count):
    assert not converged([1.0] * count, 100.0)


def test_errors_of_zero_and_rising_errors_are_convergence():
    assert converged([0.0] * LEAST, 0.1)
    assert converged([1.0 + n for n in range(LEAST)], 0.1)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scenes")


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plateau, "BLOCK", 1)
    monkeypatch.setattr(plateau, "LEAST", 8)


def outcome(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def weights(folder: Path) -> dict:
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    return state["state_dict"]


def test_a_converged_run_cools_down_and_stops(scenes, tmp_path, soon, monkeypatch, capsys):
    rates = {}
    original = XPlanesMethod.rate

    def rate(self, step, progress):
        rates[step] = original(self, step, progress)
        return rates[step]

    monkeypatch.setattr(XPlanesMethod, "rate", rate)
    # Whatever it gains is too little.
    run(small_config(scenes, "trainer.plateau=1000"), tmp_path / "run", [], resume=False)
    found = outcome(tmp_path / "run")
    assert found["converged"] == 8
    assert found["step"] == 10
    assert found["skipped"]["budget"] == pytest.approx(1 - 10 / 40)
    assert len(rates) == 10
    # The last steps fall to the end of the cosine, less its warm-up.
    assert rates[9] / 10 < rates[8] / 9
    assert "75% of the budget, as training had converged at step 8" in capsys.readouterr().out


def test_without_the_rule_the_budget_is_spent(scenes, tmp_path, soon):
    run(small_config(scenes), tmp_path / "run", [], resume=False)
    found = outcome(tmp_path / "run")
    assert (found["step"], found["converged"], found["skipped"]["budget"]) == (40, None, 0)


def test_a_run_that_was_stopped_ends_at_the_same_step(scenes, tmp_path, soon, monkeypatch):
    config = small_config(scenes, "trainer.plateau=1000", "trainer.checkpoint_every=1")
    run(config, tmp_path / "whole", [], resume=False)
    step = plateau.PlateauStop.on_train_batch_end

    def break_down(self, trainer, *rest):
        step(self, trainer, *rest)
        if trainer.global_step == 9:
            raise OSError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(plateau.PlateauStop, "on_train_batch_end", break_down)
        with pytest.raises(OSError, match="power cut"):
            run(config, tmp_path / "halved", [], resume=False)
    run(config, tmp_path / "halved", [], resume=True)
    assert outcome(tmp_path / "halved")["step"] == outcome(tmp_path / "whole")["step"] == 10
    whole, halved = weights(tmp_path / "whole"), weights(tmp_path / "halved")
    assert all(torch.equal(whole[name], halved[name]) for name in whole)


def test_a_finished_run_stays_finished(scenes, tmp_path, soon):
    config = small_config(scenes, "trainer.plateau=1000")
    run(config, tmp_path / "run", [], resume=False)
    before = weights(tmp_path / "run")
    run(config, tmp_path / "run", [], resume=True)
    assert outcome(tmp_path / "run")["step"] == 10
    after = weights(tmp_path / "run")
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_a_finished_run_goes_on_without_the_rule(scenes, tmp_path, soon):
    run(small_config(scenes, "trainer.plateau=1000"), tmp_path / "run", [], resume=False)
    run(small_config(scenes), tmp_path / "run", [], resume=True)
    assert outcome(tmp_path / "run")["step"] == 40


def test_a_gain_below_zero_is_refused(scenes):
    with pytest.raises(ConfigError, match=r"trainer\.plateau=-1"):
        run(small_config(scenes, "trainer.plateau=-1"), scenes / "no", [], resume=False)
