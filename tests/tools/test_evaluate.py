"""Scores after training are the scores of training."""

import json
import sys

import pytest

from xplanes.tools.evaluate import UnavailableError, evaluate, lpips, score_table, write_scores
from xplanes.tools.runs import load_run


def test_scores_equal_those_of_the_run(trained_run):
    metrics = json.loads((trained_run / "metrics.json").read_text())
    scores = evaluate(load_run(trained_run), "none")
    assert scores["step"] == metrics["step"]
    assert scores["split"] == metrics["split"]
    assert scores["test"] == pytest.approx(metrics["test"], abs=1e-6)
    assert [row["file"] for row in scores["views"]] == [row["file"] for row in metrics["views"]]
    for mine, theirs in zip(scores["views"], metrics["views"], strict=True):
        assert {k: v for k, v in mine.items() if k != "file"} == pytest.approx(
            {k: v for k, v in theirs.items() if k != "file"}, abs=1e-6
        )


def test_each_split_and_checkpoint_has_its_own_file(trained_run):
    metrics = (trained_run / "metrics.json").read_bytes()
    names = []
    for checkpoint, split in (("last", "val"), ("best", "val"), ("last", "train")):
        scores = evaluate(load_run(trained_run, checkpoint=checkpoint, split=split), "none")
        assert scores["views"][0]["file"].startswith(f"{split}/")
        path = write_scores(trained_run, scores)
        assert json.loads(path.read_text())["test"] == scores["test"]
        names.append(path.name)
    assert names == ["evaluation_val.json", "evaluation_val_best.json", "evaluation_train.json"]
    assert (trained_run / "metrics.json").read_bytes() == metrics


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
