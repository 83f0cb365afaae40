"""Decoding to the cache of images: killed, and asked for twice at once."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.faults.conftest import ROOT
from xplanes.files import MARK
from xplanes.scenes.images import load_images

pytestmark = pytest.mark.stress

DECODE = """
import sys, time
from pathlib import Path
from xplanes.scenes import images, store
from xplanes.scenes.images import native_sizes, read_images

store.IN_MEMORY, read, pause = 0, images.read_image, float(sys.argv[3])
calls = []

def slow(*arguments):
    calls.append(1)
    time.sleep(pause)
    return read(*arguments)

images.read_image = slow
paths = sorted(Path(sys.argv[1]).iterdir())
found = read_images(paths, native_sizes(paths), cache=Path(sys.argv[2]))
print(sum(int(found.image(i).sum()) for i in range(found.shape[0])), len(calls))
"""
"""Decodes slowly; prints the sum of all pixels, and how many images it decoded."""


def start(scene: Path, cache: Path, pause: float) -> subprocess.Popen[str]:
    arguments = [sys.executable, "-c", DECODE, str(scene), str(cache), str(pause)]
    return subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def test_killed_and_at_once(tally, tmp_path: Path) -> None:
    """kill -9 while images are decoded to the cache, then two processes that want them"""
    scene, cache = tmp_path / "scene", tmp_path / "cache"
    scene.mkdir()
    draw = np.random.default_rng(0)
    for number in range(8):
        pixels = draw.integers(0, 256, (65, 65, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(scene / f"{number}.png")
    expected = int(load_images(sorted(scene.iterdir()), None).sum())

    def unfinished() -> list[Path]:
        return list(cache.glob(f".*{MARK}*"))

    victim = start(scene, cache, 0.5)
    deadline = time.monotonic() + 60
    while not unfinished():
        assert time.monotonic() < deadline
        assert victim.poll() is None
        time.sleep(0.01)
    os.kill(victim.pid, signal.SIGKILL)
    victim.communicate()
    assert len(unfinished()) == 1
    assert not list(cache.glob("[!.]*.pixels"))
    both = [start(scene, cache, 0.1) for _ in range(2)]
    said = [process.communicate(timeout=120)[0].splitlines()[-1] for process in both]
    # One decoded all images, the other waited for them.
    assert sorted(said) == [f"{expected} 0", f"{expected} 8"]
    assert not unfinished()
    tally.recovered()
