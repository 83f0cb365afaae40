"""Truncated or altered files: detected, then recomputed or refused with a message."""

import os
import shutil
import signal
import time
import zipfile
from contextlib import suppress
from pathlib import Path

import pytest
import torch

from tests.faults.conftest import config_of, outcome
from tests.lrm.reduced import CONFIGS
from xplanes.errors import ConfigError, SceneError
from xplanes.lrm import LRMError, load
from xplanes.lrm.bundled import FOLDER, load_bundled
from xplanes.preparation.sequence import TriplaneSequence, load_triplanes, save_triplanes
from xplanes.run import run
from xplanes.synthetic.pretraining.pool import SHARD, ensure_pool
from xplanes.training.checkpoints import load_checkpoint

pytestmark = pytest.mark.stress

CUTS = (0.0, 0.1, 0.5, 0.99)


def cut(path: Path, share: float) -> None:
    """Keep the first part of a file."""
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])


def flip(path: Path, share: float) -> None:
    """Change one bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[int(share * len(content))] ^= 16
    path.write_bytes(bytes(content))


def middle_of_largest(path: Path) -> float:
    """Where in an archive, as a share of it, its largest record lies: between them is padding."""
    with zipfile.ZipFile(path) as archive:
        record = max(archive.infolist(), key=lambda record: record.file_size)
    return (record.header_offset + 0.5 * record.file_size) / path.stat().st_size


@pytest.fixture(scope="module")
def half(nursery, shared, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was killed after 24 of its 40 steps."""
    folder = tmp_path_factory.mktemp("half") / "run"
    child = nursery.start(config_of(shared, "none", None), folder, resume=False)
    last = folder / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 60
    while not last.is_file() or load_checkpoint(last)["global_step"] < 24:
        assert time.monotonic() < deadline, child.output()
        time.sleep(0.005)
    with suppress(ProcessLookupError):
        os.kill(child.pid, signal.SIGKILL)
    child.finish()
    assert load_checkpoint(folder / "checkpoints" / "best.ckpt")["global_step"] == 20
    return folder


@pytest.mark.parametrize("share", [*CUTS, 0.3])
def test_checkpoint(tally, nursery, shared, whole, half, tmp_path: Path, share: float) -> None:
    """last.ckpt cut short or with a changed bit"""
    folder = tmp_path / "run"
    shutil.copytree(half, folder)
    last = folder / "checkpoints" / "last.ckpt"
    if share == 0.3:
        flip(last, middle_of_largest(last))
    else:
        cut(last, share)
    child = nursery.run(config_of(shared, "none", None), folder, resume=True)
    tally.said(child.output(), "last.ckpt cannot be read", "damaged", "Continuing from")
    assert outcome(folder) == whole["none"]
    tally.recovered()


def test_all_checkpoints(tally, nursery, shared, half, tmp_path: Path) -> None:
    """last.ckpt and best.ckpt cut short"""
    folder = tmp_path / "run"
    shutil.copytree(half, folder)
    for name in ("last", "best"):
        cut(folder / "checkpoints" / f"{name}.ckpt", 0.5)
    child = nursery.start(config_of(shared, "none", None), folder, resume=True)
    assert child.finish() == 1
    tally.said(child.output().split("error: ")[-1], "cannot be read", "delete", "start again")
    tally.content["cases"] += 1


@pytest.mark.parametrize("name", ["run.json", "config.yaml", "curve.csv"])
def test_small_files(tally, nursery, shared, whole, half, tmp_path: Path, name: str) -> None:
    """run.json, config.yaml, curve.csv cut short"""
    folder = tmp_path / "run"
    shutil.copytree(half, folder)
    cut(folder / name, 0.6)
    child = nursery.run(config_of(shared, "none", None), folder, resume=True)
    found = outcome(folder)
    if name == "run.json":
        tally.said(child.output(), "run.json is damaged")
    if name == "curve.csv":
        del found["curve"]
    assert found == {key: whole["none"][key] for key in found}
    tally.recovered()


@pytest.mark.parametrize("change", [cut, flip])
def test_preparation_cache(tally, nursery, shared, whole, tmp_path: Path, change) -> None:
    """Preparation cache: all entries cut short or with a changed bit"""
    config = config_of(shared, "tiny", tmp_path / "cache")
    nursery.run(config, tmp_path / "first", resume=False)
    entries = list((tmp_path / "cache").glob("*.pt"))
    assert len(entries) > 5
    for path in entries:
        change(path, 0.6)
    child = nursery.run(config, tmp_path / "second", resume=False)
    assert child.output().count("making it again") >= len(entries) - 1
    tally.said(child.output(), "damaged")
    assert outcome(tmp_path / "second") == whole["tiny"]
    tally.recovered()


@pytest.mark.parametrize("share", CUTS)
def test_weights(tally, tmp_path: Path, share: float) -> None:
    """Weights cut short: of the package, of a checkpoint, of a triplane file"""
    for path in FOLDER.glob("tiny.*"):
        shutil.copy(path, tmp_path)
    cut(tmp_path / "tiny.safetensors", share)
    with pytest.raises(LRMError) as caught:
        load_bundled("tiny", tmp_path)
    tally.said(str(caught.value), "tiny.safetensors is damaged", "reinstall the package")
    for name in ("model.safetensors", "model.ckpt"):
        path = tmp_path / name
        if name.endswith("ckpt"):
            torch.save({"weights": {"a": torch.rand(500)}}, path)
        else:
            shutil.copy(FOLDER / "tiny.safetensors", path)
        cut(path, share)
        with pytest.raises(LRMError) as caught:
            load(CONFIGS["triposr"], path)
        tally.said(str(caught.value), name)
    for name in ("initial.pt", "initial.safetensors"):
        save_triplanes(tmp_path / name, TriplaneSequence(torch.rand(2, 3, 2, 4, 4)))
        cut(tmp_path / name, share)
        with pytest.raises(ConfigError) as error:
            load_triplanes(tmp_path / name)
        tally.said(str(error.value), name, "damaged")
    tally.content["cases"] += 1


@pytest.mark.parametrize("change", [cut, flip])
def test_pool(tally, tmp_path: Path, change) -> None:
    """Pool of objects: a shard cut short or changed, its record cut short"""
    made: list[str] = []

    def pool():
        found = ensure_pool(tmp_path, range(SHARD), views=1, side=4, announce=made.append)
        return [record.tobytes() for record in found.shards[0]]

    before = pool()
    change(tmp_path / "00000.npy", 0.6)
    assert pool() == before
    assert len(made) == 2
    cut(tmp_path / "pool.json", 0.5)
    with pytest.raises(ConfigError) as caught:
        pool()
    tally.said(str(caught.value), "pool.json is damaged", "delete")
    (tmp_path / "pool.json").unlink()
    assert pool() == before
    tally.recovered()


@pytest.mark.parametrize("name", ["train/r_003.png", "transforms_train.json", "demo.json"])
def test_scene(tally, shared, whole, nursery, tmp_path: Path, name: str) -> None:
    """A demo scene's files cut short"""
    (scene,) = (path for path in (shared / "scenes").iterdir() if not path.name.startswith("."))
    copy = tmp_path / "scenes" / scene.name
    shutil.copytree(scene, copy)
    cut(copy / name, 0.5)
    config = config_of(tmp_path, "none", None)
    if name != "demo.json":
        with pytest.raises(SceneError) as caught:
            run(config, tmp_path / "refused", [], resume=False)
        tally.said(str(caught.value), Path(name).name, "delete")
        shutil.rmtree(copy)
    nursery.run(config, tmp_path / "run", resume=False)
    assert outcome(tmp_path / "run") == whole["none"]
    tally.recovered()
