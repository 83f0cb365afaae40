"""Run directories are found, loaded and scored, or it is said what is wrong with them."""

import json
import shutil
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from tests.refusals import assert_refused
from tests.training.runs import metrics
from xplanes.errors import ConfigError
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.tools.evaluate import UnavailableError, evaluate, lpips, score_table, write_scores
from xplanes.tools.runs import find_run, load_run


@pytest.fixture
def copied(trained_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained_run, tmp_path / "run"))


@pytest.mark.parametrize(
    ("runs", "wanted", "words"),
    [
        ("outputs/six outputs/z", "outputs/sx", r"does not exist\. Similar names:\s+outputs/six$"),
        ("elsewhere/six", "elsewhere/sx", r"Similar names:\s+elsewhere/six$"),
        ("outputs/sweeps/planes/0_a", "qqq", r"The newest runs:\s+outputs/sweeps/planes/0_a$"),
        ("sweep/0_a sweep/1_b", "sweep", r"folder of 2 runs; name one of them:\s+sweep/0_a"),
        ("", "x", r"(python train\.py|xplanes train)$"),
    ],
    ids=["misspelt", "misspelt elsewhere", "unknown", "a sweep", "no runs at all"],
)
def test_what_is_no_run_is_answered_with_what_is_there(tmp_path, monkeypatch, runs, wanted, words):
    monkeypatch.chdir(tmp_path)
    for name in map(Path, runs.split()):
        name.mkdir(parents=True)
        (name / "run.json").write_text("{}")
    with pytest.raises(ConfigError, match=words):
        find_run(Path(wanted))


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


# Scores after training are the scores of training


def test_scores_equal_those_of_the_run(trained_run):
    known = metrics(trained_run)
    scores = evaluate(load_run(trained_run), "none")
    assert (scores["step"], scores["split"]) == (known["step"], known["split"])
    assert scores["test"] == pytest.approx(known["test"], abs=1e-6)
    for mine, theirs in zip(scores["views"], known["views"], strict=True):
        assert mine.pop("file") == theirs.pop("file")
        assert mine == pytest.approx(theirs, abs=1e-6)


def test_each_split_and_checkpoint_has_its_own_file(trained_run):
    before = (trained_run / "metrics.json").read_bytes()
    names = []
    for checkpoint, split in (("last", "val"), ("best", "val"), ("last", "train")):
        scores = evaluate(load_run(trained_run, checkpoint=checkpoint, split=split), "none")
        assert scores["views"][0]["file"].startswith(f"{split}/")
        path = write_scores(trained_run, scores)
        assert json.loads(path.read_text())["test"] == scores["test"]
        names.append(path.name)
    assert names == ["evaluation_val.json", "evaluation_val_best.json", "evaluation_train.json"]
    assert (trained_run / "metrics.json").read_bytes() == before


def test_lpips_that_is_not_installed_is_a_reason_not_a_failure(trained_run, monkeypatch):
    for name in ("torchvision", "torchvision.models"):
        monkeypatch.setitem(sys.modules, name, None)
    scores = evaluate(load_run(trained_run), "alex")
    assert set(scores["test"]) == {"psnr", "ssim", "floaters"}
    assert ".[lpips]" in scores["not_computed"]["lpips_alex"]
    assert "lpips_alex not computed (torchvision is not installed" in score_table(scores)


def test_lpips_names_what_is_too_small():
    with pytest.raises(UnavailableError, match="16 pixels"):
        lpips("vgg", 16, "cpu", download=False)


def test_table_has_a_line_per_view_and_the_means():
    scores = {
        "test": {"psnr": 20.5, "ssim": 0.75, "lpips_vgg": 0.2},
        "views": [
            {"file": "test/a.png", "time": 0.0, "psnr": 20.0, "ssim": 0.5, "lpips_vgg": 0.3},
            {"file": "test/b.png", "time": 1.0, "psnr": 21.0, "ssim": 1.0, "lpips_vgg": 0.1},
        ],
        "not_computed": {},
    }
    lines = [line.split() for line in score_table(scores).splitlines()]
    assert lines == [
        ["view", "time", "psnr", "ssim", "lpips_vgg"],
        ["test/a.png", "0.000", "20.00", "0.5000", "0.3000"],
        ["test/b.png", "1.000", "21.00", "1.0000", "0.1000"],
        ["mean", "of", "2", "views", "20.50", "0.7500", "0.2000"],
    ]
