"""The compiled loops and torch agree on how many threads there are."""

import subprocess
import sys

import pytest

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
