"""The compiled loops agree with torch on the number of threads, and may be absent."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from xplanes.backend import WarmUp

ROOT = Path(__file__).resolve().parents[1]

FORK = """
import json, os, sys
import torch
for code in json.loads(sys.argv[1]):
    child = os.fork()
    if not child:
        exec(code)
        sys.stdout.flush()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0, code
"""
"""Runs each of several scripts where torch is loaded, and nothing else."""

COUNT = """
torch.set_num_threads({count})
import numba
from xplanes.rendering.compositing import composite
nothing = torch.zeros(4, dtype=torch.long)
composite(torch.rand(4), torch.rand(4, 3), torch.rand(4), nothing, nothing[:1])
print(torch.get_num_threads(), numba.get_num_threads(), numba.config.NUMBA_NUM_THREADS)
"""

FALLBACK = """
sys.path.insert(0, {place!r})
from xplanes import backend
from xplanes.rendering.compositing import composite
nothing = torch.zeros(4, dtype=torch.long)
total, _ = composite(torch.rand(4), torch.rand(4, 3), torch.rand(4), nothing, nothing[:1])
assert total.isfinite().all()
print(backend.name(torch.device("cpu")))
try:
    backend.gpu_module("xplanes.fields.gpu")
    print("loaded")
except ModuleNotFoundError as error:
    print(error.name)
"""


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> subprocess.CompletedProcess[str]:
    """What three new processes say: with one thread, with two, and where numba does not load."""
    place = tmp_path_factory.mktemp("broken")
    (place / "numba").mkdir()
    (place / "numba" / "__init__.py").write_text("raise ImportError('Numba needs NumPy 0.1')")
    codes = [COUNT.format(count=1), COUNT.format(count=2), FALLBACK.format(place=str(place))]
    return subprocess.run(
        [sys.executable, "-c", FORK, json.dumps(codes)],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )


def test_the_first_loop_leaves_the_number_of_threads_alone(result) -> None:
    for count, line in zip((1, 2), result.stdout.splitlines(), strict=False):
        torchs, loops, cores = map(int, line.split())
        assert torchs == count
        assert loops == min(count, cores)


def test_a_numba_that_does_not_load_is_done_without(result) -> None:
    assert len(result.stdout.splitlines()) == 4
    assert result.stdout.splitlines()[2] == "torch"
    # Kernels for GPUs have no need of it.
    assert result.stdout.splitlines()[3] in ("loaded", "triton")
    assert "numba cannot be imported (Numba needs NumPy 0.1)" in result.stderr
    assert "pip install --upgrade numba" in result.stderr


def test_warming_up_inside_warming_up_counts_once() -> None:
    clock = WarmUp()
    with clock.timed(), clock.timed():
        time.sleep(0.05)
    assert 0.05 <= clock.seconds < 0.1
    with clock.timed():
        time.sleep(0.01)
    assert clock.seconds >= 0.06
