"""Files are written whole or not at all; what is left, damaged or refused by a disk is reported."""

import errno
import math
import os
import shutil
import time
from pathlib import Path

import pytest
import torch

from tests.training.runs import small_config
from xplanes.errors import ConfigError, SceneError
from xplanes.experiment import Experiment
from xplanes.files import (
    DAY,
    MARK,
    StorageError,
    clear_unfinished,
    existing,
    is_there,
    read_json,
    replacing,
    require_writable,
    storage_errors,
    write_json,
    write_text,
)
from xplanes.launch import prepare
from xplanes.preparation.cache import StageCache
from xplanes.run import run
from xplanes.synthetic.demo import ensure_demo_scene, write
from xplanes.synthetic.pretraining.pool import RECORD, SHARD, ensure_pool
from xplanes.training.checkpoints import LAST


def begin(path: Path, problem: Exception) -> None:
    """Write half a file, then fail."""
    with replacing(path) as temporary:
        temporary.write_text("ha")
        raise problem


def test_a_new_file_has_the_permissions_that_the_umask_leaves(tmp_path):
    before = os.umask(0o077)
    try:
        write_text(tmp_path / "a.json", "whole")
        os.umask(0o002)
        write_text(tmp_path / "b.json", "whole")
    finally:
        os.umask(before)
    if os.name == "posix":
        modes = [oct((tmp_path / name).stat().st_mode & 0o777) for name in ("a.json", "b.json")]
        assert modes == ["0o600", "0o664"]


def listed(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()]


def test_a_block_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.json"
    write_text(path, "whole")
    with pytest.raises(ValueError, match="half"):
        begin(path, ValueError("half"))
    assert path.read_text() == "whole"
    assert listed(tmp_path) == ["a.json"]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, r"No space left.*MB free.*Free some space"),
        (errno.EDQUOT, r"quota.*Free some space"),
        (errno.EFBIG, r"too large.*ulimit -f"),
        (errno.EROFS, r"Read-only.*Choose a folder"),
        (errno.EIO, r"disk or its connection"),
    ],
)
def test_a_disk_that_refuses_is_said_with_a_message(tmp_path, code, words):
    path = tmp_path / "last.ckpt"
    write_text(path, "old")
    with pytest.raises(StorageError, match=rf"last\.ckpt cannot be written.*{words}"):
        begin(path, OSError(code, os.strerror(code)))
    assert path.read_text() == "old"
    assert listed(tmp_path) == ["last.ckpt"]


def test_other_problems_are_not_the_disk_s(tmp_path):
    for problem in (
        ConnectionRefusedError(errno.ECONNREFUSED, "refused"),
        PermissionError(errno.EACCES, "denied", "weights.ckpt"),
    ):
        with pytest.raises(OSError, match=str(problem.strerror)) as caught, storage_errors():
            raise problem
        assert caught.value is problem
    with pytest.raises(OSError, match="power cut") as caught:
        begin(tmp_path / "a", OSError("power cut"))
    assert not isinstance(caught.value, StorageError)


def test_a_file_in_the_place_of_a_folder_is_named_and_looking_for_one_makes_nothing(tmp_path):
    (tmp_path / "outputs").write_text("")
    with pytest.raises(StorageError, match=r"outputs/run/a\.txt.*file is in the place of a folder"):
        write_text(tmp_path / "outputs" / "run" / "a.txt", "")
    with pytest.raises(StorageError, match=r"outputs/run cannot.*file is in the place of a folder"):
        require_writable(tmp_path / "outputs" / "run")
    require_writable(tmp_path / "new" / "run")
    assert listed(tmp_path) == ["outputs"]


def test_numbers_that_json_does_not_know_become_null(tmp_path):
    path = tmp_path / "metrics.json"
    write_json(path, {"ssim": math.nan, "views": [{"psnr": math.inf}, 1.5, None, "nan"]})
    assert read_json(path) == {"ssim": None, "views": [{"psnr": None}, 1.5, None, "nan"]}


def test_only_unfinished_files_are_cleared(tmp_path):
    kept = tmp_path / "checkpoints" / "last.ckpt"
    write_text(kept, "whole")
    hidden = tmp_path / ".lock"
    hidden.write_text("")
    writer = replacing(kept)
    left = writer.__enter__()
    left.write_text("ha")
    clear_unfinished(tmp_path, older_than=3600.0)
    assert left.exists()
    clear_unfinished(tmp_path)
    assert not left.exists()
    assert kept.read_text() == "whole"
    assert hidden.exists()


def test_what_lies_in_a_folder_that_cannot_be_entered_is_missing(tmp_path, monkeypatch):
    inner = tmp_path / "locked" / "cache"
    exists = Path.exists

    def refuse(path, **options):
        if "locked" in path.parts[:-1]:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return exists(path, **options)

    (tmp_path / "locked").mkdir()
    monkeypatch.setattr(Path, "exists", refuse)
    assert existing(inner) == tmp_path / "locked"
    require_writable(inner)
    assert not is_there(inner)


# Leftovers of killed processes are removed; damaged files are named


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
