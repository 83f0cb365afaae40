"""What tests of tools share."""

from pathlib import Path

import pytest

from xplanes.tools.runs import TrainedRun, load_run


@pytest.fixture(scope="module")
def trained(trained_run: Path) -> TrainedRun:
    """A small finished run, as tools see it; not to be changed."""
    return load_run(trained_run)
