"""What tests of training share."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def scenes(trained_run: Path) -> Path:
    """The folder of the shared run's scenes: rendering one takes longer than a small run."""
    return trained_run.parents[1] / "scenes"
