"""The model in the package at work: what `python train.py` does by default."""

import json
from pathlib import Path

import pytest

from tests.training.runs import small_config
from xplanes.evaluation.runs import load_run
from xplanes.files import read_rows
from xplanes.lrm.bundled import bundled_models
from xplanes.pipeline import run

SETTINGS = (
    "data.resolution=48",
    "model.channels=32",
    "model.decoder.width=64",
    "model.resolution=32",
    "preparation.cache=null",
    "preparation.frames=10",
    "trainer.max_steps=30",
    "trainer.evaluate_at=[0]",
)


def curve(folder: Path, lrm: str, *overrides: str) -> list[float]:
    config = small_config(folder / "scenes", *SETTINGS, f"lrm={lrm}", *overrides)
    run(config, folder / lrm, [], resume=False)
    return [float(row["psnr"]) for row in read_rows(folder / lrm / "curve.csv")]


def test_the_default_start_is_a_model_of_the_package():
    from hydra import compose, initialize_config_dir

    from xplanes.config import CONF

    with initialize_config_dir(str(CONF), version_base="1.3"):
        assert compose("train").lrm.name in bundled_models()


@pytest.mark.parametrize("name", bundled_models())
def test_it_knows_the_scene_before_the_first_step(tmp_path: Path, name):
    random, informed = curve(tmp_path, "none"), curve(tmp_path, name)
    assert informed[0] > random[0] + 3
    assert informed[-1] > random[-1] + 1
    told = json.loads((tmp_path / name / "metrics.json").read_text())
    assert told["lrm"]["mismatch_pixels"]["largest"] < 0.1
    assert told["seconds"]["prepare"]["lrm"] > 0


def test_a_still_scene_needs_one_triplane(tmp_path: Path):
    curve(tmp_path, "tiny", "data.train_views=1", "data.test_views=1")
    told = json.loads((tmp_path / "tiny" / "metrics.json").read_text())
    assert told["lrm"]["frames"] == 1
    assert told["decomposition"] == {}


def test_a_scene_without_motion_trains_as_a_still_one(tmp_path: Path):
    curve(tmp_path, "tiny", "data.scene=still")
    told = json.loads((tmp_path / "tiny" / "metrics.json").read_text())
    assert (told["lrm"]["frames"], told["lrm"]["distinct"]) == (1, 1)
    assert told["decomposition"] == {}
    loaded = load_run(tmp_path / "tiny")
    assert loaded.is_still
    assert loaded.module.renderer.grid.time_bins == 1
    assert "trains as a still one" in (tmp_path / "tiny" / "train.log").read_text()
