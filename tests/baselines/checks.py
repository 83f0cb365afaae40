"""What every baseline's run must do."""

from pathlib import Path

import pytest

from tests.baselines.runs import baseline_config
from tests.refusals import assert_refused
from tests.training.runs import broken_off, checkpoint, metrics, same_state
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.files import read_rows
from xplanes.run import run
from xplanes.tools.evaluate import evaluate
from xplanes.tools.render import VideoOptions, render_video
from xplanes.tools.runs import TrainedRun, load_run


def check_refused(root: Path, words: str, *overrides: str) -> str:
    """These overrides make a configuration that is refused. Returns the message."""

    def call() -> None:
        Experiment.read(baseline_config(root, *overrides))

    return assert_refused(ConfigError, words, call, overrides)


def scores(folder: Path) -> list[float]:
    return [float(row["psnr"]) for row in read_rows(folder / "curve.csv")]


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


def check_resume(config: dict, whole: Path, folder: Path, *, stop: int) -> None:
    """A run that failed and was resumed is bit-identical to an uninterrupted one."""
    broken_off((stop,), config, folder)
    run(config, folder, [], resume=True)
    assert scores(folder) == scores(whole)
    same_state(*(checkpoint(path)["state_dict"] for path in (whole, folder)))


def check_reload(folder: Path) -> TrainedRun:
    """The trained run loads, its scores are reproduced, and it renders a video."""
    trained = load_run(folder, device="cpu")
    found = evaluate(trained, "none")
    assert found["test"]["psnr"] == pytest.approx(metrics(folder)["test"]["psnr"], abs=1e-6)
    path = render_video(trained, VideoOptions(frames=2, size=8))
    assert path.stat().st_size > 0
    return trained
