"""Settings and data that a resumed run must share with the original one."""

import json
import shutil
import signal
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from lightning.pytorch.callbacks import Callback

from tests.training.runs import small_config
from xplanes.errors import ConfigError
from xplanes.files import read_rows
from xplanes.process import resume_command
from xplanes.run import run
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.dnerf import BlenderSettings
from xplanes.tools.runs import load_run
from xplanes.training import scores
from xplanes.training.checkpoints import AtomicCheckpointIO
from xplanes.training.module import RadianceModule
from xplanes.training.record import KEPT, RunRecord, require_same_run

FEW = ("trainer.max_steps=6", "callbacks.evaluation.at=[]")
PAGES = ("config.yaml", "overrides.txt", "metrics.json")


@pytest.fixture(scope="module")
def trained(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "whole"
    run(small_config(scenes, *FEW), folder, ["seed=0"], resume=False)
    return folder


@pytest.fixture
def folder(trained: Path, tmp_path: Path) -> Path:
    """A finished run of one's own."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def note_checkpoints(written: list[tuple[str, dict]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Note every checkpoint that is written, by the name of its file."""
    save = AtomicCheckpointIO.save_checkpoint

    def note(self, checkpoint: dict, path: str, **options) -> None:
        written.append((Path(path).name, checkpoint))
        save(self, checkpoint, path, **options)

    monkeypatch.setattr(AtomicCheckpointIO, "save_checkpoint", note)


def test_a_run_is_not_resumed_with_other_settings(scenes, folder):
    before = {name: (folder / name).read_bytes() for name in PAGES}
    refused = {
        "model=nine_planes": r"model\.name=nine_planes: .* trained with model\.name=six_planes",
        "model.resolution=16": r"does not fit .*size mismatch for .* the run began with",
    }
    for override, words in refused.items():
        changed = small_config(scenes, *FEW, override)
        with pytest.raises(ConfigError, match=words):
            run(changed, folder, ["seed=0", override], resume=True)
        assert {name: (folder / name).read_bytes() for name in PAGES} == before, override
    # The refusals leave a run that goes on as ever, with what may change.
    more = small_config(scenes, "trainer.max_steps=8", "model.plane_lr=0.01", "data.eval_views=2")
    run(more, folder, ["model.plane_lr=0.01"], resume=True)
    assert (folder / "overrides.txt").read_text() == "model.plane_lr=0.01\n"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert (metrics["step"], len(metrics["views"])) == (8, 2)


def test_a_run_is_not_resumed_with_other_images(scenes, folder):
    record = json.loads((folder / "run.json").read_text())
    record["files"]["train"].reverse()
    (folder / "run.json").write_text(json.dumps(record))
    for _ in range(2):  # The first refusal forgets nothing.
        with pytest.raises(ConfigError, match=r"trained on 10 views, .* restore the scene's files"):
            run(small_config(scenes, *FEW), folder, [], resume=True)


def test_the_best_is_chosen_by_the_same_views_throughout(scenes, tmp_path, monkeypatch):
    """One view is scored on the way, and the others are harder by 10 dB."""
    original = scores.score_image
    improved: list[tuple[str, dict]] = []

    def score(image, item):
        found = original(image, item)
        return replace(found, psnr=found.psnr - 10 * (item["index"] != 0))

    monkeypatch.setattr(scores, "score_image", score)
    note_checkpoints(improved, monkeypatch)
    few = (
        "trainer.limit_val_batches=1",
        "callbacks.evaluation.at=[0,0.5]",
        "callbacks.checkpoints.every=99",
    )
    run(small_config(scenes, *few), tmp_path / "run", [], resume=False)
    assert [state["global_step"] for name, state in improved if name == "best.ckpt"] == [20, 40]
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert len(metrics["views"]) == 3  # In the end all are looked at.


def test_no_checkpoint_between_the_batches_of_an_update(scenes, tmp_path, monkeypatch):
    """A run that goes on from a checkpoint's step has written none for it yet."""
    written: list[tuple[str, dict]] = []
    every = (*FEW, "trainer.accumulate_grad_batches=4", "callbacks.checkpoints.every=2")
    folder = tmp_path / "run"
    run(small_config(scenes, *every, "trainer.max_steps=2"), folder, [], resume=False)
    note_checkpoints(written, monkeypatch)
    run(small_config(scenes, *every, "trainer.max_steps=3"), folder, [], resume=True)
    assert "resumed  after step 2, 0 s of training" in (folder / "train.log").read_text()
    batches = [state["progress"]["batches"] for _, state in written]
    assert batches[-1] == 12
    assert all(count % 4 == 0 for count in batches)


def test_a_signal_after_the_last_step_is_heard(scenes, tmp_path, monkeypatch):
    finish = RadianceModule.on_train_end

    def press_ctrl_c(self) -> None:
        finish(self)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(RadianceModule, "on_train_end", press_ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        run(small_config(scenes, *FEW), tmp_path / "run", [], resume=False)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "interrupted"
    monkeypatch.undo()
    run(small_config(scenes, *FEW), tmp_path / "run", [], resume=True)
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["step"] == 6


class Fails(Callback):
    """A user's callback with a fault."""

    def on_train_batch_end(self, trainer, *rest) -> None:
        if trainer.global_step == 3:
            raise RuntimeError("a fault of one's own")


def test_a_fault_of_ones_own_says_how_to_go_on(scenes, tmp_path, capsys):
    config = small_config(scenes, *FEW, "media=false", "lrm=none", "trainer.max_steps=5")
    config["callbacks"] |= {"fails": {"_target_": f"{__name__}.Fails"}}
    config["plugins"] = [__name__]
    with pytest.raises(RuntimeError, match="a fault of one's own"):
        run(config, tmp_path / "run", [], resume=False)
    assert f"Once that is fixed: {resume_command(tmp_path / 'run')}" in capsys.readouterr().out
    config["callbacks"].pop("fails")
    run(config, tmp_path / "run", [], resume=True)


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


def test_a_limit_that_a_run_has_passed_is_refused(scenes, folder):
    before = (folder / "config.yaml").read_bytes()
    with pytest.raises(ConfigError, match=r"max_steps=3: .*has done 6 steps already"):
        run(small_config(scenes, *FEW, "trainer.max_steps=3"), folder, [], resume=True)
    assert (folder / "config.yaml").read_bytes() == before


@pytest.mark.parametrize(
    ("views", "missing", "scored"),
    [(10, ("val", "test"), 10), (20, ("val", "test"), 2), (10, ("val",), 3)],
)
def test_a_missing_split_is_held_out_of_training_or_nothing_is_the_best(
    scenes, tmp_path, views, missing, scored
):
    demo = small_config(scenes, *FEW, "callbacks.evaluation.at=[0]")
    made = SceneDataModule(demo["data"])
    folder = Path(shutil.copytree(made.settings.folder, tmp_path / "scenes" / "few"))
    index = folder / "transforms_train.json"
    train = json.loads(index.read_text())
    video = json.loads((folder / "transforms_video.json").read_text())["frames"]
    train["frames"] += video[: views - len(train["frames"])]
    index.write_text(json.dumps(train))
    for split in missing:
        (folder / f"transforms_{split}.json").unlink()
    known = {field.name for field in fields(BlenderSettings)}
    data = {name: value for name, value in demo["data"].items() if name in known}
    target = "xplanes.scenes.dnerf.BlenderSettings"
    data |= {"_target_": target, "root": str(tmp_path / "scenes"), "scene": "few"}
    data["mask_use"] = "auto"
    done = tmp_path / "run"
    run(demo | {"data": data}, done, [], resume=False)
    metrics = json.loads((done / "metrics.json").read_text())
    split = "val" if "test" in missing else "test"
    assert (metrics["split"], len(metrics["views"])) == (split, scored)
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
