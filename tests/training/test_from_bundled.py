"""Runs initialised from the bundled model, the default of `python train.py`."""

from pathlib import Path

import pytest

from tests.training.runs import composed, metrics, small_config
from xplanes.files import read_rows
from xplanes.lrm.bundled import bundled_models
from xplanes.run import run
from xplanes.tools.runs import load_run

SETTINGS = (
    "model.channels=32",
    "model.decoder.width=64",
    "model.resolution=32",
    "preparation.cache=null",
    "preparation.frames=6",
    "trainer.max_steps=30",
    "callbacks.evaluation.at=[0]",
)


@pytest.fixture(scope="module")
def train(scenes: Path):
    def train(folder: Path, *overrides: str) -> list[float]:
        """PSNR at step 0 and at the end of a run."""
        run(small_config(scenes, *SETTINGS, *overrides), folder, [], resume=False)
        return [float(row["psnr"]) for row in read_rows(folder / "curve.csv")]

    return train


@pytest.fixture(scope="module")
def random(train, tmp_path_factory: pytest.TempPathFactory) -> list[float]:
    """PSNR of random initialisation."""
    return train(tmp_path_factory.mktemp("random") / "run", "lrm=none")


def test_the_default_initialisation_is_a_bundled_model():
    assert composed().lrm.name in bundled_models()


@pytest.mark.parametrize("name", ["tiny", pytest.param("mini", marks=pytest.mark.slow)])
def test_it_knows_the_scene_before_the_first_step(train, random, tmp_path, name):
    informed = train(tmp_path / "run", f"lrm={name}")
    assert informed[0] > random[0] + 3
    assert informed[-1] > random[-1] + 1
    content = metrics(tmp_path / "run")
    assert content["lrm"]["mismatch_pixels"]["largest"] < 0.1
    assert content["seconds"]["prepare"]["lrm"] > 0
    assert content["seconds"]["prepare"]["fill"] > 0


def test_a_scene_without_motion_trains_as_a_static_one(train, tmp_path):
    folder = tmp_path / "run"
    train(folder, "lrm=tiny", "data.scene=still_life", "trainer.max_steps=1")
    assert (metrics(folder)["lrm"]["frames"], metrics(folder)["lrm"]["distinct"]) == (1, 1)
    assert metrics(folder)["decomposition"] == {}
    loaded = load_run(folder)
    assert loaded.is_static
    assert loaded.module.renderer.grid.time_bins == 1
    assert "trains as a static one" in (folder / "train.log").read_text()
