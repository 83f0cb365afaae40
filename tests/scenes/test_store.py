"""Images in a file of pixels: the same as in memory, drawn evenly, whatever happens."""

import copy
import errno
import os
import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock

from tests.balls import RAYS as NEAR
from tests.balls import ball_views, surrounding
from tests.captures import save
from tests.scenes.common import assert_even, drawn_pixels, numbered, same, stored
from xplanes.errors import SceneError
from xplanes.files import DAY, MARK, StorageError
from xplanes.readers.images import Picture, final_sizes, native_sizes
from xplanes.readers.images import read_images as read_sized
from xplanes.scenes import store
from xplanes.scenes.batches import AHEAD, RayBatches
from xplanes.scenes.frame import cube_frame
from xplanes.scenes.lenses import Lenses, LensModel
from xplanes.scenes.matte import silhouette_of
from xplanes.scenes.store import RUN, StoredImages
from xplanes.scenes.views import Intrinsics, Views, joined

FRAME = cube_frame(1.4, torch.zeros(3))
RAYS = replace(NEAR, per_batch=1000, skip_background=False)


def pictures(folder: Path, sizes, *, alpha: bool) -> list[Path]:
    """Noise as PNG files of some heights and widths."""
    draw = np.random.default_rng(0)
    paths = [folder / f"{index:03d}.png" for index in range(len(sizes))]
    for path, size in zip(paths, sizes, strict=True):
        save(path, draw.integers(0, 256, (*size, 4 if alpha else 3), dtype=np.uint8))
    return paths


def read_images(paths: list[Path], resolution: int | None = None, cache: Path | None = None):
    native = native_sizes(paths)
    sizes = final_sizes(paths, native, resolution)
    return read_sized([*map(Picture, paths, sizes)], cache), native, sizes


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """All images are too large for memory."""
    monkeypatch.setattr(store, "IN_MEMORY", 0)


@pytest.fixture
def paths(tmp_path: Path, small: None) -> list[Path]:
    """Six small images, which are too large for memory."""
    return pictures(tmp_path / "scene", [(65, 65)] * 6, alpha=False)


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


@pytest.fixture
def users_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where images are stored if no cache is named."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr("sys.platform", "linux")
    return tmp_path / "home" / "xplanes" / "images"


SIZES = [(130, 70), (64, 64), (63, 129), (1, 1)]


@pytest.mark.parametrize("alpha", [False, True])
def test_a_file_holds_the_pixels_of_memory(tmp_path, monkeypatch, alpha):
    paths = pictures(tmp_path / "scene", SIZES, alpha=alpha)
    expected, native, sizes = read_images(paths, None)
    monkeypatch.setattr(store, "IN_MEMORY", 4 * 4 * 130 * 129 - 1)
    images, *rest = read_images(paths, cache=tmp_path / "cache")
    assert isinstance(images, StoredImages)
    assert rest == [native, sizes] == [SIZES, SIZES]
    assert images.shape == expected.shape
    for index, (height, width) in enumerate(SIZES):
        assert torch.equal(images.image(index), expected[index, :height, :width]), index
    ((file, _), *_) = images.places
    assert file.channels == (4 if alpha else 3)
    assert images.nbytes == sum(height * width for height, width in SIZES) * file.channels
    for index in range(4 if alpha else 0):
        seen = silhouette_of(expected[index, : SIZES[index][0], : SIZES[index][1], 3])
        assert torch.equal(images.silhouette(index), seen), index
    backwards = images[torch.tensor([2, 0])]
    assert torch.equal(backwards.image(0), images.image(2))
    if hasattr(os, "pread"):  # Forked processes share the position: reading must not move it.
        assert file._file.tell() == 0
        monkeypatch.delattr(os, "pread")
        assert torch.equal(images.image(2), backwards.image(0))
        assert file._file.tell() > 0
    assert backwards.shape == (2, 130, 129, 4)
    assert torch.equal(copy.deepcopy(backwards).image(1), images.image(0))
    monkeypatch.setattr(store, "IN_MEMORY", 4 * 4 * 130 * 129)
    assert isinstance(read_images(paths, None)[0], torch.Tensor)


def test_reduced_images_are_the_same_too(tmp_path, small):
    paths = pictures(tmp_path / "scene", [(70, 70)] * 2, alpha=True)
    images, _, sizes = read_images(paths, 66, tmp_path / "cache")
    assert sizes == [(66, 66)] * 2
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "IN_MEMORY", 2**20)
        expected = read_images(paths, 66)[0]
    assert torch.equal(images.image(1), expected[1])


def test_views_in_a_file_tell_the_same_as_views_in_memory():
    views = ball_views(6, 0.6, size=150)
    tiled = stored(views)
    assert tiled.is_stored
    assert not tiled.is_opaque
    assert (tiled.height, tiled.width, tiled.pixels) == (150, 150, views.pixels)
    white = torch.ones(3)
    for index in range(len(views)):
        assert torch.equal(tiled.composite(index, white), views.composite(index, white))
    assert torch.equal(tiled.in_memory(), views.images)
    full = replace(views, images=torch.full_like(views.images, 255))
    assert stored(full).is_opaque
    both = joined(views, tiled.subset(torch.tensor([1])))
    assert both.is_stored
    assert torch.equal(both.image(6), views.image(1))
    assert torch.equal(both.image(5), views.image(5))
    again = joined(tiled, both)
    assert len(again) == 13
    assert torch.equal(again.image(12), views.image(1))
    assert tiled.identity != both.identity


def sized(sizes) -> Views:
    """Views of some heights and widths."""
    size = torch.tensor(sizes)
    intrinsics = Intrinsics(torch.full((len(sizes), 2), 90.0), 0.5 * size.flip(1).double(), size)
    blank = torch.zeros(len(sizes), *size.amax(dim=0), 4, dtype=torch.uint8)
    files = tuple(map(str, range(len(sizes))))
    times = torch.linspace(0, 1, len(sizes))
    return Views(blank, surrounding(len(sizes), 4.0), times, intrinsics, files)


def test_every_pixel_is_drawn_as_often_as_any_other():
    views = stored(numbered(sized([(70, 130), (33, 64), (64, 5)])))
    batches = RayBatches(views, FRAME, replace(RAYS, per_batch=3000), seed=0)
    counts = drawn_pixels(batches, 120)
    assert not counts[~views.valid()].any()
    assert counts[views.valid()].min() > 0
    # Pixels of one run are drawn together, which does not change how often, but spreads the counts
    # of whole runs.
    first = counts[0, :70, :130].flatten()
    expected = 120 * 3000 / views.pixels
    for run in (first[:RUN], first[RUN : 2 * RUN], counts[1, :33, :64]):
        assert float(run.mean()) == pytest.approx(expected, rel=0.15)
    assert_even(first[:RUN])


def test_no_pixel_is_drawn_that_a_fisheye_lens_leaves_dark():
    views = sized([(80, 80)] * 2)
    lenses = replace(Lenses.pinholes(2), model=torch.full((2,), int(LensModel.FISHEYE)), limit=None)
    intrinsics = replace(views.intrinsics, focal=torch.full((2, 2), 16.0), lenses=lenses)
    shown = intrinsics.has_ray(0)
    assert 0.5 < shown.float().mean() < 0.99
    views = numbered(replace(views, intrinsics=intrinsics))
    views.images[:, ~shown] = 0
    views = stored(views)
    assert views.is_opaque
    batches = RayBatches(views, FRAME, RAYS, seed=0)
    assert batches.near_pixels + batches.far_pixels == 2 * int(shown.sum())
    counts = drawn_pixels(batches, 60)
    assert not counts[:, ~shown].any()
    assert counts.sum(dim=0)[shown].min() > 0


def test_runs_far_from_silhouettes_get_the_asked_share():
    in_memory = ball_views(3, 0.15, size=400)
    views = stored(in_memory)
    for share in (0.0, 0.2):
        shares = {"background_share": share, "background_jitter": 0.2}
        settings = replace(RAYS, skip_background=True, **shares)
        batches = RayBatches(views, FRAME, settings, seed=0)
        # Silhouettes are widened by whole squares of 8 pixels.
        exact = RayBatches(in_memory, FRAME, settings, seed=0)
        assert exact.near_pixels < batches.near_pixels < 1.6 * exact.near_pixels
        assert batches.near_pixels + batches.far_pixels == views.pixels
        natural = batches.far_pixels / views.pixels
        assert batches.skipped == pytest.approx(natural - share)
        moved = lit = 0.0
        for step in range(30):
            batch = batches.draw(step)
            # Of three views, those at the ends of time stay for half of the moves.
            other = ~torch.isin(batch["times"], views.times)
            moved += float(other.float().mean()) / 30
            lit += float((batch["alpha"] > 0).float().mean()) / 30
            assert not batch["alpha"][other].any()
        assert moved == pytest.approx(share * 2 / 3, abs=0.05)
        shown = float((in_memory.images[..., 3] > 0).float().mean())
        assert lit == pytest.approx((1 - share) * shown / (1 - natural), rel=0.1)


def test_a_batch_from_a_file_depends_on_seed_step_and_rank_alone(paths, cache):
    views = replace(ball_views(6, 0.5, size=65), images=read_images(paths, cache=cache)[0])
    settings = replace(RAYS, background="random")
    used = RayBatches(views, FRAME, settings, seed=3)
    for step in (0, 1, 2, 70, 5):
        used.draw(step)
    for step in (0, 1, AHEAD, 10**9):
        fresh = RayBatches(views, FRAME, settings, seed=3)
        assert same(fresh.draw(step), used.draw(step)), step
    for seed, rank in ((4, 0), (3, 1)):
        other = RayBatches(views, FRAME, settings, seed=seed, rank=rank).draw(0)
        assert not torch.equal(other["directions"], used.draw(0)["directions"])
    # Few rays come from as many runs as they can.
    few = RayBatches(views, FRAME, replace(RAYS, per_batch=7), seed=0).draw(0)
    assert len(few["times"]) == 7


def test_runs_of_coming_steps_are_announced_once(monkeypatch):
    views = stored(ball_views(3, 0.5, size=200))
    told: list[tuple[int, int]] = []
    read: list[tuple[int, int]] = []
    of_runs = StoredImages.pixels

    def prefetch(self, view, run):
        told.extend(zip(view.tolist(), run.tolist(), strict=True))

    def pixels(self, view, run, inside):
        read.extend(zip(view.tolist(), run.tolist(), strict=True))
        return of_runs(self, view, run, inside)

    monkeypatch.setattr(StoredImages, "prefetch", prefetch)
    monkeypatch.setattr(StoredImages, "pixels", pixels)
    batches = RayBatches(views, FRAME, RAYS, seed=0)
    for step in range(5, 9):
        batches.draw(step)
    per_step = len(read) // 4
    assert len(told) == (3 + AHEAD) * per_step
    assert told[: 3 * per_step] == read[per_step:]


def private_bytes() -> int:
    """Memory of this process alone."""
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return 1024 * sum(int(line.split()[1]) for line in lines if line.startswith("Private_"))


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").is_file(), reason="needs Linux's /proc")
def test_drawing_takes_no_memory_of_the_images(tmp_path, small, cache, capsys):
    size, count = (1024, 1024), 20
    (tmp_path / "source").write_bytes(b"")
    whole = 3 * count * size[0] * size[1]  # 63 MB
    before = private_bytes()

    def job(index):
        return lambda: [(index, np.full((*size, 3), index, np.uint8))]

    jobs = [job(i) for i in range(count)]
    source = [tmp_path / "source"]
    images = store.images([size] * count, jobs, source, "test", lambda: False, cache)
    poses = ball_views(count, 0.5, size=4)
    views = Views(images, poses.camera_to_world, poses.times, 1000.0, poses.files)
    batches = RayBatches(views, FRAME, RAYS, seed=0)
    for step in range(100):
        batches.draw(step)
    assert images.nbytes == whole
    assert private_bytes() - before < whole / 3
    said = capsys.readouterr().out
    for words in ("20 images of up to 1024x1024 px", "0.1 GB", str(cache)):
        assert words in said


def test_the_cache_is_used_again_until_a_source_changes(tmp_path, paths, cache, capsys):
    first = read_images(paths, cache=cache)[0]
    said = capsys.readouterr().out
    assert "decoding" in said
    assert "without use" not in said, "a cache that is named is the user's to clean"
    again = read_images(paths, cache=cache)[0]
    assert not capsys.readouterr().out
    assert again.identity == first.identity
    (old,) = cache.glob("*.pixels")
    os.utime(old, (0, 0))
    save(paths[1], np.full((65, 65, 3), 9, np.uint8))
    changed = read_images(paths, cache=cache)[0]
    assert (changed.image(1)[..., :3] == 9).all()
    assert torch.equal(changed.image(0), first.image(0))
    # One second later with the same content is another file, too.
    os.utime(paths[2], ns=(0, 10**9))
    assert read_images(paths, cache=cache)[0].identity != changed.identity
    assert len(list(cache.glob("*.pixels"))) == 3
    assert sorted((tmp_path / "scene").iterdir()) == paths


def test_a_file_that_was_cut_off_is_made_anew(paths, cache):
    images = read_images(paths, cache=cache)[0]
    (path,) = cache.glob("*.pixels")
    expected = images.image(2)
    os.truncate(path, 1000)
    with pytest.raises(StorageError, match=r"ends too early.*Delete it"):
        images.image(2)
    assert torch.equal(read_images(paths, cache=cache)[0].image(2), expected)


def test_a_damaged_image_leaves_nothing_behind(paths, cache):
    content = paths[1].read_bytes()
    paths[1].write_bytes(content[: len(content) // 2])
    with pytest.raises(SceneError, match=r"001\.png cannot be decoded"):
        read_images(paths, cache=cache)
    assert not [path for path in cache.iterdir() if path.suffix != ".lock"]
    paths[1].write_bytes(content)
    assert read_images(paths, cache=cache)[0].shape[0] == 6


def test_a_disk_without_space_is_refused_first(paths, cache, monkeypatch):
    usage = shutil.disk_usage(cache.parent)._replace(free=2**28 + 100)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(StorageError, match=r"0\.3 GB free.*data\.cache"):
        read_images(paths, cache=cache)
    assert not list(cache.glob("*.pixels"))


def test_what_no_run_has_used_for_a_month_is_removed(paths, users_cache, capsys):
    cache = users_cache
    read_images(paths[:1])
    assert "after 30 days without use" in capsys.readouterr().out
    (old,) = cache.glob("*.pixels")

    def aged(path: Path, days: float) -> Path:
        if not path.exists():
            path.write_bytes(b"pixels")
        past = time.time() - days * DAY
        os.utime(path, (past, past))
        return path

    locked = aged(cache / f"{'1' * 32}.pixels", 31)
    kept = [
        locked,
        aged(cache / f"{'2' * 32}.pixels", 29),
        aged(cache / "mine.pixels", 99),
        aged(cache / f"{'3' * 32}.npy", 99),
        aged(cache / f".{'4' * 32}.pixels{MARK}x", 0.5),
    ]
    gone = [
        aged(cache / f"{'7' * 32}.tiles", 31),  # Of an earlier version.
        aged(cache / f".{'5' * 32}.pixels{MARK}x", 2),
        aged(cache / f"{'6' * 32}.pixels", 31),
    ]
    # Use makes a file young again.
    aged(old, 31)
    images = read_images(paths[:1])[0]
    with FileLock(locked.with_suffix(".lock")):
        read_images(paths[1:3])
    assert [path for path in [old, *kept, *gone] if path.exists()] == [old, *kept]
    assert "removed 0.0 GB of decoded images" in capsys.readouterr().out
    # A reader keeps what it has opened; the next one decodes it again.
    aged(old, 31)
    expected = images.image(0).clone()
    read_images(paths[3:])
    assert not old.exists()
    assert not locked.exists()
    assert torch.equal(images.image(0), expected)
    assert torch.equal(read_images(paths[:1])[0].image(0), expected)


def test_an_interrupted_decoder_stops_soon(tmp_path, small, cache):
    source = tmp_path / "source"
    source.write_bytes(b"")
    begun = threading.Event()

    def slow():
        for index in range(100):
            begun.set()
            time.sleep(0.02)
            yield index, np.zeros((4, 4, 3), np.uint8)

    def broken():
        begun.wait()
        raise SceneError("camera 7 is damaged")
        yield

    began = time.monotonic()
    with pytest.raises(SceneError, match="camera 7"):
        store.images([(4, 4)] * 101, [slow, broken], [source], "", lambda: False, cache)
    assert time.monotonic() - began < 1.5


def test_a_cache_that_cannot_be_written_is_read_or_named(paths, cache, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    first = read_images(paths, cache=cache)[0]
    assert isinstance(first, StoredImages)
    monkeypatch.setattr(os, "utime", refuse)  # As on a read-only disk.
    again = read_images(paths, cache=cache)[0]
    assert isinstance(again, StoredImages)
    assert torch.equal(again.image(1), first.image(1))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    for home in (lambda: paths[0], homeless):
        monkeypatch.setattr(Path, "home", home)
        with pytest.raises(StorageError, match=r"cannot be written: .*data\.cache sets"):
            read_images(paths)
    assert read_images(paths, cache=cache)[0].image(0).shape == (65, 65, 4)
