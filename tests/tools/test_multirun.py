"""A sweep from the command line to its table."""

import json
from pathlib import Path
from typing import Any

import pytest
from hydra.types import RunMode
from omegaconf import OmegaConf

from tests.inside import train
from tests.tools.test_sheet import areas, pictured
from tests.training.runs import SMALL
from xplanes.files import read_rows
from xplanes.tools.table import SweepTable, choose_gpu

CHANGED = ("model.channels", "trainer.max_steps", "callbacks.evaluation.at")


def test_a_failed_job_is_a_row_and_the_others_go_on(scenes, tmp_path):
    done = train(
        *("-m", "model.channels=0,4"),
        *(option for option in SMALL if not option.startswith(CHANGED)),
        *("trainer.max_steps=2", "callbacks.evaluation.at=[]"),
        *(f"data.root={scenes}", f"hydra.sweep.dir={tmp_path}"),
        cwd=tmp_path,
        code=1,
    )
    rows = read_rows(tmp_path / "table.csv")
    assert [row["model.channels"] for row in rows] == ["0", "4"]
    assert [row["status"].split(":")[0] for row in rows] == ["failed", "finished"]
    assert "model.channels=0" in rows[0]["status"]
    assert float(rows[1]["psnr"]) > 0
    assert (tmp_path / "table.md").read_text() in done.stdout
    assert "job 0 failed: ConfigError: model.channels=0" in done.stdout
    assert "job 1 finished: psnr" in done.stdout


def swept(folder: Path, **options: Any) -> SweepTable:
    """The callback of a sweep whose jobs are done."""
    runtime, place = {"output_dir": str(folder)}, {"dir": str(folder)}
    hydra = {"mode": RunMode.MULTIRUN, "job": {"num": 3}, "runtime": runtime, "sweep": place}
    callback, settings = SweepTable(**options), OmegaConf.create({"hydra": hydra})
    callback.on_multirun_start(settings)
    callback.on_multirun_end(settings)
    return callback


def test_a_sweep_without_jobs_leaves_no_table(tmp_path, capsys):
    swept(tmp_path)
    assert capsys.readouterr().out == ""
    assert list(tmp_path.iterdir()) == []


def test_the_table_comes_once(tmp_path, capsys):
    (tmp_path / "0").mkdir()
    (tmp_path / "0" / "run.json").write_text(json.dumps({"status": "failed", "reason": "x"}))
    swept(tmp_path)._finish()
    assert capsys.readouterr().out.count("failed: x") == 1


def test_a_sheet_of_any_kind_has_the_name_that_pages_link_to(tmp_path, capsys):
    pictured(tmp_path / "0")
    swept(tmp_path, sheet="steps")
    assert f"wrote {tmp_path / 'sheet.png'}\n" in capsys.readouterr().out
    assert len(areas(tmp_path / "sheet.png")) == 3  # The truth and two steps.


@pytest.mark.parametrize(
    ("visible", "job", "gpu"),
    [("0,1", 0, "0"), ("0,1", 3, "1"), ("4, 6,7", 4, "6"), ("5", 3, None), ("", 1, None)],
)
def test_jobs_take_the_gpus_in_turn(visible, job, gpu):
    environment = {"CUDA_VISIBLE_DEVICES": visible}
    assert choose_gpu(job, environment) == gpu
    assert environment["CUDA_VISIBLE_DEVICES"] == (gpu or visible)
    # The next job of the same process stays there.
    assert choose_gpu(job + 1, environment) is None
