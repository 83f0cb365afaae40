"""Two runs at once, and clocks that jump."""

import json
import time
from pathlib import Path

import pytest

from tests.faults.conftest import config_of, nursery_in
from xplanes.files import read_rows
from xplanes.locks import RUN_LOCK

pytestmark = pytest.mark.stress


@pytest.fixture
def other(tmp_path: Path):
    """A second place where runs start, so that two go on at once."""
    with nursery_in(tmp_path) as found:
        yield found


@pytest.mark.parametrize("resume", [False, True])
def test_one_directory(tally, recovered, nursery, other, shared, tmp_path, resume):
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
    recovered(folder)


@pytest.mark.parametrize("seconds", [-3600.0, 86_400.0, -86_400.0])
def test_clock_jumps(recovered, nursery, shared, tmp_path, seconds):
    """Wall clock set back or on at every reading"""
    config = config_of(shared, "none", None, "trainer.max_seconds=600")
    nursery.run(config, tmp_path / "run", resume=False, clock=seconds)
    clock = [float(row["seconds"]) for row in read_rows(tmp_path / "run" / "curve.csv")]
    assert clock == sorted(clock)
    assert 0 <= clock[0] <= clock[-1] < 600
    told = json.loads((tmp_path / "run" / "metrics.json").read_text())["seconds"]
    assert all(0 <= told[name] < 600 for name in ("load", "train", "evaluate", "total"))
    recovered(tmp_path / "run")
