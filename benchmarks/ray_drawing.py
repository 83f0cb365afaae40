"""Seconds of drawing rays from images on disk, and their share of a training step.

    python benchmarks/ray_drawing.py [--gigabytes 2] [--step-ms 25] [--cache FOLDER]

Writes results/ray_drawing.md and ray_drawing.csv beside this file. Frames of noise are written to a
file and removed again. Between draws the script waits for the rest of a step, in which the
system reads what was announced; "cold" drops the file from the system's cache at the beginning.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from runner import RESULTS, command, machine, markdown

from xplanes.files import write_rows, write_text
from xplanes.scenes import store
from xplanes.scenes.batches import RayBatches
from xplanes.scenes.cameras import orbit
from xplanes.scenes.datamodule import UNIFORM
from xplanes.scenes.frame import cube_frame
from xplanes.scenes.store import StoredImages
from xplanes.scenes.views import Views

SIZE = (1014, 1352)
STEPS = 150
COLUMNS = ("images", "median ms", "95th percentile ms", "share of a step", "private MB")


def frames(first: int, count: int) -> Iterator[tuple[int, np.ndarray]]:
    """Noise that differs from frame to frame. uint8 [h, w, 3] each"""
    noise = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    for number in range(first, first + count):
        yield number, np.roll(noise, number, axis=1)


def private_bytes() -> int:
    """Memory of this process alone (USS)."""
    lines = Path("/proc/self/smaps_rollup").read_text(encoding="utf-8").splitlines()
    return 1024 * sum(int(line.split()[1]) for line in lines if line.startswith("Private_"))


def views_of(images: torch.Tensor | StoredImages) -> Views:
    count = images.shape[0]
    poses = orbit(count, radius=4.0, elevation=20.0)
    names = tuple(str(number) for number in range(count))
    return Views(images, poses, torch.linspace(0, 1, count), 1400.0, names)


def measure(name: str, batches: RayBatches, pause: float, before: Callable[[], None]) -> list[str]:
    """One line of the table."""
    batches.draw(10**6)
    before()
    spent = []
    for step in range(STEPS):
        began = time.perf_counter()
        batches.draw(step)
        spent.append(time.perf_counter() - began)
        time.sleep(max(0.0, pause - spent[-1]))
    median, high = statistics.median(spent), sorted(spent)[int(0.95 * STEPS)]
    return [
        name,
        f"{1000 * median:.2f}",
        f"{1000 * high:.2f}",
        f"{median / pause:.1%}",
        f"{private_bytes() / 2**20:.0f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--gigabytes", type=float, default=2)
    parser.add_argument("--step-ms", type=float, default=25)
    parser.add_argument(
        "--cache", type=Path, help="folder of the file; a temporary one if left out"
    )
    args = parser.parse_args()
    pause, frame = args.step_ms / 1000, cube_frame(4.0, torch.zeros(3))
    count = max(8, round(args.gigabytes * 2**30 / (3 * SIZE[0] * SIZE[1])))
    rows = [["none (process only)", "", "", "", f"{private_bytes() / 2**20:.0f}"]]
    limit = store.IN_MEMORY
    with tempfile.TemporaryDirectory(dir=args.cache) as place:
        source = Path(place) / "source"
        source.write_bytes(b"")
        per_job = -(-count // 8)
        jobs = [
            lambda first=first: frames(first, min(per_job, count - first))
            for first in range(0, count, per_job)
        ]
        began = time.perf_counter()
        store.IN_MEMORY = 0
        images = store.images(
            [SIZE] * count, jobs, [source], "benchmark", lambda: False, Path(place)
        )
        writing = time.perf_counter() - began
        file = next(Path(place).glob("*.pixels"))

        def drop() -> None:
            with file.open("rb") as handle:
                os.fsync(handle.fileno())
                os.posix_fadvise(handle.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)

        def warm() -> None:
            with file.open("rb") as handle:
                while handle.read(2**24):
                    pass

        settings = replace(UNIFORM, background="random")
        views = views_of(images)
        batches = RayBatches(views, frame, settings, seed=0)
        prefetched = batches.views.images
        assert isinstance(prefetched, StoredImages)
        rows.append(measure("on disk, cold", batches, pause, drop))
        rows.append(measure("on disk, in the system's cache", batches, pause, warm))
        silent = RayBatches(views, frame, settings, seed=0)
        silent._prefetch = lambda step, rays: None  # type: ignore[method-assign]
        rows.append(measure("on disk, cold, without prefetching", silent, pause, drop))
        size = file.stat().st_size
        del batches, silent, prefetched, views, images
    store.IN_MEMORY = limit
    held = store.in_memory([SIZE] * 32, [lambda: frames(0, 32)])
    small = RayBatches(views_of(held), frame, settings, seed=0)
    rows.append(measure("32 images in memory", small, pause, lambda: None))
    write_rows(RESULTS / "ray_drawing.csv", COLUMNS, rows)
    page = f"""# Drawing rays from images on disk

{count} images of {SIZE[1]} x {SIZE[0]} pixels without alpha, {size / 2**30:.1f} GB in one
file, written in {writing:.0f} s; {settings.per_batch} rays per batch; a training step is assumed to
take {args.step_ms:g} ms; {STEPS} steps, warm-up included; {machine()}, load average
{os.getloadavg()[0]:.1f}. `{command()}`

{markdown(COLUMNS, rows)}

"private MB": memory of the process alone (USS) after the draws. Images in memory, for
scenes of up to {store.IN_MEMORY / 2**30:g} GB, are sampled at scattered pixels.
"""
    write_text(RESULTS / "ray_drawing.md", page)
    print(page)


if __name__ == "__main__":
    main()
