"""Settings and data that a resumed run must share with the original one."""

import json
import re
import shutil
import signal
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from lightning.pytorch.callbacks import Callback

from tests.training.runs import UNSCORED, also, metrics, small_config, status
from xplanes.errors import ConfigError
from xplanes.files import read_rows
from xplanes.process import resume_command
from xplanes.readers.dnerf import BlenderSettings
from xplanes.run import run
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.tools.runs import load_run
from xplanes.training import field_module
from xplanes.training.checkpoints import AtomicCheckpointIO, load_checkpoint
from xplanes.training.module import RadianceModule
from xplanes.training.record import KEPT, RunRecord, require_same_run

FEW = ("trainer.max_steps=6", *UNSCORED)
PAGES = ("config.yaml", "overrides.txt", "metrics.json")


def written(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in PAGES}


@pytest.fixture
def folder(trained_run: Path, tmp_path: Path) -> Path:
    """A finished run of one's own, where `train` looks for it."""
    return Path(shutil.copytree(trained_run, tmp_path / "run"))


@pytest.fixture
def saved(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict]]:
    """Every checkpoint that is written, with the name of its file."""
    noted = []

    def note(_, checkpoint: dict, path: str, **__) -> None:
        noted.append((Path(path).name, checkpoint))

    also(monkeypatch, AtomicCheckpointIO, "save_checkpoint", note)
    return noted


def test_a_run_is_not_resumed_with_other_settings(scenes, folder):
    before = written(folder)
    refused = {
        "model=nine_planes": r"model\.name=nine_planes: .* trained with model\.name=six_planes",
        "model.resolution=16": r"does not fit .*size mismatch for .* the run began with",
        "trainer.max_steps=3": r"max_steps=3: .*has already done 40 steps",
    }
    for override, words in refused.items():
        with pytest.raises(ConfigError, match=words):
            run(small_config(scenes, override), folder, ["seed=0", override], resume=True)
        assert written(folder) == before, override
    # The refusals leave a run that goes on as ever, with what may change.
    more = small_config(scenes, "trainer.max_steps=42", "model.plane_lr=0.01", "data.eval_views=2")
    run(more, folder, ["model.plane_lr=0.01"], resume=True)
    assert (folder / "overrides.txt").read_text() == "model.plane_lr=0.01\n"
    assert (metrics(folder)["step"], len(metrics(folder)["views"])) == (42, 2)


def test_a_run_is_not_resumed_with_other_images(train, folder):
    record = status(folder)
    record["files"]["train"].reverse()
    (folder / "run.json").write_text(json.dumps(record))
    for _ in range(2):  # The first refusal forgets nothing.
        with pytest.raises(
            ConfigError, match=r"was trained on 10 views; .* restore the scene's files"
        ):
            train(resume=True)


def test_the_best_is_chosen_by_the_same_views_throughout(train, monkeypatch, saved):
    """One view is scored on the way, and the others are harder by 10 dB."""
    original = field_module.score_image

    def score(image, item):
        found = original(image, item)
        return replace(found, psnr=found.psnr - 10 * (item["index"] != 0))

    monkeypatch.setattr(field_module, "score_image", score)
    few = ("trainer.limit_val_batches=1", "callbacks.evaluation.at=[0,0.5]", "trainer.max_steps=4")
    folder = train(*few, "callbacks.checkpoints.every=99")
    assert [state["global_step"] for name, state in saved if name == "best.ckpt"] == [2, 4]
    assert len(metrics(folder)["views"]) == 3  # In the end all are looked at.


def test_no_checkpoint_between_the_batches_of_an_update(train, saved):
    """A run that goes on from a checkpoint's step has written none for it yet."""
    every = (*FEW, "trainer.accumulate_grad_batches=4", "callbacks.checkpoints.every=2")
    train(*every, "trainer.max_steps=2")
    saved.clear()
    folder = train(*every, "trainer.max_steps=3", resume=True)
    said = (folder / "train.log").read_text()
    assert re.search(r"resumed  after step 2, \d+ s of training", said)
    batches = [state["progress"]["batches"] for _, state in saved]
    assert batches[-1] == 12
    assert all(count % 4 == 0 for count in batches)


def test_a_signal_after_the_last_step_is_heard(train, tmp_path, monkeypatch):
    press_ctrl_c = lambda _: signal.raise_signal(signal.SIGINT)  # noqa: E731
    also(monkeypatch, RadianceModule, "on_train_end", press_ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        train(*FEW)
    assert status(tmp_path / "run")["status"] == "interrupted"
    monkeypatch.undo()
    assert metrics(train(*FEW, resume=True))["step"] == 6


class Fails(Callback):
    """A user's callback with a fault."""

    def on_train_batch_end(self, trainer, *rest) -> None:
        if trainer.global_step == 3:
            raise RuntimeError("a fault of one's own")


def test_a_fault_of_ones_own_says_how_to_go_on(scenes, train, tmp_path, capsys):
    usual = small_config(scenes, *FEW)["callbacks"]
    fails = usual | {"fails": {"_target_": f"{__name__}.Fails"}}
    with pytest.raises(RuntimeError, match="a fault of one's own"):
        train(*FEW, plugins=[__name__], callbacks=fails)
    assert f"Once that is fixed: {resume_command(tmp_path / 'run')}" in capsys.readouterr().out
    train(*FEW, resume=True)


def test_another_start_in_a_folder_begins_its_own_record(tmp_path):
    first = RunRecord(tmp_path, 0, resume=False)
    first.note(files={"train": ["a.png"]})
    first.content["started"] = "long ago"
    first.end("failed", "no such scene")
    again = RunRecord(tmp_path, 0, resume=True)
    assert (again.content["started"], again.content["resumed"]) == ("long ago", 1)
    assert again.content["files"] == {"train": ["a.png"]}
    again = RunRecord(tmp_path, 0, resume=False)
    assert again.content["started"] != "long ago"
    assert (again.content["resumed"], again.content["total_seconds"]) == (0, 0.0)
    assert "files" not in again.content


def nested(key: str, value: object) -> dict[str, Any]:
    """A configuration that sets this key alone."""
    found = value
    for name in reversed(key.split(".")):
        found = {name: found}
    return found  # type: ignore[return-value]


def test_what_planes_and_frame_depend_on_is_kept(tmp_path):
    def goes_on(before: dict[str, Any], now: dict[str, Any]) -> None:
        (tmp_path / "config.yaml").write_text(yaml.safe_dump(before))
        require_same_run(tmp_path, now, -1)

    for key in KEPT:
        this, that, null = (nested(key, value) for value in ("this", "that", None))
        for before, now in ((this, that), (this, null), (null, this)):
            with pytest.raises(ConfigError, match=rf"{key}="):
                goes_on(before, now)
        with pytest.raises(ConfigError, match=rf"{key}=that: .* {key}=this"):
            goes_on(this, that)
        goes_on(this, this)
        # A setting that an older version did not have.
        for without in (nested(key.rpartition(".")[0], {}) if "." in key else {}, {}):
            goes_on(without, that)


@pytest.mark.parametrize(
    ("views", "missing", "scored"),
    [(10, ("val", "test"), 10), (20, ("val", "test"), 2), (10, ("val",), 3)],
)
def test_a_missing_split_is_held_out_of_training_or_nothing_is_the_best(
    scenes, train, tmp_path, views, missing, scored
):
    usual = small_config(scenes)["data"]
    made = SceneDataModule(usual).settings.folder
    folder = Path(shutil.copytree(made, tmp_path / "scenes" / "few"))
    index = folder / "transforms_train.json"
    listed = json.loads(index.read_text())
    video = json.loads((folder / "transforms_video.json").read_text())["frames"]
    listed["frames"] += video[: views - len(listed["frames"])]
    index.write_text(json.dumps(listed))
    for split in missing:
        (folder / f"transforms_{split}.json").unlink()
    known = {field.name for field in fields(BlenderSettings)}
    data = {name: value for name, value in usual.items() if name in known}
    data |= {"_target_": "xplanes.readers.dnerf.BlenderSettings", "mask_use": "auto"}
    data |= {"root": str(tmp_path / "scenes"), "scene": "few"}
    done = train(*FEW, "trainer.max_steps=1", "callbacks.evaluation.at=[0]", data=data)
    split = "val" if "test" in missing else "test"
    assert (metrics(done)["split"], len(metrics(done)["views"])) == (split, scored)
    assert {row["split"] for row in read_rows(done / "curve.csv")} == {split}
    assert (done / "checkpoints" / "best.ckpt").is_file() == (split == "val")
    log = (done / "train.log").read_text()
    held_out = scored if views == 20 else 0
    assert ("10 images are too few to hold some out" in log) == (scored == 10)
    assert ("(held out of train)" in log) == bool(held_out)
    loaded = load_run(done)
    assert (len(loaded.scene.splits["train"]), loaded.split) == (views - held_out, split)
    if held_out:
        alone = SceneDataModule(data)
        alone.setup("test")
        assert len(alone.scene.splits["val"]) == 2


def test_a_missing_best_checkpoint_is_explained(trained_run, tmp_path):
    with pytest.raises(ConfigError, match="stopped before its first checkpoint"):
        load_checkpoint(tmp_path / "best.ckpt")
    shutil.copy(trained_run / "checkpoints" / "last.ckpt", tmp_path)
    with pytest.raises(ConfigError, match=r"no validation scores.*--checkpoint last"):
        load_checkpoint(tmp_path / "best.ckpt")
