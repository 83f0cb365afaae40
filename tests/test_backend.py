"""The compiled loops agree with torch on the number of threads, and may be absent."""

import os
import shutil
import time
from pathlib import Path
from unittest.mock import Mock

import pytest

from tests.training.runs import SMALL
from tests.warm import ROOT, forked, python
from xplanes import backend
from xplanes.backend import COMPILING, WarmUp

COMPOSITE = """
import torch
from xplanes import backend
from xplanes.rendering.compositing import composite
nothing = torch.zeros(4, dtype=torch.long)
total, _ = composite(torch.rand(4), torch.rand(4, 3), torch.rand(4), nothing, nothing[:1])
assert total.isfinite().all()
print(backend.name(torch.device("cpu")))
"""

COUNT = f"""
torch.set_num_threads({{count}})
{COMPOSITE}
import numba
print(torch.get_num_threads(), numba.get_num_threads(), numba.config.NUMBA_NUM_THREADS)
"""

FALLBACK = f"""
sys.path.insert(0, {{place!r}})
{COMPOSITE}
try:
    import xplanes.fields.lookup_triton
    print("loaded")
except ModuleNotFoundError as error:
    print(error.name)
"""


@pytest.mark.slow
def test_loops_share_the_threads_of_torch_and_may_be_absent(tmp_path):
    broken = tmp_path / "broken"
    (broken / "numba").mkdir(parents=True)
    (broken / "numba" / "__init__.py").write_text("raise ImportError('Numba needs NumPy 0.1')")
    codes = [COUNT.format(count=1), COUNT.format(count=2), FALLBACK.format(place=str(broken))]
    *counted, (code, printed) = forked("import torch", codes, tmp_path)
    for count, (_, said) in zip((1, 2), counted, strict=True):
        torchs, loops, cores = map(int, said.splitlines()[-1].split())
        assert torchs == count
        assert loops == min(count, cores)
    assert code == 0, printed
    # Kernels for GPUs have no need of numba.
    kind, kernels = [line for line in printed.splitlines() if " " not in line]
    assert (kind, kernels) in (("torch", "loaded"), ("torch", "triton"))
    assert "numba cannot be imported (Numba needs NumPy 0.1)" in printed
    assert "pip install --upgrade numba" in printed


def test_warming_up_inside_warming_up_counts_once(monkeypatch):
    monkeypatch.setattr(time, "perf_counter", Mock(side_effect=[1.0, 3.0, 5.0, 5.5]))
    clock = WarmUp()
    for total in (2.0, 2.5):
        with clock.timed(), clock.timed():
            pass
        assert clock.seconds == total


SEALED = f"""
import importlib, sys
from pathlib import Path
import xplanes
assert Path(xplanes.__file__).parent == Path(sys.argv[1])
{COMPOSITE}
wings = ["baselines.gaussians.rasteriser_numba", "baselines.products_numba"]
wings.append("synthetic.pretraining.solids_numba")
for name in ("fields.lookup_numba", "rendering.rays_numba", *wings):
    importlib.import_module("xplanes." + name)
"""


@pytest.fixture
def sealed(tmp_path: Path) -> tuple[Path, dict[str, str]]:
    """A package that numba can keep nothing in, and an environment without a folder to write to."""
    package = tmp_path / "site" / "xplanes"
    shutil.copytree(ROOT / "xplanes", package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "conf", package.parent / "conf")
    for folder in (package, *(path for path in package.rglob("*") if path.is_dir())):
        (folder / "__pycache__").write_text("a file")
    file = tmp_path / "file"
    file.write_text("")
    # Permissions do not stop root: nothing can be created below a file, whoever asks.
    names = ("HOME", "NUMBA_CACHE_DIR", "TRITON_CACHE_DIR", "MPLCONFIGDIR", "XDG_CACHE_HOME")
    others = {"PYTHONPATH": str(package.parent), "PYTHONDONTWRITEBYTECODE": "1"}
    return package, os.environ | {name: f"{file}/{name}" for name in names} | others


@pytest.mark.slow
def test_loops_are_kept_where_they_can_be_and_run_where_they_cannot(sealed, tmp_path):
    package, environment = sealed
    done = python("-c", SEALED, str(package), cwd=tmp_path, env=environment)
    assert done.stdout == "compiled loops\n"
    said = [line for line in done.stderr.splitlines() if "numba" in line]
    assert len(said) == 1, done.stderr
    assert f"compiled again at every start, which takes about {COMPILING} s" in said[0]
    assert "NUMBA_CACHE_DIR=FOLDER" in said[0]
    environment |= {"NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    done = python("-c", SEALED, str(package), cwd=tmp_path, env=environment)
    assert "numba" not in done.stderr
    assert list((tmp_path / "kept").rglob("*.nbi"))


@pytest.mark.slow
def test_a_run_needs_no_folder_but_its_own(sealed, tmp_path):
    place, data = tmp_path / "place", tmp_path / "data"
    place.mkdir()
    given = [*SMALL, "lrm=tiny", f"data.root={data}", f"preparation.cache={tmp_path}/file/cache"]
    before = set(tmp_path.rglob("*"))
    command = ("-m", "xplanes", "train", *given, "hydra.run.dir=run")
    done = python(*command, cwd=place, env=sealed[1])
    assert "Traceback" not in done.stderr
    assert "NUMBA_CACHE_DIR=FOLDER" in (place / "run" / "train.log").read_text()
    for path in set(tmp_path.rglob("*")) - before:
        assert path.is_relative_to(place / "run") or path.is_relative_to(data), path


def test_triton_gets_a_folder_where_it_has_none(tmp_path, monkeypatch, caplog):
    own, file, removed = tmp_path / "own", tmp_path / "file", []
    file.write_text("")
    monkeypatch.setattr(backend.atexit, "register", lambda _, path, **__: removed.append(path))
    monkeypatch.setenv("TRITON_CACHE_DIR", str(own))
    backend._settle_triton.__wrapped__()
    assert os.environ["TRITON_CACHE_DIR"] == str(own)
    assert not caplog.records
    for name, place in (
        ("TRITON_CACHE_DIR", f"{file}/cache"),
        ("TRITON_HOME", f"{file}/.triton/cache"),
        ("HOME", "~/.triton/cache"),
    ):
        for other in ("TRITON_CACHE_DIR", "TRITON_HOME"):
            monkeypatch.delenv(other, raising=False)
        monkeypatch.setenv(name, place.removesuffix("/.triton/cache").replace("~", str(file)))
        caplog.clear()
        backend._settle_triton.__wrapped__()
        assert Path(os.environ["TRITON_CACHE_DIR"]).is_dir()
        assert os.environ["TRITON_CACHE_DIR"] == removed[-1]
        assert f"triton cannot write to {place}: " in caplog.text
        shutil.rmtree(removed[-1])
