"""Full, limited or read-only disks: reported with a message, without loss of complete files."""

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.faults.conftest import config_of
from xplanes.files import StorageError
from xplanes.launch import prepare
from xplanes.training.checkpoints import load_checkpoint

pytestmark = pytest.mark.stress

KILOBYTE = 1024


@contextmanager
def small_disk(place: Path, kilobytes: int) -> Iterator[Callable[[str], None]]:
    """A disk of its own at ``place``; gives what changes its options."""
    place.mkdir()
    made = mount("-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(place))
    if made.returncode:
        pytest.skip(f"no disk can be mounted here: {made.stderr.strip()}")

    def change(options: str) -> None:
        assert mount("-o", f"remount,{options}", str(place)).returncode == 0

    try:
        yield change
    finally:
        subprocess.run(["umount", str(place)], check=True)


def mount(*arguments: str) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            ["mount", *arguments], capture_output=True, text=True, timeout=10, check=False
        )
    except OSError as problem:
        return subprocess.CompletedProcess(arguments, 1, "", str(problem))


@pytest.mark.parametrize("kilobytes", [64, 200, 500, 900, 1300, 1700])
def test_full_disk(tally, recovered, nursery, shared, tmp_path, kilobytes):
    """Disk full, from the first file to the last checkpoint"""
    config = config_of(shared, "none", None)
    folder = tmp_path / "disk" / "run"
    with small_disk(tmp_path / "disk", kilobytes) as change:
        child = nursery.start(config, folder, resume=False)
        assert child.finish() == 1, child.output()
        error = child.output().split("error: ")[-1]
        tally.said(error, "cannot be written", "No space left", "Free some space")
        last = folder / "checkpoints" / "last.ckpt"
        assert not last.is_file() or load_checkpoint(last)["global_step"] % 3 == 0
        change("size=64m")
        recovered(folder, config=config)


@pytest.mark.parametrize("kilobytes", [1, 20, 200, 600])
def test_limited_files(tally, recovered, nursery, shared, tmp_path, kilobytes):
    """Limit on the size of files (ulimit -f)"""
    config = config_of(shared, "none", None)
    folder = tmp_path / "run"
    limit = kilobytes * KILOBYTE
    child = nursery.start(config, folder, resume=False, file_limit=limit)
    assert child.finish() == 1, child.output()
    error = child.output().split("error: ")[-1]
    tally.said(error, "cannot be written", "ulimit -f")
    recovered(folder, config=config)


@pytest.mark.parametrize("what", ["scenes", "cache"])
def test_full_disk_elsewhere(tally, recovered, nursery, shared, tmp_path, what):
    """Disk full below data.root or preparation.cache"""
    folder, disk = tmp_path / "run", tmp_path / "disk"
    with small_disk(disk, 40) as change:
        if what == "scenes":
            lrm, config = "none", config_of(disk, "none", None)
            child = nursery.start(config, folder, resume=False)
            assert child.finish() == 1, child.output()
            tally.said(child.output().split("error: ")[-1], "cannot be written", "No space left")
            change("size=64m")
            recovered(folder, lrm, config=config)
        else:
            # Finished stages are merely not kept.
            lrm, config = "tiny", config_of(shared, "tiny", disk / "cache")
            child = nursery.run(config, folder, resume=False)
            tally.said(child.output(), "cannot be written: stages are not cached")
            assert not list(disk.iterdir())
            recovered(folder, lrm)


def test_log_on_a_full_device(tally, recovered, nursery, shared, tmp_path):
    """A log that cannot take a line (/dev/full)"""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "train.log").symlink_to("/dev/full")
    child = nursery.run(config_of(shared, "none", None), folder, resume=False)
    tally.said(child.output(), "psnr")
    recovered(folder)


def test_read_only(tally, recovered, nursery, shared, tmp_path):
    """Read-only output directory, or a file in its place"""
    disk = tmp_path / "disk"
    config = config_of(shared, "none", None)
    with small_disk(disk, 64 * KILOBYTE) as change:
        change("ro")
        with pytest.raises(StorageError) as caught:
            prepare([f"hydra.run.dir={disk / 'run'}"])
        tally.said(str(caught.value), "Read-only", "Choose a folder")
        child = nursery.start(config, disk / "run", resume=False)
        assert child.finish() == 1
        tally.said(child.output(), "Read-only", "Choose a folder")
        assert os.listdir(disk) == []  # noqa: PTH208
        change("rw")
        recovered(disk / "run", config=config)
    (tmp_path / "file").write_text("kept")
    with pytest.raises(StorageError) as caught:
        prepare([f"hydra.run.dir={tmp_path / 'file' / 'run'}"])
    tally.said(str(caught.value), "file is in the place of a folder")
    assert (tmp_path / "file").read_text() == "kept"
