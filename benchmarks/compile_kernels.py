"""All Triton kernels compiled for several generations of GPUs, without a GPU.

    python benchmarks/compile_kernels.py [--arch 80 86 90 120] [--only NAME ...]

Prints registers of a thread and bytes that did not fit into them, and exits with code 1 where there
are any: such a kernel waits for memory instead. Works down to machine code; only the launch is left
out.
"""

import os

# Triton reads this when it is imported.
os.environ["TRITON_INTERPRET"] = "0"

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import triton
from runner import markdown
from triton.backends.compiler import GPUTarget
from triton.runtime.jit import JITFunction

from xplanes.baselines.products import DYNAMIC, plane_product_gpu
from xplanes.fields.lookup import plane_features_gpu
from xplanes.fields.xplanes import PLANE_SETS, TIME_PLANES
from xplanes.rendering.compositing import composite_gpu
from xplanes.rendering.marching import Rays, march_gpu
from xplanes.rendering.occupancy import OccupancyGrid

ARCHITECTURES = (80, 86, 90, 120)
"""Compute capabilities: A100, RTX 3090, H100, RTX 5090."""

CUOBJDUMP = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"


@dataclass(frozen=True)
class Compiled:
    """What became of a kernel.

    Attributes:
        case: What it was compiled for.
        kernel: Its name.
        architecture: Compute capability, times ten.
        registers: Registers of a thread.
        spilled: Bytes of a thread that did not fit into them.
        vector_reads: Reads of four numbers at once.
        vector_adds: Atomic additions of four numbers at once.
        seconds: Time to compile it.
    """

    case: str
    kernel: str
    architecture: int
    registers: int
    spilled: int
    vector_reads: int
    vector_adds: int
    seconds: float


class Driver:
    """As much of a driver as compiling takes; each architecture is a device of its own."""

    architecture = 0

    def get_current_target(self) -> GPUTarget:
        return GPUTarget("cuda", self.architecture, 32)

    def get_current_device(self) -> int:
        return self.architecture

    def get_current_stream(self, device: int | None = None) -> int:
        return 0


def resources(binary: bytes) -> tuple[int, int]:
    """Registers and spilled bytes of a thread of a compiled kernel."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "kernel.cubin"
        file.write_bytes(binary)
        command = [str(CUOBJDUMP), "-res-usage", str(file)]
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = re.search(r"REG:(\d+) STACK:(\d+).* LOCAL:(\d+)", said)
    assert found is not None, said
    return int(found[1]), int(found[2]) + int(found[3])


@contextmanager
def launches_compile() -> Iterator[list[tuple[str, Any, float]]]:
    """Compile what would be launched inside: names, results and seconds."""
    found: list[tuple[str, Any, float]] = []
    run = JITFunction.run

    def compile_only(self: JITFunction, *given: Any, grid: Any, warmup: bool, **named: Any) -> Any:
        began = time.perf_counter()
        kernel = run(self, *given, grid=grid, warmup=True, **named)
        name = f"{self.fn.__module__.rpartition('.')[2]}.{self.fn.__name__}"
        found.append((name, kernel, time.perf_counter() - began))
        return kernel

    JITFunction.run = compile_only
    try:
        yield found
    finally:
        JITFunction.run = run


def lookup(plane_set: str, channels: int) -> None:
    """The planes of X-Planes, read at points, and the gradients."""
    stacks = [torch.zeros(3, 9, 9, channels).requires_grad_()]
    stacks.append(torch.zeros(len(TIME_PLANES[plane_set]), 4, 7, channels).requires_grad_())
    rows = PLANE_SETS[plane_set]
    plane_features_gpu(*stacks, torch.zeros(5, 3), torch.zeros(5), rows).sum().backward()


def products(channels: int) -> None:
    """The planes of K-Planes."""
    planes = [torch.zeros(1, channels, 16, 16).requires_grad_() for _ in DYNAMIC]
    plane_product_gpu(planes, torch.zeros(5, 4), DYNAMIC).sum().backward()


def compositing() -> None:
    """Samples along rays."""
    starts = torch.zeros(3, dtype=torch.int64)
    depth, colour = torch.zeros(5).requires_grad_(), torch.zeros(5, 3).requires_grad_()
    composite_gpu(depth, colour, torch.zeros(5), starts)[0].sum().backward()


def marching() -> None:
    """Placing samples along rays."""
    grid, rays = OccupancyGrid(4, 2, step=0.1), [torch.zeros(5, 3), torch.ones(5, 3)]
    rays += [torch.zeros(5), torch.zeros(5)]
    given = {"step": 0.1, "occupied": grid.occupied, "limit": 7.0}
    march_gpu(Rays(*rays), grid, room=9, **given)


CASES: dict[str, Callable[[], None]] = {
    "six planes, 16 channels": lambda: lookup("six", 16),
    "six planes, 40 channels": lambda: lookup("six", 40),
    "nine planes, 16 channels": lambda: lookup("nine", 16),
    "nine planes, 40 channels": lambda: lookup("nine", 40),
    "products, 32 channels": lambda: products(32),
    "compositing": compositing,
    "marching": marching,
}


def compile_all(architectures: Sequence[int], only: Sequence[str] = ()) -> Iterator[Compiled]:
    """Compile the kernels of all cases whose names contain one of ``only``, if there are any."""
    driver = Driver()
    triton.runtime.driver.set_active(driver)
    for driver.architecture in architectures:
        for case, launch in CASES.items():
            if only and not any(name in case for name in only):
                continue
            with launches_compile() as found:
                launch()
            for name, kernel, seconds in found:
                text = kernel.asm["ptx"]
                yield Compiled(
                    case,
                    name,
                    driver.architecture,
                    *resources(kernel.asm["cubin"]),
                    text.count("ld.global.v4"),
                    text.count("add.v4.f32"),
                    seconds,
                )


def main(given: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--arch", type=int, nargs="+", default=ARCHITECTURES)
    parser.add_argument("--only", nargs="+", default=(), metavar="NAME")
    args = parser.parse_args(given)
    done = list(compile_all(args.arch, args.only))
    header = ["case", "kernel", "sm", "registers", "bytes spilled", "v4 reads", "v4 adds", "s"]
    rows = [
        [c.case, c.kernel, f"{c.architecture}", f"{c.registers}", f"{c.spilled}",
         f"{c.vector_reads}", f"{c.vector_adds}", f"{c.seconds:.1f}"]
        for c in done
    ]  # fmt: skip
    print(f"triton {triton.__version__}, torch {torch.__version__}\n")
    print(markdown(header, rows))
    spilled = sorted({f"{c.kernel} (sm_{c.architecture})" for c in done if c.spilled})
    if spilled:
        print(f"more numbers than registers: {', '.join(spilled)}", file=sys.stderr)
    return 1 if spilled or not done else 0


if __name__ == "__main__":
    sys.exit(main())
