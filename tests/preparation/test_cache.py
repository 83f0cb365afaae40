"""The cache of stages: entries are reused, damaged ones never."""

import logging
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from tests.refusals import Evil, flip
from xplanes.backend import warm_up
from xplanes.files import StorageError
from xplanes.preparation import cache as cache_module
from xplanes.preparation.cache import StageCache, fingerprint

INPUTS = [torch.arange(6.0), {"weight": "auto", "limit": 3}]


class Maker:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return {"planes": torch.arange(64.0).view(4, 16), "report": {"rank": 2, "x": 0.1 + 0.2}}


def entry(folder: Path) -> Path:
    (path,) = folder.glob("parts-*.pt")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    StageCache(tmp_path).stage("parts", INPUTS, Maker())
    return tmp_path


def test_a_stage_is_computed_once_and_loaded_unchanged(folder):
    make = Maker()
    stage = StageCache(folder).stage("parts", INPUTS, make)
    assert (make.calls, stage.cached) == (0, True)
    fresh = make()
    assert torch.equal(stage.content["planes"], fresh["planes"])
    assert stage.content["report"] == fresh["report"]


def test_who_waits_for_another_process_takes_what_it_has_made(tmp_path, monkeypatch):
    @contextmanager
    def waiting(_):
        monkeypatch.undo()
        StageCache(tmp_path).stage("parts", INPUTS, Maker())
        yield

    monkeypatch.setattr(cache_module, "in_turn", waiting)
    make = Maker()
    assert StageCache(tmp_path).stage("parts", INPUTS, make, alone=True).cached
    assert make.calls == 0


def test_compiling_is_no_part_of_a_stages_time(folder, monkeypatch):
    def make():
        with warm_up.timed():
            return {}

    before, clock = warm_up.seconds, iter([0.0, 10.0, 40.0, 45.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    assert StageCache(folder).stage("video", [1], make).seconds == pytest.approx(15)
    assert warm_up.seconds - before == pytest.approx(30)


def test_other_inputs_or_another_name_are_another_stage(folder):
    for name, inputs in (("parts", [INPUTS[0], {"weight": "auto"}]), ("planes", INPUTS)):
        assert not StageCache(folder).stage(name, inputs, Maker()).cached, name


def damaged(path: Path, kind: str) -> None:
    whole = path.read_bytes()
    if kind == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "flipped":
        # A byte of the tensor itself, which torch reads without a murmur.
        flip(path, whole.index(torch.arange(64.0).numpy().tobytes()) + 101)
    elif kind == "foreign":
        torch.save(torch.zeros(3), path)
    elif kind == "code":
        torch.save({"version": cache_module.VERSION, "content": Evil()}, path)
    else:
        payload = torch.load(path, weights_only=True)
        if kind == "version":
            payload["version"] += 1
        elif kind == "report":
            payload["content"]["report"]["rank"] = 3
        elif kind == "key":
            payload["key"] = "0" * 64
        else:
            del payload[kind]
        torch.save(payload, path)


DAMAGES = "truncated empty flipped foreign code version report key checksum content seconds".split()


@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_entries_are_reported_and_recomputed(folder, caplog, capsys, kind):
    damaged(entry(folder), kind)
    make = Maker()
    with caplog.at_level(logging.WARNING):
        stage = StageCache(folder).stage("parts", INPUTS, make)
    assert (make.calls, stage.cached) == (1, False)
    assert str(entry(folder)) in caplog.text
    assert torch.equal(stage.content["planes"], make()["planes"])
    assert StageCache(folder).stage("parts", INPUTS, Maker()).cached
    assert capsys.readouterr().out == ""


def test_a_disabled_cache_stores_nothing(tmp_path):
    make = Maker()
    for _ in range(2):
        StageCache(None).stage("parts", INPUTS, make)
        StageCache(tmp_path).stage("parts", INPUTS, make, keep=False)
    assert make.calls == 4
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_disables_the_cache_only(tmp_path, caplog):
    (tmp_path / "file").write_text("")
    with caplog.at_level(logging.WARNING):
        stage = StageCache(tmp_path / "file").stage("parts", INPUTS, Maker())
    assert stage.content["report"]["rank"] == 2
    assert "cannot be written: stages are not cached" in caplog.text


def test_an_entry_that_cannot_be_written_is_not_cached(tmp_path, caplog, monkeypatch):
    def refuse(*_args) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", refuse)
    stage = StageCache(tmp_path).stage("parts", INPUTS, Maker())
    assert stage.content["report"]["rank"] == 2
    assert "could not be written" in caplog.text
    assert not list(tmp_path.iterdir())


def test_fingerprints_tell_nesting_kinds_and_tensors_apart():
    values = [1, 1.0, True, "1", None, [], [1], [[1]], [1, 1], {"a": 1}, {"a": [1]}, "a", ["a", 1]]
    tensor = torch.arange(6.0)
    values += [{"a": 2}, tensor, tensor + 1e-7, tensor.double(), tensor.view(2, 3), [tensor]]
    assert len({fingerprint(value) for value in values}) == len(values)
    with pytest.raises(TypeError, match="set"):
        fingerprint([{1, 2}])


def test_fingerprints_do_not_depend_on_layout():
    tensor = torch.randn(4, 6)
    assert fingerprint(tensor.mT) == fingerprint(tensor.mT.contiguous())
    assert fingerprint(tensor.bfloat16()) == fingerprint(tensor.bfloat16().clone())


def test_a_folder_that_takes_no_files_is_read_and_not_written(folder, monkeypatch, caplog):
    def refuse(place: Path) -> None:
        raise StorageError(f"{place} cannot be written: Read-only file system")

    before = sorted(folder.iterdir())
    monkeypatch.setattr(cache_module, "require_writable", refuse)
    cache, make = StageCache(folder), Maker()
    assert "cannot be written: stages are not cached" in caplog.text
    assert cache.stage("parts", INPUTS, make, alone=True).cached
    assert not cache.stage("others", INPUTS, make, alone=True).cached
    cache.keep("more", INPUTS, make(), 1.0)
    with cache.workshop("others", INPUTS) as work:
        assert work.is_dir()
        assert folder not in work.parents
    assert sorted(folder.iterdir()) == before
