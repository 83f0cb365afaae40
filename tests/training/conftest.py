"""What tests of training share."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.training.runs import small_config
from xplanes.run import run


@pytest.fixture
def train(scenes: Path, tmp_path: Path) -> Callable[..., Path]:
    """Trains a small run in a folder of a name, with overrides and other nodes; the folder."""

    def train(*overrides: str, name: str = "run", resume: bool = False, **nodes: Any) -> Path:
        run(small_config(scenes, *overrides) | nodes, tmp_path / name, [], resume=resume)
        return tmp_path / name

    return train
