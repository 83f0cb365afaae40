"""The GPU kernels go through the compiler, called as on a GPU: the interpreter allows more."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("triton", reason="triton is not installed")

PROGRAM = """
import torch
import triton
from triton.backends.compiler import GPUTarget

class Driver:
    # As much of a driver as compiling takes.
    def get_current_target(self):
        return GPUTarget("cuda", 90, 32)

    def get_current_device(self):
        return 0

    def get_current_stream(self, device=None):
        return 0

class WithoutLaunch:
    def __init__(self, kernel):
        self.kernel = kernel

    def __getitem__(self, grid):
        def compile(*given, **named):
            text = self.kernel.warmup(*given, grid=grid, **named).asm["ptx"]
            print(text.count("ld.global.v4"), text.count("add.v4.f32"))
        return compile

triton.runtime.driver.set_active(Driver())

from xplanes.fields import gpu, gpu_products
from xplanes.fields.lookup import plane_features_gpu
from xplanes.fields.products import STATIC, plane_product_gpu
from xplanes.fields.xplanes import PLANE_SETS

for module in (gpu, gpu_products):
    module.forward = WithoutLaunch(module.forward)
    module.backward = WithoutLaunch(module.backward)

space, time = torch.zeros(3, 9, 9, 40).requires_grad_(), torch.zeros(3, 4, 7, 40).requires_grad_()
found = plane_features_gpu(space, time, torch.zeros(5, 3), torch.zeros(5), PLANE_SETS["six"])
found.sum().backward()
planes = [torch.zeros(1, 8, 5, 5).requires_grad_() for _ in STATIC]
plane_product_gpu(planes, torch.zeros(5, 4), STATIC).sum().backward()
"""


@pytest.mark.slow
def test_kernels_compile_for_a_gpu_and_move_four_numbers_at_once(tmp_path):
    """Down to the GPU's machine code, for one generation of GPUs; only the launch is left out."""
    environment = {**os.environ, "TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    reads, product = done.stdout.split("\n")[:2], done.stdout.split("\n")[2:4]
    # Four corners of each plane, each read once: three planes of space and three of time; the
    # backward reads the time planes and the three gradients, and adds to all corners.
    assert reads == ["24 0", "15 24"]
    assert product == ["12 0", "13 12"]
