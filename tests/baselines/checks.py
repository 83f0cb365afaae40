"""What every baseline's run must do."""

import csv
import json
from pathlib import Path

import pytest
import torch

from tests.baselines.runs import baseline_config
from tests.refusals import assert_refused
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.run import run
from xplanes.tools.evaluate import evaluate
from xplanes.tools.render import VideoOptions, render_video
from xplanes.tools.runs import TrainedRun, load_run
from xplanes.training.clock import TrainingClock


def check_refused(root: Path, words: str, *overrides: str) -> str:
    """These overrides make a configuration that is refused. Returns the message."""

    def call() -> None:
        Experiment.read(baseline_config(root, *overrides))

    return assert_refused(ConfigError, words, call, overrides)


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def scores(folder: Path) -> list[float]:
    with (folder / "curve.csv").open() as file:
        return [float(row["psnr"]) for row in csv.DictReader(file)]


def check_learns(config: dict, folder: Path, *, gain: float) -> Path:
    """The scored views get better by ``gain`` dB, and metrics.json is whole."""
    run(config, folder, [], resume=False)
    found = scores(folder)
    assert found[-1] > found[0] + gain, found
    content = metrics(folder)
    assert content["parameters"] > 0
    assert content["samples_per_ray"] > 0
    assert content["steps_skipped"] == 0
    return folder


def check_resume(
    config: dict, whole: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, *, stop: int
) -> None:
    """A run that failed and was resumed is bit-identical to an uninterrupted one."""
    original = TrainingClock.on_train_batch_end

    def break_down(self, trainer, module, *rest) -> None:
        original(self, trainer, module, *rest)
        if trainer.global_step == stop:
            raise OSError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(TrainingClock, "on_train_batch_end", break_down)
        with pytest.raises(OSError, match="power cut"):
            run(config, folder, [], resume=False)
    run(config, folder, [], resume=True)
    assert scores(folder) == scores(whole)
    first, second = (
        torch.load(path / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
        for path in (whole, folder)
    )
    assert set(first) == set(second)
    assert all(torch.equal(first[key], second[key]) for key in first)


def check_reload(folder: Path) -> TrainedRun:
    """The trained run loads, its scores are reproduced, and it renders a video."""
    trained = load_run(folder, device="cpu")
    found = evaluate(trained, "none")
    assert found["test"]["psnr"] == pytest.approx(metrics(folder)["test"]["psnr"], abs=1e-6)
    path = render_video(trained, VideoOptions(frames=2, size=8))
    assert path.stat().st_size > 0
    return trained
