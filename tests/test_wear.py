"""Leftovers of killed processes are removed; damaged files are reported with a message."""

import os
import shutil
import time
from pathlib import Path

import pytest
import torch

from tests.training.runs import small_config
from xplanes.errors import ConfigError, SceneError
from xplanes.experiment import Experiment
from xplanes.files import DAY, MARK, StorageError
from xplanes.launch import prepare
from xplanes.preparation.cache import StageCache
from xplanes.run import run
from xplanes.synthetic.demo import ensure_demo_scene, write
from xplanes.synthetic.pretraining.pool import RECORD, SHARD, ensure_pool
from xplanes.training.checkpoints import LAST


def aged(path: Path) -> Path:
    past = time.time() - 2 * DAY
    os.utime(path, (past, past))
    return path


def test_the_cache_clears_what_is_a_day_old(tmp_path):
    old, new = (tmp_path / f".parts-{age}.pt{MARK}x.pt" for age in ("old", "new"))
    old.write_bytes(b"half")
    new.write_bytes(b"half")
    aged(old)
    StageCache(tmp_path).stage("parts", [1], lambda: {"planes": torch.zeros(2)})
    assert (old.exists(), new.exists()) == (False, True)


def test_rendering_a_scene_clears_what_is_a_day_old(tmp_path, monkeypatch):
    monkeypatch.setattr(write, "VIDEO_FRAMES", 2)
    small = {"resolution": 8, "train_views": 1, "val_views": 1, "test_views": 1}
    folder = ensure_demo_scene(tmp_path, "balls", **small)
    shutil.rmtree(folder)
    old, new = (tmp_path / f".{folder.name}.{number}.0a" for number in (1, 2))
    old.mkdir()
    new.mkdir()
    aged(old)
    ensure_demo_scene(tmp_path, "balls", **small)
    assert (old.exists(), new.exists(), folder.exists()) == (False, True, True)


def test_a_damaged_demo_scene_says_to_delete_it(scenes, tmp_path):
    made = Experiment.read(small_config(scenes)).data.folder
    shutil.copytree(made, tmp_path / made.name)
    data = Experiment.read(small_config(tmp_path)).data
    picture = tmp_path / made.name / "train" / "r_003.png"
    picture.write_bytes(picture.read_bytes()[:50])
    with pytest.raises(SceneError, match=r"r_003\.png.*demo scene: delete .* to render it again"):
        data.read()


def test_a_damaged_record_of_a_pool_is_named(tmp_path):
    (tmp_path / RECORD).write_text('{"version": 1,')
    with pytest.raises(ConfigError, match=r"pool\.json is damaged.*delete it"):
        ensure_pool(tmp_path, range(SHARD), views=1, side=4)


def test_no_place_for_the_output_is_said_before_anything_is_loaded(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"file/run cannot be written: Not a directory"):
        prepare([f"hydra.run.dir={tmp_path / 'file' / 'run'}"])


def test_overrides_that_were_cut_short_are_not_taken_for_whole(tmp_path):
    path = tmp_path / "overrides.txt"
    path.write_text("seed=3\ntrainer.max_steps=400")
    with pytest.raises(ConfigError, match=r"overrides\.txt is damaged.*config\.yaml"):
        prepare([f"resume={tmp_path}"])
    path.write_text("seed=3\ntrainer.max_steps=400\n")
    assert "trainer.max_steps=400" in prepare([f"resume={tmp_path}"])


def test_a_disk_that_fills_up_ends_a_run_with_a_message(scenes, tmp_path, monkeypatch, capsys):
    from lightning import Trainer

    original = Trainer.save_checkpoint

    def fill_up(self, path, *rest, **more) -> None:
        if self.global_step == 30:
            raise OSError(28, "No space left on device", str(path))
        original(self, path, *rest, **more)

    monkeypatch.setattr(Trainer, "save_checkpoint", fill_up)
    folder = tmp_path / "run"
    config = small_config(scenes, "callbacks.evaluation.at=[]")
    with pytest.raises(StorageError, match=r"last\.ckpt cannot be written.*Free some space"):
        run(config, folder, [], resume=False)
    assert f"resume={folder}" in capsys.readouterr().out
    state = torch.load(folder / "checkpoints" / LAST, weights_only=True)
    assert state["global_step"] == 20
