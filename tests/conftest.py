"""Lets every test import `tests.oracles`, from wherever pytest is started."""

import copy
import functools
import gc
import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from xplanes.process import defaults

os.environ.update(defaults(os.environ))  # Before torch is imported, as the command line does.

import pytest
import torch

if not torch.cuda.is_available():
    # Triton reads this when it is imported, and torch imports triton where it is installed.
    os.environ.setdefault("TRITON_INTERPRET", "1")

# Processes side by side share the cores: threads that wait for one another would slow all of them.
_processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
torch.set_num_threads(max(1, torch.get_num_threads() // _processes))


WINGS = tuple(Path(__file__).parent / name for name in ("baselines", "synthetic"))
"""Their tests run in a CI job of their own (`pytest -m "slow or not slow"`)."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the wings' tests, and make the fake device known.

    The first backward pass counts the devices.
    """
    for item in items:
        if any(wing in item.path.parents for wing in WINGS):
            item.add_marker(pytest.mark.slow)
    if any("fake_gpu" in getattr(item, "fixturenames", ()) for item in items):
        from tests.fake_device import register

        register()


def pytest_collection_finish() -> None:
    """The garbage collector need not look through all that was imported again and again."""
    gc.collect()
    gc.freeze()


def pytest_unconfigure() -> None:
    gc.unfreeze()


@pytest.fixture
def fake_gpu(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """A device that refuses what a GPU would, see `tests.fake_device`."""
    from tests import fake_device

    if fake_device.SETUP is None:
        pytest.skip(f"torch {torch.__version__} takes no devices written in Python")
    monkeypatch.setattr(torch, "Generator", fake_device.FakeGenerator)
    return torch.device(fake_device.NAME, 0)


@pytest.fixture(scope="session", autouse=True)
def short_videos() -> Iterator[None]:
    """Demo scenes have few frames in their video: rendering it takes longer than a small run."""
    from tests.warm import VIDEO_FRAMES
    from xplanes.synthetic.demo import write

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "VIDEO_FRAMES", VIDEO_FRAMES)
        yield


@pytest.fixture(scope="session", autouse=True)
def yaml_read_once() -> Iterator[None]:
    """Hundreds of compositions open the same files: each text is parsed once."""
    from omegaconf import OmegaConf

    load = OmegaConf.load
    parsed = functools.cache(lambda text: load(io.StringIO(text)))

    def read(file: Any) -> Any:
        if not hasattr(file, "read"):
            return load(file)
        try:
            return copy.deepcopy(parsed(file.read()))
        except Exception:  # Which names the file if it is read as such.
            file.seek(0)
            return load(file)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", staticmethod(read))
        yield


@pytest.fixture(scope="session", autouse=True)
def composed_once() -> Iterator[None]:
    """Many tests compose the same: only groups of a test's own are composed again."""
    import hydra

    compose, made = hydra.compose, {}

    def once(name: str | None, overrides: list[str], return_hydra_config: bool = False) -> Any:
        if any("searchpath" in text for text in overrides):
            return compose(name, overrides, return_hydra_config)
        key = (name, *overrides, return_hydra_config and Path.cwd())
        if key not in made:
            made[key] = compose(name, overrides, return_hydra_config)
        return copy.deepcopy(made[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hydra, "compose", once)
        yield


@pytest.fixture(scope="session")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where demo scenes are rendered once for all processes. Copy one before changing it."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "scenes"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def trained_run(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small finished run. Copy it before changing anything in it."""
    from tests.training.runs import small_config
    from xplanes.run import run

    folder = tmp_path_factory.mktemp("trained")
    run(small_config(scenes), folder / "outputs" / "run", ["seed=0"], resume=False)
    return folder / "outputs" / "run"
