"""The compiled loops agree with torch on the number of threads, and may be absent."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from xplanes.backend import WarmUp

COUNT = """
import sys, numba, torch
torch.set_num_threads(int(sys.argv[1]))
from xplanes.rendering.compositing import composite
nothing = torch.zeros(4, dtype=torch.long)
composite(torch.rand(4), torch.rand(4, 3), torch.rand(4), nothing, nothing[:1])
print(torch.get_num_threads(), numba.get_num_threads(), numba.config.NUMBA_NUM_THREADS)
"""


@pytest.mark.parametrize("count", [1, 2])
def test_the_first_loop_leaves_the_number_of_threads_alone(count: int) -> None:
    result = subprocess.run(
        [sys.executable, "-c", COUNT, str(count)], capture_output=True, text=True, check=True
    )
    torchs, loops, cores = map(int, result.stdout.split())
    assert torchs == count
    assert loops == min(count, cores)


FALLBACK = """
import torch
from xplanes import backend
from xplanes.rendering.compositing import composite
nothing = torch.zeros(4, dtype=torch.long)
total, _ = composite(torch.rand(4), torch.rand(4, 3), torch.rand(4), nothing, nothing[:1])
assert total.isfinite().all()
print(backend.name(torch.device("cpu")))
"""


def test_a_numba_that_does_not_load_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "numba").mkdir()
    (tmp_path / "numba" / "__init__.py").write_text("raise ImportError('Numba needs NumPy 0.1')")
    root = Path(__file__).parents[1]
    result = subprocess.run(
        [sys.executable, "-c", FALLBACK],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{root}"},
    )
    assert result.stdout.split() == ["torch"]
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
