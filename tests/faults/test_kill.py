"""A run that is killed at any time resumes and reaches the same result."""

import json
import os
import random
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest

from tests.faults.conftest import Child, config_of
from xplanes.files import MARK
from xplanes.training.checkpoints import load_checkpoint

pytestmark = pytest.mark.stress

RANDOM_MOMENTS = 14
WRITING = 6


def kill(child: Child) -> None:
    os.kill(child.pid, signal.SIGKILL)
    assert child.finish() == -signal.SIGKILL


def nothing_half_written(folder: Path) -> int:
    """Every file of a killed run is whole or absent; gives the step of its checkpoint."""
    for path in folder.glob("*.json"):
        json.loads(path.read_text())
    last = folder / "checkpoints" / "last.ckpt"
    step = load_checkpoint(last)["global_step"] if last.is_file() else 0
    assert step % 3 == 0 or step == 40
    return step


@pytest.mark.parametrize("number", range(RANDOM_MOMENTS))
def test_random_times(recovered, nursery, shared, tmp_path, number):
    """kill -9 at random times of a run, lrm=none and lrm=tiny"""
    lrm = ("none", "tiny")[number % 2]
    config = config_of(shared, lrm, tmp_path / "cache")
    folder = tmp_path / "run"
    # Three kills in one run, and the last attempt may finish.
    for attempt in range(3):
        resume = (folder / "run.json").is_file()
        child = nursery.start(config, folder, resume=resume)
        time.sleep(random.Random(f"{number} {attempt}").uniform(0.02, 1.5))
        with suppress(ProcessLookupError):
            os.kill(child.pid, signal.SIGKILL)
        status = child.finish()
        if status == 0:
            break
        assert status == -signal.SIGKILL, child.output()
        nothing_half_written(folder)
    recovered(folder, lrm, config=config)


@pytest.mark.parametrize("number", range(WRITING))
def test_while_a_checkpoint_is_written(recovered, nursery, shared, tmp_path, number):
    """kill -9 while a checkpoint is being written"""
    lrm = ("none", "tiny")[number % 2]
    config = config_of(shared, lrm, tmp_path / "cache")
    folder = tmp_path / "run"
    child = nursery.start(config, folder, resume=False)
    seen: set[str] = set()
    deadline = time.monotonic() + 60
    # The first files to be written are other ones each time.
    while len(seen) <= 2 * number:
        assert time.monotonic() < deadline, child.output()
        seen |= {path.name for path in (folder / "checkpoints").glob(f".*{MARK}*")}
    kill(child)
    step = nothing_half_written(folder)
    assert step < 40
    recovered(folder, lrm, config=config)


@pytest.mark.parametrize("wait", [0.1, 0.3, 0.6])
def test_while_the_scene_is_rendered(recovered, nursery, tmp_path, wait):
    """kill -9 while the demo scene is rendered"""
    config = config_of(tmp_path, "none", None)
    child = nursery.start(config, tmp_path / "run", resume=False)
    time.sleep(wait)
    kill(child)
    recovered(tmp_path / "run", config=config)
