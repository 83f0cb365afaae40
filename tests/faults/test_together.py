"""Two runs at once, and clocks that jump."""

import json
import time
from pathlib import Path

import pytest

from tests.faults.conftest import Nursery, config_of
from tests.training.runs import outcome
from xplanes.files import read_rows
from xplanes.locks import RUN_LOCK

pytestmark = pytest.mark.stress


@pytest.fixture
def other(tmp_path: Path):
    """A second place where runs start, so that two go on at once."""
    logs = tmp_path / "logs"
    logs.mkdir()
    nursery = Nursery(logs)
    yield nursery
    nursery.process.stdin.close()  # type: ignore[union-attr]
    nursery.process.wait(60)


@pytest.mark.parametrize("resume", [False, True])
def test_one_directory(tally, nursery, other, shared, whole, tmp_path, resume):
    """Two runs in one directory at once, started and resumed"""
    config, folder = config_of(shared, "none", None), tmp_path / "run"
    first = nursery.start(config, folder, resume=False)
    deadline = time.monotonic() + 60
    while not (folder / ("run.json" if resume else RUN_LOCK)).is_file():
        assert time.monotonic() < deadline
        time.sleep(0.002)
    second = other.start(config, folder, resume=resume)
    assert second.finish() == 1, second.output()
    tally.said(second.output(), f"in use by process {first.pid}")
    assert first.finish() == 0, first.output()
    assert outcome(folder) == whole["none"]
    tally.recovered()


@pytest.mark.parametrize("seconds", [-3600.0, 86_400.0, -86_400.0])
def test_clock_jumps(tally, nursery, shared, whole, tmp_path, seconds):
    """Wall clock set back or on at every reading"""
    config = config_of(shared, "none", None, "trainer.max_seconds=600")
    nursery.run(config, tmp_path / "run", resume=False, clock=seconds)
    found = outcome(tmp_path / "run")
    assert found == whole["none"]
    clock = [float(row["seconds"]) for row in read_rows(tmp_path / "run" / "curve.csv")]
    assert clock == sorted(clock)
    assert 0 <= clock[0] <= clock[-1] < 600
    told = json.loads((tmp_path / "run" / "metrics.json").read_text())["seconds"]
    assert all(0 <= told[name] < 600 for name in ("load", "train", "evaluate", "total"))
    tally.recovered()
