"""Finding and loading run directories, and saying what is wrong with them."""

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from tests.refusals import assert_refused
from xplanes.errors import ConfigError
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.tools.runs import find_run, load_run


@pytest.fixture
def copied(trained_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained_run, tmp_path / "run"))


def made(*folders: Path) -> None:
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "run.json").write_text("{}")


def refusal(run: Path, outputs: Path) -> str:
    return assert_refused(ConfigError, "", partial(find_run, run, outputs), run)


def test_a_misspelt_run_lists_similar_names(tmp_path):
    near = tmp_path / "outputs" / "2026-01-02_lego_six_planes_s0"
    made(near, tmp_path / "outputs" / "zzz")
    text = refusal(tmp_path / "outputs" / "2026-01-02_lego_six_plane_s0", tmp_path / "outputs")
    assert "does not exist. Similar names:" in text
    assert str(near) in text
    assert "zzz" not in text


def test_an_unknown_run_lists_the_newest(tmp_path):
    made(run := tmp_path / "outputs" / "sweeps" / "planes" / "0_lego")
    text = refusal(Path("qqq"), tmp_path / "outputs")
    assert "The newest runs:" in text
    assert str(run) in text


def test_a_sweep_is_told_from_a_run(tmp_path):
    made(tmp_path / "sweep" / "0_a", tmp_path / "sweep" / "1_b")
    text = refusal(tmp_path / "sweep", tmp_path)
    assert "folder of 2 runs; name one of them" in text
    assert "0_a" in text


def test_no_runs_at_all_says_how_to_make_one(tmp_path):
    said = refusal(tmp_path / "x", tmp_path / "outputs")
    assert said.endswith(("python train.py", "xplanes train")), said


def test_what_is_loaded_is_announced_first(trained_run):
    lines: list[str] = []
    trained = load_run(trained_run, checkpoint="best", announce=lines.append)
    assert str(trained_run) in lines[0]
    assert f"best.ckpt, step {trained.step}" in lines[1]
    assert not trained.module.training


def changed(run: Path, name: str, **changes: Any) -> dict[str, Any]:
    """What a file of a run held before these changes."""
    before = yaml.safe_load((run / name).read_text())
    (run / name).write_text(json.dumps(before | changes) + "\n")
    return before


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("config.yaml", "a: [", "damaged"),
        ("config.yaml", "seed: 0\n", "damaged, or from another version"),
        ("config.yaml", "text\n", "not a mapping"),
        ("checkpoints/last.ckpt", "text", "cannot be read"),
        ("checkpoints/last.ckpt", {"weights": torch.zeros(3)}, "not a checkpoint of xplanes"),
        ("checkpoints/last.ckpt", None, "does not exist; try best.ckpt"),
    ],
)
def test_damaged_files_are_named(copied, file, content, words):
    path = copied / file
    path.unlink()
    if isinstance(content, str):
        path.write_text(content)
    elif content is not None:
        torch.save(content, path)
    said = assert_refused(ConfigError, words, partial(load_run, copied), words)
    assert content is None or str(path) in said


@pytest.mark.parametrize("change", [{"channels": 16}, {"name": "nine", "plane_set": "nine"}])
def test_another_model_than_the_checkpoints_is_refused(copied, change):
    model = changed(copied, "config.yaml")["model"]
    assert model["channels"] == 8
    changed(copied, "config.yaml", model=model | change)
    with pytest.raises(ConfigError, match="does not fit"):
        load_run(copied)


def test_the_data_of_a_run_is_that_which_it_was_trained_on(trained_run):
    data, trained = SceneDataModule.from_run(trained_run), load_run(trained_run)
    assert data.seed == 0
    assert data.settings == trained.experiment.data
    for split, views in trained.scene.splits.items():
        assert torch.equal(data.scene.splits[split].images, views.images)


def test_other_training_views_are_refused(copied):
    files = changed(copied, "run.json")["files"]
    changed(copied, "run.json", files=files | {"train": files["train"][:-1]})
    with pytest.raises(ConfigError, match="trained on 9 views"):
        load_run(copied)


def test_a_relative_data_folder_is_found_from_elsewhere(copied, monkeypatch, tmp_path):
    data = changed(copied, "config.yaml")["data"]
    root = Path(data["root"])
    changed(copied, "config.yaml", data=data | {"root": root.name})
    changed(copied, "run.json", directory=str(root.parent))
    monkeypatch.chdir(tmp_path)
    assert load_run(copied).experiment.data.root == str(root)
    assert not (tmp_path / root.name).exists()
