"""Lets every test import `tests.oracles`, from wherever pytest is started."""

import os
from pathlib import Path

import pytest
import torch

if not torch.cuda.is_available():
    # Triton reads this when it is imported, and torch imports triton where it is installed.
    os.environ.setdefault("TRITON_INTERPRET", "1")


@pytest.fixture(scope="session")
def trained_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small finished run. Copy it before changing anything in it."""
    from tests.training.runs import small_config
    from xplanes.pipeline import run

    folder = tmp_path_factory.mktemp("trained")
    run(small_config(folder / "scenes"), folder / "outputs" / "run", ["seed=0"], resume=False)
    return folder / "outputs" / "run"
