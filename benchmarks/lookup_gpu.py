"""Plane lookup on CUDA: the Triton kernels, their readable twin, and what memory would allow.

    python benchmarks/lookup_gpu.py [--points 262144] [--channels 16 32 40] [--resolution 128]

Prints a table and writes it to results/lookup_gpu.md beside this file. A share of 100% would be a
kernel that moves the least possible number of bytes (points, features, each plane once; in the
backward gradients and planes of gradients once) at the speed of a large copy on the same device.
Needs a CUDA device.
"""

import argparse
import statistics
import sys
from collections.abc import Callable

import torch
from runner import RESULTS, markdown
from torch import Tensor

from xplanes.backend import gpu_kernels
from xplanes.fields.lookup import plane_features, plane_features_gpu, plane_features_reference
from xplanes.fields.xplanes import PLANE_SETS, TIME_PLANES
from xplanes.files import write_text

COLUMNS = ("planes", "channels", "pass", "kernels, us", "twin, us", "times faster", "of the copy")
ROUNDS, WARM_UP = 50, 10
COPIED = 2**28
"""Bytes of the copy that gives the speed of memory."""


def microseconds(work: Callable[[], object]) -> float:
    """Median time of one run on the device."""
    for _ in range(WARM_UP):
        work()
    times = []
    for _ in range(ROUNDS):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        work()
        end.record()
        end.synchronize()
        times.append(1000 * begin.elapsed_time(end))
    return statistics.median(times)


def copy_speed() -> float:
    """Bytes read and written in a microsecond by a large copy."""
    source = torch.empty(COPIED, dtype=torch.uint8, device="cuda")
    target = torch.empty_like(source)
    return 2 * COPIED / microseconds(lambda: target.copy_(source))


def scene(plane_set: str, channels: int, args) -> tuple[list[Tensor], Tensor, Tensor]:
    """Planes, points along rays (neighbours lie close, as in training) and their times."""
    size, rows = args.resolution, args.time_resolution
    stacks = [torch.randn(3, size, size, channels, device="cuda")]
    if names := TIME_PLANES[plane_set]:
        stacks.append(torch.randn(len(names), rows, size, channels, device="cuda"))
    rays = args.points // args.samples
    ends = 1.8 * torch.rand(2, rays, 1, 3, device="cuda") - 0.9
    along = torch.linspace(0, 1, args.samples, device="cuda")[:, None]
    points = torch.lerp(ends[0], ends[1], along).view(-1, 3)
    times = torch.rand(rays, device="cuda").repeat_interleave(args.samples)
    return [stack.requires_grad_() for stack in stacks], points, times


def measure(plane_set: str, channels: int, speed: float, args) -> list[tuple]:
    """Rows of the table for one plane set."""
    stacks, points, times = scene(plane_set, channels, args)
    moving, rows = stacks[1] if len(stacks) > 1 else None, PLANE_SETS[plane_set]
    given = stacks[0], moving, points, times, rows
    plane_features(*given)  # Compiles the kernels and compares them with the twin.
    found = {}
    for name, function in (("kernels", plane_features_gpu), ("twin", plane_features_reference)):
        value = function(*given)
        pull = torch.randn_like(value)
        with torch.no_grad():
            forward = microseconds(lambda function=function: function(*given))
        backward = microseconds(
            lambda value=value, pull=pull: torch.autograd.grad(
                value, stacks, pull, retain_graph=True
            )
        )
        found[name] = forward, backward
    planes = sum(stack.nbytes for stack in stacks)
    outer = points.nbytes + times.nbytes + 4 * len(points) * 3 * channels
    # The backward reads the time planes again, clears the gradients and adds to them.
    factors = 0 if moving is None else moving.nbytes
    least = outer + planes, outer + factors + 2 * planes
    return [
        (
            plane_set,
            channels,
            label,
            f"{ours:.0f}",
            f"{theirs:.0f}",
            f"{theirs / ours:.1f}",
            f"{100 * bytes_ / speed / ours:.0f}%",
        )
        for label, ours, theirs, bytes_ in zip(
            ("forward", "backward"), found["kernels"], found["twin"], least, strict=True
        )
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--points", type=int, default=2**18)
    parser.add_argument("--samples", type=int, default=32, help="points of a ray")
    parser.add_argument("--channels", type=int, nargs="+", default=[16, 32, 40])
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--time-resolution", type=int, default=50)
    args = parser.parse_args()
    if not torch.cuda.is_available():
        sys.exit("no CUDA device found: this benchmark measures GPU kernels and needs one")
    if not gpu_kernels(torch.empty(0, device="cuda")):
        sys.exit("Triton kernels are off: install triton, unset XPLANES_GPU_KERNELS")
    speed = copy_speed()
    rows = [
        row
        for plane_set in PLANE_SETS
        for channels in args.channels
        for row in measure(plane_set, channels, speed, args)
    ]
    page = f"""# Plane lookup on CUDA

{torch.cuda.get_device_name()}, torch {torch.__version__}; {args.points} points, {args.samples} on
a ray; planes of {args.resolution} x {args.resolution} texels, {args.time_resolution} rows of time;
float32; a copy moves {speed / 1e6:.2f} TB/s. Script: `benchmarks/lookup_gpu.py`.

{markdown(COLUMNS, rows)}
"""
    print(page)
    write_text(RESULTS / "lookup_gpu.md", page)


if __name__ == "__main__":
    main()
