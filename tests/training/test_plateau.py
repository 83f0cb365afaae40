"""Training that has converged: when that is said, and how it ends."""

import json
import math
import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from tests.training.runs import small_config
from xplanes.errors import ConfigError
from xplanes.evaluation.runs import load_run
from xplanes.models.x_planes import XPlanesModel
from xplanes.pipeline import run
from xplanes.training import plateau
from xplanes.training.plateau import LEAST, converged


def errors_at(count: int, *, rise: float, level: float = 0.0) -> list[float]:
    """Errors whose PSNR rises by ``rise`` dB per doubling, on a floor of ``level``."""
    return [10 ** (-0.1 * (15 + rise * math.log2(n + 1))) + level for n in range(count)]


def test_the_gain_of_a_doubling_is_what_is_judged():
    for rise in (0.1, 0.5, 2.0):
        for count in (20, 64, 500):
            errors = errors_at(count, rise=rise)
            assert converged(errors, 1.15 * rise), (rise, count)
            assert not converged(errors, 0.85 * rise), (rise, count)


def test_a_floor_ends_a_rise():
    errors = errors_at(4000, rise=3.0, level=1e-3)
    ends = [n for n in range(LEAST, 4000, 2) if converged(errors[:n], 0.2)]
    assert 100 < ends[0] < 2000


def test_too_little_is_not_judged():
    for count in (0, 1, LEAST - 1, LEAST + 1):
        assert not converged([1.0] * count, 100.0), count


def test_errors_of_zero_and_rising_errors_are_convergence():
    assert converged([0.0] * LEAST, 0.1)
    assert converged([1.0 + n for n in range(LEAST)], 0.1)


def test_a_resumed_run_remembers_its_last_batch(scenes: Path, tmp_path: Path):
    config = small_config(scenes, "trainer.max_steps=3", "media=false", "lrm=none")
    run(config, tmp_path / "run", [], resume=False)
    trained = load_run(tmp_path / "run").module
    assert trained.last["psnr"] > 0
    # The limit that was reached is the one that a longer run must raise.
    said = (tmp_path / "run" / "train.log").read_text()
    assert "trainer.max_steps=6" in said
    assert "trainer.max_seconds=" not in said.split("resume=")[-1]


def outcome(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def weights(folder: Path) -> dict:
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    return state["state_dict"]


def judge_soon(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(plateau, "BLOCK", 1)
    patch.setattr(plateau, "LEAST", 8)


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    judge_soon(monkeypatch)


def config_of(scenes: Path, *overrides: str) -> dict:
    """Whatever the run gains is too little."""
    return small_config(
        scenes, "callbacks.plateau.gain=1000", "callbacks.evaluation.at=[]", *overrides
    )


@dataclass
class Stopped:
    """A run that had converged."""

    folder: Path
    rates: dict[int, float]


@pytest.fixture(scope="module")
def stopped(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Stopped:
    rates = {}
    original = XPlanesModel.rate

    def rate(self, step, progress):
        rates[step] = original(self, step, progress)
        return rates[step]

    folder = tmp_path_factory.mktemp("plateau") / "run"
    with pytest.MonkeyPatch.context() as patch:
        judge_soon(patch)
        patch.setattr(XPlanesModel, "rate", rate)
        run(config_of(scenes), folder, [], resume=False)
    return Stopped(folder, rates)


@pytest.fixture
def folder(stopped: Stopped, tmp_path: Path) -> Path:
    """The finished run, to be changed."""
    return Path(shutil.copytree(stopped.folder, tmp_path / "run"))


def test_a_converged_run_cools_down_and_stops(stopped: Stopped):
    found = outcome(stopped.folder)
    assert found["converged"] == 8
    assert found["step"] == 10
    assert found["skipped"]["budget"] == pytest.approx(1 - 10 / 40)
    assert len(stopped.rates) == 10
    # The last steps fall to the end of the cosine, less its warm-up.
    assert stopped.rates[9] / 10 < stopped.rates[8] / 9
    text = (stopped.folder / "train.log").read_text()
    assert "75% of the budget, as training had converged at step 8" in text


def test_a_run_that_failed_ends_at_the_same_step(scenes, stopped, tmp_path, soon, monkeypatch):
    """It fails before it has converged, and while it cools down."""
    config = config_of(scenes, "callbacks.checkpoints.every=1")
    step = plateau.PlateauStop.on_train_batch_end
    stop = 0

    def break_down(self, trainer, *rest):
        step(self, trainer, *rest)
        if trainer.global_step == stop:
            raise OSError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(plateau.PlateauStop, "on_train_batch_end", break_down)
        for stop in (5, 9):
            with pytest.raises(OSError, match="power cut"):
                run(config, tmp_path / "halved", [], resume=stop > 5)
    run(config, tmp_path / "halved", [], resume=True)
    assert outcome(tmp_path / "halved")["step"] == outcome(stopped.folder)["step"] == 10
    whole, halved = weights(stopped.folder), weights(tmp_path / "halved")
    assert all(torch.equal(whole[name], halved[name]) for name in whole)


def test_a_finished_run_stays_finished(scenes, folder, soon):
    before = weights(folder)
    run(config_of(scenes), folder, [], resume=True)
    assert outcome(folder)["step"] == 10
    after = weights(folder)
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_without_the_rule_the_budget_is_spent(scenes, folder, soon):
    """By a run that had converged, too."""
    run(small_config(scenes, "callbacks.evaluation.at=[]"), folder, [], resume=True)
    found = outcome(folder)
    assert (found["step"], found["converged"], found["skipped"]["budget"]) == (40, None, 0)


def test_a_gain_below_zero_is_refused(scenes):
    with pytest.raises(ConfigError, match=r"callbacks\.plateau\.gain=-1"):
        run(small_config(scenes, "callbacks.plateau.gain=-1"), scenes / "no", [], resume=False)
