"""A GPU measured in one go: kernels, training against the CPU, throughput, lego.

    python benchmarks/gpu.py [--lego FOLDER] [--minutes 10] [--only SECTION ...] [--out FOLDER]

Writes gpu.md and gpu.csv to results beside this file, or to --out, and prints the page. Needs no
network. Each part runs in a process of its own: one that crashes is named on the page, does not
stop the others, and makes the exit code 1. Parts that do not fit into the minutes are left out, and
the page says so. Without a GPU a reduced version runs, in three minutes at most: the kernels in
Triton's interpreter and the training steps on the CPU.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import importlib.util
import math
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.strategies import SingleDeviceStrategy
from runner import RESULTS, Measured, command, lego, machine, markdown, measure
from torch import Tensor
from torch.autograd import DeviceType
from torch.nn import functional
from torch.profiler import ProfilerActivity

from xplanes import RadianceModule, SceneDataModule
from xplanes.backend import synchronize
from xplanes.baselines.products import DYNAMIC, plane_product_gpu, plane_product_reference
from xplanes.config import compose_plain
from xplanes.decomposition import decompose
from xplanes.fields.lookup import plane_features_gpu, plane_features_reference
from xplanes.fields.xplanes import PLANE_SETS, TIME_PLANES
from xplanes.files import read_json, require_writable, write_json, write_rows, write_text
from xplanes.lrm.weights import load_bundled
from xplanes.rendering.compositing import composite_gpu, composite_reference
from xplanes.rendering.marching import Rays, Samples, march_gpu, march_reference
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.scenes.batches import DeviceBatches

BEGAN = time.monotonic()

TOLERANCE = 1e-4
"""Error from which a kernel counts as wrong; the twin in float32 comes to about 1e-5."""
AGREE = 0.3
"""Difference in dB up to which two devices agree. On one CPU, compiled loops and torch, which round
otherwise, differed by 0.06, 0.08 and 0.13 dB (three seeds)."""
STEPS = 300
LEGO_SECONDS = 60
GOAL = 25.0
"""PSNR in dB on lego whose time is measured."""
KERNELS = 15
"""Rows of the table of a step's kernels."""
SETTLED, SHARE = 8, 0.4
"""Seconds of training for steps per second, and the share of them that does not count."""
ROUNDS, WARM_UP = 50, 10
SLEEP = 2_000_000
"""Clock cycles of the GPU, a millisecond: longer than it takes to launch what is timed."""
COPIED = 2**28
"""Bytes of the copy that gives the speed of memory."""
POINTS = 2**13, 2**18
"""Samples of a step (default, large batches) at which kernels are timed."""
MANY, FEW = 2**16, 2**7
"""Points at which kernels are compared with float64, on a GPU and in the interpreter."""
RAY = 32
"""Points of a ray."""
RAYS = 2**10, 2**15
"""Rays of a step (small batches, default) for which samples are placed."""
STEP, PLACES = 2 * math.sqrt(3) / 128, 16
"""Distance between samples, as in training, and places for samples to a ray."""
CPU_MINUTES = 3.0
RESERVE = 15.0
"""Seconds of the budget reserved for start-up and for writing the page."""


class Figure(NamedTuple):
    """One measured number; ``table`` is the part of the page, and of the CSV, that it goes to."""

    table: str
    row: str
    column: str
    value: float
    unit: str


@dataclass
class Record:
    """What a part has found so far, kept in a file that outlives a crash.

    Attributes:
        path: The file.
        figures: Numbers.
        notes: Table, text and row of what the page says below a table.
        device: The GPU, in words.
        error: What went wrong, in one line.
    """

    path: Path
    figures: list[Figure] = field(default_factory=list)
    notes: list[tuple[str, str, str]] = field(default_factory=list)
    device: str = ""
    error: str = ""

    def add(self, table: str, row: str, cells: dict[str, tuple[float, str]]) -> None:
        """Keep a row: value and unit by column."""
        self.figures += [Figure(table, row, name, *cell) for name, cell in cells.items()]
        self.save()

    def save(self) -> None:
        write_json(self.path, {name: value for name, value in vars(self).items() if name != "path"})

    @classmethod
    def load(cls, path: Path) -> "Record":
        """The record of a part that has ended; empty where it wrote none."""
        found = read_json(path) if path.is_file() else {}
        figures = [Figure(*entry) for entry in found.pop("figures", [])]
        notes = [(table, text, row) for table, text, row in found.pop("notes", [])]
        return cls(path, figures, notes, **found)


# Kernels


@dataclass(frozen=True)
class Case:
    """What gets gradients, and the two ways to values.

    Attributes:
        leaves: What gets gradients: planes, or optical depths and colours.
        kernels: From these to values, by Triton.
        twin: The same by torch, in any precision.
        least: Bytes that the forward and the backward must move.
    """

    leaves: list[Tensor]
    kernels: Callable[[list[Tensor]], Tensor]
    twin: Callable[[list[Tensor]], Tensor]
    least: tuple[int, int]


@dataclass(frozen=True)
class Sizes:
    """Sizes of a case; ``reach`` is how far points go, the planes' cube ending at 1."""

    points: int
    channels: int
    texels: int
    rows: int
    device: torch.device
    reach: float = 0.9

    @property
    def words(self) -> str:
        return f", {self.channels} channels, {self.texels} texels" if self.channels else ""


def along_rays(sizes: Sizes) -> tuple[Tensor, Tensor]:
    """Points whose neighbours lie close, as in training, and their times. [N, 3], [N]"""
    rays = sizes.points // RAY
    ends = sizes.reach * (2 * torch.rand(2, rays, 1, 3, device=sizes.device) - 1)
    along = torch.linspace(0, 1, RAY, device=sizes.device)[:, None]
    points = torch.lerp(ends[0], ends[1], along).view(-1, 3)
    # Beyond the planes lie points before and after all times, too.
    beyond = max(0.0, sizes.reach - 1)
    times = (1 + 2 * beyond) * torch.rand(rays, device=sizes.device) - beyond
    return points, times.repeat_interleave(RAY)


def lookup_case(plane_set: str, sizes: Sizes) -> Case:
    """Space planes plus products of time planes (X-Planes)."""
    shape = (sizes.texels, sizes.channels)
    stacks = [torch.randn(3, sizes.texels, *shape, device=sizes.device)]
    if names := TIME_PLANES[plane_set]:
        stacks.append(torch.randn(len(names), sizes.rows, *shape, device=sizes.device))
    points, times = along_rays(sizes)

    def call(function: Callable[..., Tensor]) -> Callable[[list[Tensor]], Tensor]:
        return lambda planes: function(*planes, points, times, PLANE_SETS[plane_set])

    total = sum(stack.nbytes for stack in stacks)
    outer = points.nbytes + times.nbytes + 4 * len(points) * 3 * sizes.channels
    # The backward reads the time planes again, clears the gradients and adds to them.
    least = outer + total, outer + sum(stack.nbytes for stack in stacks[1:]) + 2 * total
    return Case(stacks, call(plane_features_gpu), call(plane_features_reference), least)


def product_case(sizes: Sizes) -> Case:
    """The product of six planes at one scale (K-Planes)."""
    planes = []
    for name in DYNAMIC:
        shape = (1, sizes.channels, sizes.rows if "t" in name else sizes.texels, sizes.texels)
        plane = 1.3 - torch.rand(shape, device=sizes.device)
        planes.append(plane.contiguous(memory_format=torch.channels_last))
    points, times = along_rays(sizes)
    places = torch.cat([points, 2 * times[:, None] - 1], dim=1)
    total = sum(plane.nbytes for plane in planes)
    outer = places.nbytes + 4 * len(places) * sizes.channels
    return Case(
        planes,
        lambda planes: plane_product_gpu(planes, places, DYNAMIC),
        lambda planes: plane_product_reference(planes, places, DYNAMIC),
        (outer + total, outer + 3 * total),
    )


def compositing_case(sizes: Sizes, samples: int) -> Case:
    """Rays with a given number of samples on average, some without any."""
    device = sizes.device
    starts = torch.randint(sizes.points, (sizes.points // samples,), device=device).sort()[0]
    starts[0] = 0
    ray = torch.searchsorted(starts, torch.arange(sizes.points, device=device), right=True) - 1
    depth = (3 / samples) * torch.rand(sizes.points, device=device)
    leaves = [depth, torch.rand(sizes.points, 3, device=device)]
    distances = torch.rand(sizes.points, device=device)

    def twin(leaves: list[Tensor]) -> Tensor:
        return composite_reference(*leaves, distances.to(leaves[0].dtype), ray, starts)[0]

    # A sample's depth, colour and distance are read, its weight and the light before it written;
    # the backward reads all of these.
    rays = starts.nbytes + 20 * len(starts)
    least = rays + 7 * depth.nbytes, rays + 11 * depth.nbytes
    return Case(leaves, lambda leaves: composite_gpu(*leaves, distances, starts)[0], twin, least)


def errors(case: Case) -> dict[str, tuple[float, str]]:
    """Largest differences from the twin in float64, over its largest value."""

    def values(function: Callable[[list[Tensor]], Tensor], precision: torch.dtype) -> list[Tensor]:
        leaves = [plane.to(precision, copy=True).requires_grad_() for plane in case.leaves]
        value = function(leaves)
        weights = torch.linspace(-1, 1, value.numel(), device=value.device, dtype=torch.float64)
        upstream = (1000 * weights).sin().float().to(value.dtype).view_as(value)
        return [value.detach(), *torch.autograd.grad(value, leaves, upstream)]

    exact = values(case.twin, torch.float64)
    found = {}
    for name, function in (("kernels", case.kernels), ("twin", case.twin)):
        pairs = zip(values(function, torch.float32), exact, strict=True)
        # A NaN must stay one, which max() among floats would not promise.
        apart = torch.stack([(a - b).abs().max() / b.abs().max() for a, b in pairs])
        found[f"{name}: values"] = float(apart[0]), "relative"
        found[f"{name}: gradients"] = float(apart[1:].max()), "relative"
    return found


def microseconds(work: Callable[[], object]) -> float:
    """Median time of one run on the GPU."""
    for _ in range(WARM_UP):
        work()
    times = []
    for _ in range(ROUNDS):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda._sleep(SLEEP)  # While the GPU waits, the host launches all that is timed.
        begin.record()
        work()
        end.record()
        end.synchronize()
        times.append(1000 * begin.elapsed_time(end))
    return statistics.median(times)


def copy_speed() -> float:
    """Bytes read and written in a microsecond by a large copy."""
    source = torch.zeros(COPIED, dtype=torch.uint8, device="cuda")
    target = torch.empty_like(source)
    return 2 * COPIED / microseconds(lambda: target.copy_(source))


def time_case(case: Case, speed: float) -> dict[str, dict[str, tuple[float, str]]]:
    """Cells of the rows "forward" and "backward"."""
    leaves = [leaf.clone().requires_grad_() for leaf in case.leaves]
    spent = {}
    for name, function in (("kernels", case.kernels), ("twin", case.twin)):
        with torch.no_grad():
            forward = microseconds(lambda function=function: function(leaves))
        value = function(leaves)
        upstream = torch.randn_like(value)

        def back(value: Tensor = value, upstream: Tensor = upstream) -> object:
            return torch.autograd.grad(value, leaves, upstream, retain_graph=True)

        spent[name] = forward, microseconds(back)
    return {
        label: {
            "kernels": (ours, "us"),
            "twin": (theirs, "us"),
            "times faster": (theirs / ours, "times"),
            "of the copy": (100 * least / speed / ours, "%"),
        }
        for label, ours, theirs, least in zip(
            ("forward", "backward"), spent["kernels"], spent["twin"], case.least, strict=True
        )
    }


Make = Callable[[Sizes], Case]


def compare(record: Record, name: str, make: Make, sizes: Sizes) -> None:
    """Add a row of errors; a kernel that is wrong is the part's error."""
    row = f"{name}{sizes.words}"
    found = errors(make(sizes))
    ours = {what: value for what, (value, _) in found.items() if "kernels" in what}
    if not all(value <= TOLERANCE for value in ours.values()):
        said = ", ".join(f"{what} {value:.1e}" for what, value in ours.items())
        record.error = f"errors of {row} ({said}) are above {TOLERANCE:g}"
    record.add("accuracy", row, found)


def measure_kernels(
    record: Record, part: "Part", kinds: Sequence[tuple[str, Make]], full: Sequence
) -> None:
    """Errors of all kernels, on a GPU their times too.

    Args:
        record: Where figures go.
        part: The part.
        kinds: Name and maker of cases.
        full: Channels, texels and rows of time on a GPU; zeros where there are no planes.
    """
    torch.manual_seed(0)
    if not torch.cuda.is_available():
        for name, make in kinds:
            channels, texels, rows = (min(a, b) for a, b in zip(full[0], (8, 16, 6), strict=True))
            small = Sizes(FEW, channels, texels, rows, torch.device("cpu"), reach=1.2)
            compare(record, name, make, small)
        return
    device = torch.device("cuda")
    for name, make in kinds:
        for numbers in full:
            compare(record, name, make, Sizes(MANY, *numbers, device, reach=1.2))
    speed = copy_speed()
    note = f"A large copy moves {speed / 1e6:.2f} TB/s"
    record.notes.append(("kernel time", note, part.row))
    record.add("copy", part.row, {"speed": (speed / 1e6, "TB/s")})
    for name, make in kinds:
        for numbers in full:
            for points in POINTS:
                sizes = Sizes(points, *numbers, device)
                for label, cells in time_case(make(sizes), speed).items():
                    row = f"{name}{sizes.words}, {points} points, {label}"
                    record.add("kernel time", row, cells)


def measure_lookup(record: Record, part: "Part", args: argparse.Namespace) -> None:
    kinds = [
        (f"{plane_set} planes", lambda sizes, chosen=plane_set: lookup_case(chosen, sizes))
        for plane_set in ("six", "nine")
    ]
    measure_kernels(record, part, kinds, [(16, 128, 50), (32, 128, 50), (40, 128, 50)])


def measure_products(record: Record, part: "Part", args: argparse.Namespace) -> None:
    measure_kernels(record, part, [("products", product_case)], [(8, 64, 50), (32, 128, 25)])


def measure_compositing(record: Record, part: "Part", args: argparse.Namespace) -> None:
    kinds = [
        (
            f"compositing, {samples} samples a ray",
            lambda sizes, samples=samples: compositing_case(sizes, samples),
        )
        for samples in (8, RAY)
    ]
    measure_kernels(record, part, kinds, [(0, 0, 0)])


def marching_case(rays: int, device: torch.device) -> tuple[Callable[[], Samples], ...]:
    """Kernel and twin, for rays through a cube in which a tenth of the cells holds something."""
    grid = OccupancyGrid(64, 8, step=STEP).to(device)
    grid.occupied.copy_(torch.rand(len(grid.occupied), device=device) < 0.1)
    grid.least.copy_(grid.occupied * torch.rand(len(grid.least), device=device) / STEP)
    origins = 3 * functional.normalize(torch.randn(rays, 3, device=device), dim=1)
    directions = functional.normalize(torch.rand(rays, 3, device=device) - 0.5 - origins, dim=1)
    times, jitter = torch.rand(2, rays, device=device)
    options = {"step": STEP, "occupied": grid.occupied, "limit": 7.0}
    given = Rays(origins, directions, times, jitter)

    def call(function: Callable[..., Samples]) -> Callable[[], Samples]:
        return lambda: function(given, grid, room=PLACES * rays, **options)

    return call(march_gpu), call(march_reference)


def measure_marching(record: Record, part: "Part", args: argparse.Namespace) -> None:
    torch.manual_seed(0)
    device = found_device()
    on_gpu = device.type == "cuda"
    for rays in RAYS if on_gpu else (FEW // 8,):
        kernel, twin = marching_case(rays, device)
        ours, theirs = kernel(), twin()
        # One sample more or less moves all behind it: what counts is how many lie in which cell.
        a, b = (
            Counter(
                zip(found.ray[found.live].tolist(), found.cells[found.live].tolist(), strict=True)
            )
            for found in (ours, theirs)
        )
        share = ((a - b).total() + (b - a).total()) / b.total()
        row = f"{part.row}, {rays} rays"
        if share > TOLERANCE:
            record.error = f"{row}: {100 * share:.3g}% of the samples lie elsewhere"
        record.add("accuracy", row, {"kernels: values": (share, "relative")})
        if on_gpu:
            ours, theirs = microseconds(kernel), microseconds(twin)
            cells = {"kernels": (ours, "us"), "twin": (theirs, "us")}
            record.add("kernel time", row, cells | {"times faster": (theirs / ours, "times")})


# Preparation


def found_device() -> torch.device:
    return torch.device("cuda", 0) if torch.cuda.is_available() else torch.device("cpu")


def seconds_of(work: Callable[[], object], device: torch.device) -> float:
    """Seconds of a second run: the first one loads what is needed."""
    work()
    synchronize(device)
    began = time.perf_counter()
    work()
    synchronize(device)
    return time.perf_counter() - began


def moving_planes(frames: int, channels: int, side: int) -> Tensor:
    """Triplanes that are static up to a patch that moves. [T, 3, C, H, H]"""
    generator = torch.Generator().manual_seed(0)
    whole = torch.randn(1, 3, channels, side, side, generator=generator).repeat(frames, 1, 1, 1, 1)
    for number, triplane in enumerate(whole):
        place = number * (side - side // 4) // frames
        triplane[..., place : place + side // 4] += 1
    return whole


def measure_preparation(
    record: Record, part: "Part", args: argparse.Namespace, device: torch.device | None = None
) -> None:
    """Seconds of what comes before training."""
    device = device or found_device()
    frames, channels, side = (50, 40, 64) if device.type == "cuda" else (8, 8, 32)
    for name in ("tiny", "mini"):
        model = load_bundled(name)[0].to(device)
        shown = torch.rand(8, 3, model.image_size, model.image_size).to(device)
        with torch.no_grad():
            spent = seconds_of(lambda model=model, shown=shown: model.encode(shown), device)
        cells = {"time": (1e3 * spent / len(shown), "ms")}
        record.add("preparation", f"LRM {name}, a frame of 8 at once, float32", cells)
    whole = moving_planes(frames, channels, side)
    sizes = " x ".join(map(str, whole.shape))
    for place in dict.fromkeys((device, torch.device("cpu"))):
        there = whole.to(place)
        spent = seconds_of(lambda there=there: decompose(there, max_iterations=100), place)
        row = f"robust PCA, {sizes}, at most 100 iterations, {place.type}"
        record.add("preparation", row, {"time": (1e3 * spent, "ms")})


# A step


def measure_step(
    record: Record, part: "Part", args: argparse.Namespace, device: torch.device | None = None
) -> None:
    """Where the time of a step goes, by what runs on the device."""
    device = device or found_device()
    where = ("data=demo", f"data.root={args.work / 'demo'}", "data.resolution=64")
    config = compose_plain("train", [*where, *part.overrides])
    settled, seen = (200, 20) if device.type == "cuda" else (5, 5)
    profiler = StepProfile(settled, seen, device)
    module, data = RadianceModule(config), SceneDataModule(config["data"])
    trainer = lightning.Trainer(
        strategy=SingleDeviceStrategy(device),
        max_steps=settled + seen,
        callbacks=[profiler],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
    )
    trainer.fit(module, data)
    spent, events = profiler.seconds / seen, profiler.events()
    busy = sum(event.time for event in events)
    calls = sum(event.calls for event in events)
    longest = sorted(events, key=lambda event: -event.time)[:KERNELS]
    rows = [Event("whole", calls, 1e6 * spent), Event("in kernels", calls, busy), *longest]
    for event in rows:
        cells = {
            "calls a step": (event.calls, "calls"),
            "time a step": (event.time, "us"),
            "share": (event.time / spent / 1e4, "%"),
        }
        record.add("step", event.name, cells)


class Event(NamedTuple):
    """A kernel, or where there is no GPU an operation: its calls and microseconds of a step."""

    name: str
    calls: float
    time: float


class StepProfile(Callback):
    """Profiles some steps after others.

    Args:
        settled: Steps before.
        seen: Steps that are profiled.
        device: Where they run.
    """

    def __init__(self, settled: int, seen: int, device: torch.device) -> None:
        self.settled, self.seen, self.device = settled, seen, device
        self.seconds = 0.0
        kind = ProfilerActivity.CUDA if device.type == "cuda" else ProfilerActivity.CPU
        self.profile = torch.profiler.profile(activities=[kind])

    def on_train_batch_end(self, trainer: Any, *rest: Any) -> None:
        if trainer.global_step == self.settled:
            synchronize(self.device)
            self.profile.start()
            self.seconds = -time.perf_counter()
        elif trainer.global_step == self.settled + self.seen:
            synchronize(self.device)
            self.seconds += time.perf_counter()
            self.profile.stop()

    def events(self) -> list[Event]:
        """What ran, by name."""
        gpu = self.device.type == "cuda"
        found = []
        for event in self.profile.key_averages():
            if gpu and event.device_type == DeviceType.CPU:
                continue  # A call of the driver, which launches what is counted already.
            spent = event.self_device_time_total if gpu else event.self_cpu_time_total
            name = " ".join(event.key.split())[:60].replace("|", "/")
            found.append(Event(name, event.count / self.seen, spent / self.seen))
        return found


# Training


def first_at(curve: Sequence[Mapping[str, str]], psnr: float) -> float:
    """Seconds of training after which a curve reaches a PSNR; NaN where it does not."""
    reached = [float(row["seconds"]) for row in curve if float(row["psnr"]) >= psnr]
    return min(reached, default=math.nan)


def measure_run(record: Record, part: "Part", args: argparse.Namespace) -> None:
    """Train as the part says and keep its columns."""
    where = ["data=demo", f"data.root={args.work / 'demo'}", "data.resolution=64"]
    if part.section == "lego":
        where = [*lego(args.lego.resolve()), "data.resolution=400"]
    always = ["preparation.cache=null", "media=false"]
    if part.rays_of_the_cpu:
        DeviceBatches.can_serve = staticmethod(lambda *_: False)
    done = measure([*part.overrides, *where, *always], args.work)
    metrics, test, seconds = done.metrics, done.metrics["test"], done.metrics["seconds"]
    rays = metrics["rays_per_second"]
    found = {
        f"to {GOAL:g} dB": (first_at(done.curve, GOAL), "s"),
        "PSNR": (test["psnr"], "dB"),
        "SSIM": (test["ssim"], ""),
        "steps": (metrics["step"], "steps"),
        "steps/s": (steps_per_second(done), "steps/s"),
        "rays/s": (rays, "rays/s"),
        "samples/s": (rays * metrics["samples_per_ray"], "samples/s"),
        "preparation": (sum(seconds["prepare"].values()), "s"),
        "peak memory": (metrics["peak_memory_bytes"] / 2**30, "GiB"),
    }
    record.notes.append((part.section, f"Inner loops: {metrics['loops']}", part.row))
    record.add(part.section, part.row, {name: found[name] for name in COLUMNS[part.section]})


def steps_per_second(done: Measured) -> float:
    """From the first score on the way to the end; of the whole run where there was none."""
    last = done.metrics["step"], done.metrics["seconds"]["train"]
    first = int(done.curve[0]["step"]), float(done.curve[0]["seconds"])
    steps, seconds = (b - a for a, b in zip(first, last, strict=True))
    return steps / seconds if steps else last[0] / last[1]


COLUMNS = {
    "training": ("PSNR", "SSIM", "steps/s", "rays/s", "preparation", "peak memory"),
    "throughput": ("steps/s", "rays/s", "samples/s", "steps", "peak memory"),
    "lego": (f"to {GOAL:g} dB", "PSNR", "SSIM", "steps", "steps/s", "rays/s", "peak memory"),
}
"""What a run adds to the table of its section."""


# Parts


@dataclass(frozen=True)
class Part:
    """What one process measures.

    Attributes:
        section: For --only.
        row: Its name within the section.
        work: Measures it.
        needs_gpu: Whether it is left out without one.
        overrides: Settings of its run.
        environment: Variables of its process.
        rays_of_the_cpu: Whether rays are drawn on the CPU, the same for both devices.
        need: Seconds that it takes on a usual machine with a GPU, generously; with less left it is
            not begun.
        limit: Seconds after which it counts as failed.
    """

    section: str
    row: str
    work: Callable[[Record, "Part", argparse.Namespace], None] = measure_run
    needs_gpu: bool = True
    overrides: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()
    rays_of_the_cpu: bool = False
    need: float = 40
    limit: float = 100

    @property
    def name(self) -> str:
        return f"{self.section} ({self.row})"


def training(
    row: str, initialisation: str, device: str, precision: str = "32", **options: Any
) -> Part:
    """A fixed number of steps, the same on both devices."""
    steps = (f"trainer.max_steps={STEPS}", "trainer.max_seconds=null")
    budget = (*steps, "callbacks.evaluation.at=[]")
    # On the CPU alone, steps before the first sweep would take half as many samples along rays.
    equal = (f"model.precision={precision}", *SMALL, "model.sampler.coarse_first=false")
    given = (initialisation, f"trainer.accelerator={device}", *equal, *budget)
    return Part("training", row, overrides=given, **options)


def throughput(row: str, *overrides: str, **options: Any) -> Part:
    """Some seconds of training; the score on the way marks where the count of steps begins."""
    budget = (f"trainer.max_seconds={SETTLED}", f"callbacks.evaluation.at=[{SHARE}]")
    views = ("trainer.limit_val_batches=1", "data.eval_views=2")
    given = (*overrides, "trainer.accelerator=gpu", *budget, *views)
    return Part("throughput", row, overrides=given, **options)


NONE, TINY, NINE = "lrm=none", "lrm=tiny", "model=nine_planes"
SMALL = ("model.rays.per_batch=1365", "model.rays.samples_per_batch=8192")
"""The CPU's batch; on a GPU X-Planes has a larger one of its own."""
LOOKS = [round(second / LEGO_SECONDS, 4) for second in (1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 45)]
LEGO = (
    NONE,
    f"trainer.max_seconds={LEGO_SECONDS}",
    f"callbacks.evaluation.at={LOOKS}".replace(" ", ""),
    "trainer.limit_val_batches=8",
)
NO_KERNELS = (("XPLANES_GPU_KERNELS", "0"),)

PARTS = (
    Part("kernels", "plane lookup", measure_lookup, needs_gpu=False, need=60, limit=150),
    Part("kernels", "products of planes", measure_products, needs_gpu=False),
    Part("kernels", "compositing", measure_compositing, needs_gpu=False),
    Part("kernels", "marching", measure_marching, needs_gpu=False),
    training("random, GPU", NONE, "gpu", rays_of_the_cpu=True),
    training("random, CPU", NONE, "cpu", needs_gpu=False, need=60, limit=120),
    throughput("six planes", NONE),
    Part("lego", "six planes", overrides=LEGO, need=110, limit=180),
    Part("step", "six planes", measure_step, needs_gpu=False, overrides=(NONE,)),
    Part("preparation", "LRM and decomposition", measure_preparation, needs_gpu=False),
    training("tiny, GPU", TINY, "gpu", rays_of_the_cpu=True),
    training("tiny, CPU", TINY, "cpu", need=60, limit=120),
    throughput("six planes, small batches", *SMALL, NONE),
    throughput("nine planes", NINE, NONE),
    throughput("nine planes, small batches", *SMALL, NINE, NONE),
    training("random, GPU, rays drawn there", NONE, "gpu"),
    throughput("six planes, torch", NONE, environment=NO_KERNELS),
    training("random, GPU, bfloat16 decoder", NONE, "gpu", "bf16"),
    throughput("K-Planes", "model=kplanes"),
)
"""The most telling first, in case the minutes run out."""

SECTIONS = tuple(dict.fromkeys(part.section for part in PARTS))


def one_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]


def work_apart(name: str, args: argparse.Namespace) -> int:
    """What a part's own process does."""
    part = next(part for part in PARTS if part.name == name)
    record = Record(args.record)
    try:
        if "trainer.accelerator=cpu" not in part.overrides and torch.cuda.is_available():
            found = torch.cuda.get_device_properties(0)
            record.device = (
                f"{found.name}, {found.total_memory / 2**30:.0f} GiB, compute capability "
                f"{found.major}.{found.minor}, CUDA {torch.version.cuda}"
            )
        part.work(record, part, args)
    except Exception as error:
        traceback.print_exc()
        record.error = one_line(error)
    record.save()
    return bool(record.error)


@dataclass
class Outcome:
    """How a part went.

    Attributes:
        part: The part.
        record: What it found; None where it was not begun.
        left_out: Why there is nothing of it, or not all.
    """

    part: Part
    record: Record | None = None
    left_out: str = ""


def run_part(part: Part, args: argparse.Namespace, *, gpu: bool, left: float) -> Outcome:
    """Run a part in a process of its own for ``left`` seconds at most, and read what it found."""
    path, log = (args.work / f"{PARTS.index(part)}.{kind}" for kind in ("json", "log"))
    words = ["--part", part.name, "--work", args.work, "--record", path, "--lego", args.lego]
    environment = {
        **os.environ,
        "TRITON_INTERPRET": "0" if gpu else "1",
        "PYTHONUNBUFFERED": "1",
        **dict(part.environment),
    }
    limit = min(part.limit, left)
    error = left_out = ""
    code = 0
    with log.open("w", encoding="utf-8") as file:
        try:
            code = subprocess.run(
                [sys.executable, str(Path(__file__).resolve()), *map(str, words)],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                timeout=limit,
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            if limit < part.limit:
                left_out = f"The minutes ran out {limit:.0f} s after it had begun"
            else:
                error = f"stopped after {limit:.0f} s"
    record = Record.load(path)
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    if code and not record.error:
        last = next((line.strip() for line in reversed(lines) if line.strip()), "none")
        error = f"ended with code {code}, last line: {last[:200]}"
    record.error = record.error or error
    if record.error:
        print("\n".join(lines[-40:]), file=sys.stderr)
    return Outcome(part, record, left_out)


def reason_to_leave_out(part: Part, args: argparse.Namespace, *, gpu: bool, left: float) -> str:
    """Why a part is not begun; empty if it is."""
    if part.needs_gpu and not gpu:
        return "No CUDA GPU was found"
    if part.section == "kernels" and importlib.util.find_spec("triton") is None:
        return "Triton is not installed (torch for CUDA on Linux brings it)"
    if part.section == "lego" and not (args.lego / "transforms_train.json").is_file():
        return (
            "No scene in the folder of --lego (default data/dnerf/lego; "
            "`xplanes download dnerf` gets it)"
        )
    if left < part.need:
        return "Too little was left of the minutes"
    return ""


# The page


FORMATS = {
    "relative": "{:.1e}",
    "us": "{:.1f} us",
    "ms": "{:.1f} ms",
    "calls": "{:.1f}",
    "times": "{:.1f}",
    "%": "{:.0f}%",
    "TB/s": "{:.2f} TB/s",
    "dB": "{:.2f} dB",
    "": "{:.4f}",
    "steps/s": "{:.1f}",
    "rays/s": "{:,.0f}",
    "samples/s": "{:,.0f}",
    "steps": "{:,.0f}",
    "s": "{:.1f} s",
    "GiB": "{:.2f} GiB",
}

TABLES = {
    "accuracy": (
        "Kernels against float64",
        "The largest difference from the readable twin in float64, over its largest value; "
        '"twin" is the same twin in float32. Gradients are those of the planes; in compositing, '
        "those of optical depths and colours. In marching, the share of samples that lie in other "
        f"cells than the twin's in float32. Kernels count as wrong above {TOLERANCE:g}.",
    ),
    "kernel time": (
        "Time of the kernels",
        f"Medians of {ROUNDS} runs by CUDA events, float32, planes at points along rays of {RAY} "
        'samples. "Twin" is plain torch in float32, for planes its `grid_sample`. "Of the copy": '
        "the bytes that must be moved (points, features, each plane once; in the backward "
        "gradients, and planes of gradients twice; in compositing each sample once) at the speed "
        "of a large copy, over the time taken.",
    ),
    "training": (
        f"{STEPS} steps on the GPU and on the CPU",
        "Excavator at 64 px, six planes, 8192 samples a step, the same seed and rays unless noted, "
        "decoder in float32 unless "
        'noted. Initialisation: "random" (`lrm=none`) or "tiny" (`lrm=tiny`). '
        "PSNR and SSIM are means over the test views. Steps/s and rays/s are of the training "
        "clock. Peak memory is the GPU's; in runs on the CPU, the process's.",
    ),
    "throughput": (
        "Steps per second",
        f"Excavator at 64 px, {SETTLED} s of training, random initialisation, default precision. "
        f"Steps/s leave the first {SHARE * SETTLED:g} s out; rays/s and samples/s are of the whole "
        "run. X-Planes has the batches of `model.rays.per_batch=auto` on a GPU, in small batches "
        f"those of the CPU (`{' '.join(SMALL)}`); K-Planes has 4096 rays. "
        '"torch": without Triton kernels.',
    ),
    "lego": (
        "lego at 400 px",
        f"D-NeRF's lego, val split, random initialisation, {LEGO_SECONDS} s of training; PSNR and "
        f'SSIM are means over the views. "To {GOAL:g} dB": '
        "seconds of training until the mean of 8 views, looked at after each second at first, "
        "reaches it.",
    ),
    "step": (
        "A training step",
        f"Six planes with default batches: the {KERNELS} longest kernels on a GPU, by torch's "
        "profiler. What is missing from the whole is the time in which the GPU waits. Without a "
        "GPU: operations on the CPU.",
    ),
    "preparation": (
        "Before training",
        "A second run each, with random images and planes. Times are of a frame for the LRMs and "
        "of the whole sequence [T, 3, C, H, H] for robust PCA.",
    ),
}

INITIALISATIONS = ("random", "tiny")

Figures = dict[tuple[str, str, str], Figure]


def gathered(outcomes: list[Outcome]) -> Figures:
    """All figures by table, row and column, with the differences between the devices."""
    found = {
        (figure.table, figure.row, figure.column): figure
        for outcome in outcomes
        if outcome.record is not None
        for figure in outcome.record.figures
    }
    for name in INITIALISATIONS:
        rows = [f"{name}, {device}" for device in ("GPU", "CPU")]
        gpu, cpu = (found.get(("training", row, "PSNR")) for row in rows)
        if gpu is not None and cpu is not None:
            key = "difference", name, "PSNR, GPU minus CPU"
            found[key] = Figure(*key, gpu.value - cpu.value, "dB")
    return found


def table(figures: Figures, name: str) -> str:
    """One table of the page; empty if nothing was measured for it."""
    mine = [figure for figure in figures.values() if figure.table == name]
    rows, columns = (list(dict.fromkeys(f[place] for f in mine)) for place in (1, 2))
    if len(columns) == 0:
        return ""

    def cell(row: str, column: str) -> str:
        figure = figures.get((name, row, column))
        return "" if figure is None else FORMATS[figure.unit].format(figure.value)

    lines = [(row, *(cell(row, column) for column in columns)) for row in rows]
    return markdown(("", *columns), lines)


def findings(figures: Figures) -> list[str]:
    """The page in a few sentences."""
    errors = [f.value for f in figures.values() if f.table == "accuracy" and "kernels" in f.column]
    good = sum(error <= TOLERANCE for error in errors)
    lines = [f"Kernels: {good} of {len(errors)} errors are below {TOLERANCE:g}."] if errors else []
    for label in ("forward", "backward"):
        ending = f"{POINTS[-1]} points, {label}"
        times = [f for f in figures.values() if f.column == "times faster"]
        if gains := [f.value for f in times if f.row.endswith(ending)]:
            lines.append(
                f"Kernels at {POINTS[-1]:,} points, {label}: {min(gains):.1f} to {max(gains):.1f} "
                "times as fast as torch."
            )
    for name in INITIALISATIONS:
        rows = [("training", f"{name}, {device}") for device in ("GPU", "CPU")]
        if not all((*row, "PSNR") in figures for row in rows):
            continue
        (gpu, cpu), (fast, slow) = (
            [figures[*row, column].value for row in rows] for column in ("PSNR", "steps/s")
        )
        verdict = "within" if abs(gpu - cpu) <= AGREE else "not within"
        lines.append(
            f"{STEPS} steps ({name}): {gpu:.2f} dB on the GPU, {cpu:.2f} dB on the CPU. The "
            f"difference of {gpu - cpu:+.2f} dB is {verdict} {AGREE:g} dB. {fast:.1f} against "
            f"{slow:.1f} steps/s."
        )
    if ("lego", "six planes", "PSNR") in figures:
        psnr, ssim = (figures["lego", "six planes", name].value for name in ("PSNR", "SSIM"))
        lines.append(f"lego at 400 px, {LEGO_SECONDS} s: {psnr:.2f} dB, SSIM {ssim:.4f}.")
    reached = figures.get(("lego", "six planes", f"to {GOAL:g} dB"))
    if reached is not None and not math.isnan(reached.value):
        lines.append(f"lego at 400 px comes to {GOAL:g} dB in {reached.value:.1f} s.")
    return lines


def bullets(title: str, lines: list[str]) -> list[str]:
    """A list below a title, as a paragraph or two of the page; nothing without lines."""
    heading = [f"## {title}"] if title else []
    return [*heading, "\n".join(f"* {line}" for line in lines)] if lines else []


def grouped(pairs: Iterable[tuple[str, str]], form: str) -> list[str]:
    """A line for each text, with the names that it goes with."""
    names: dict[str, list[str]] = {}
    for text, name in pairs:
        names.setdefault(text, []).append(name)
    return [form.format(text, "; ".join(found)) for text, found in names.items()]


def compose_page(outcomes: list[Outcome], minutes: float, *, gpu: bool) -> str:
    """The page about what is known so far."""
    records = [(o.part, o.record) for o in outcomes if o.record is not None]
    figures = gathered(outcomes)
    devices = [record.device for _, record in records if record.device]
    device = devices[0] if devices else "A GPU without a name" if gpu else "No CUDA GPU was found"
    spent = (time.monotonic() - BEGAN) / 60
    failed = [f"{part.name}: {record.error}" for part, record in records if record.error]
    parts = [
        f"# GPU: kernels, training, throughput\n\n{device}; {machine()}. `{command()}` took "
        f"{spent:.1f} min, {minutes:g} at most. Each part ran in a process of its own."
    ]
    if not gpu:
        parts.append(
            "This is the reduced version for machines without a GPU. The kernels ran in Triton's "
            f"interpreter on {FEW} points, which says nothing of their time or of the compiled "
            "code. Training ran on the CPU."
        )
    parts += bullets("In short", findings(figures))
    parts += bullets("Failed", failed)
    left_out = [(outcome.left_out, outcome.part.name) for outcome in outcomes if outcome.left_out]
    parts += bullets("Left out", grouped(left_out, "{}: {}."))
    notes = [note for _, record in records for note in record.notes]
    for name, (title, words) in TABLES.items():
        if lines := table(figures, name):
            parts.append(f"## {title}\n\n{words}\n\n{lines}")
            said = [(text, row) for place, text, row in notes if place == name]
            parts += bullets("", grouped(said, "{} ({})."))
    return "\n\n".join(parts) + "\n"


def write(outcomes: list[Outcome], out: Path, minutes: float, *, gpu: bool) -> str:
    """Write page and CSV, and give the page."""
    page = compose_page(outcomes, minutes, gpu=gpu)
    write_text(out / "gpu.md", page)
    rows = [
        (figure.table, f"{figure.row}: {figure.column}", f"{figure.value:.6g}", figure.unit)
        for figure in gathered(outcomes).values()
    ]
    write_rows(out / "gpu.csv", ("part", "name", "value", "unit"), rows)
    return page


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path, default=Path("data/dnerf/lego"))
    parser.add_argument("--minutes", type=float, default=10, help="for all parts together")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of page and CSV")
    for hidden in ("--part", "--work", "--record"):
        kind = str if hidden == "--part" else Path
        parser.add_argument(hidden, type=kind, help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.part:
        return work_apart(args.part, args)
    require_writable(args.out)
    gpu = torch.cuda.is_available()
    minutes = args.minutes if gpu else min(args.minutes, CPU_MINUTES)
    deadline = BEGAN + 60 * minutes - RESERVE
    outcomes, page = [], ""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as work:
        args.work = Path(work)
        for part in PARTS:
            if part.section not in args.only:
                continue
            left = deadline - time.monotonic()
            outcome = Outcome(part, None, reason_to_leave_out(part, args, gpu=gpu, left=left))
            if not outcome.left_out:
                began = time.monotonic()
                print(f"{part.name} ...", flush=True)
                outcome = run_part(part, args, gpu=gpu, left=left)
                spent = time.monotonic() - began
                said = outcome.left_out or (outcome.record and outcome.record.error) or "done"
                print(f"    {said}, {spent:.0f} s", flush=True)
            outcomes.append(outcome)
            # After each part, so that a machine that is taken away leaves a page.
            page = write(outcomes, args.out, minutes, gpu=gpu)
    print(f"\n{page}")
    return int(any(o.record is not None and bool(o.record.error) for o in outcomes))


if __name__ == "__main__":
    sys.exit(main())
