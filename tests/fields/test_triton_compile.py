"""The GPU kernels go through the compiler, called as on a GPU: the interpreter allows more."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("triton", reason="triton is not installed")

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "compile_kernels.py"


def compiled(cache, *options):
    """Rows of the script's table: case, kernel, architecture, then numbers."""
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE", "TRITON_CACHE_DIR": str(cache)}
    command = [sys.executable, str(SCRIPT), *options]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=580)
    assert done.returncode == 0, done.stderr
    lines = [line.strip("| ").split(" | ") for line in done.stdout.splitlines()]
    return [line for line in lines if len(line) == 8][1:]


@pytest.mark.slow
def test_kernels_with_most_numbers_fit_the_registers_of_a_common_gpu(tmp_path):
    cases = ("nine planes, 40", "compositing", "marching")
    rows = compiled(tmp_path, "--arch", "86", "--only", *cases)
    assert [(row[0], row[1]) for row in rows] == [
        ("nine planes, 40 channels", "lookup_triton.forward"),
        ("nine planes, 40 channels", "lookup_triton.backward_by_row"),
        ("compositing", "compositing_triton.forward"),
        ("compositing", "compositing_triton.backward"),
        ("marching", "marching_triton.march"),
        ("marching", "marching_triton.march"),
    ]
    assert all(int(row[4]) == 0 for row in rows)


@pytest.mark.slow
def test_kernels_compile_for_all_generations_and_move_four_numbers_at_once(tmp_path):
    """Down to the GPU's machine code; only the launch is left out."""
    rows = compiled(tmp_path)
    assert {row[2] for row in rows} == {"80", "86", "90", "120"}
    moved = {(row[0], row[1]): row[5:7] for row in rows if row[2] == "90"}
    # Four corners of each plane, each read once: three planes of space and three of time; the
    # backward reads the time planes and the three gradients, and adds to all corners.
    assert moved["six planes, 40 channels", "lookup_triton.forward"] == ["24", "0"]
    assert moved["six planes, 40 channels", "lookup_triton.backward"] == ["15", "24"]
    assert moved["nine planes, 40 channels", "lookup_triton.backward_by_row"] == ["27", "36"]
    assert moved["products, 32 channels", "products_triton.forward"] == ["24", "0"]
