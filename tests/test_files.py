"""Files are written atomically; write errors are reported with a message."""

import errno
import math
import os
from pathlib import Path

import pytest

from xplanes.files import (
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


def begin(path: Path, problem: Exception) -> None:
    """Write half a file, then fail."""
    with replacing(path) as temporary:
        temporary.write_text("ha")
        raise problem


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


def test_a_file_in_the_place_of_a_folder_is_named(tmp_path):
    (tmp_path / "outputs").write_text("")
    with pytest.raises(StorageError, match=r"outputs/run/a\.txt.*file stands where a folder"):
        write_text(tmp_path / "outputs" / "run" / "a.txt", "")
    with pytest.raises(StorageError, match=r"outputs/run cannot.*file stands where a folder"):
        require_writable(tmp_path / "outputs" / "run")


def test_a_folder_that_can_be_written_stays_as_it_is(tmp_path):
    require_writable(tmp_path / "new" / "run")
    assert listed(tmp_path) == []


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
