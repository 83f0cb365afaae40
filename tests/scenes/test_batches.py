"""Ray batches: a function of seed, step and rank, right in every pixel, alike on all devices."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import fake_device
from tests.balls import RAYS, ball_views
from tests.scenes.common import same
from tests.scenes.test_intrinsics import mixed
from xplanes.errors import ConfigError
from xplanes.scenes.batches import DeviceBatches, RayBatches
from xplanes.scenes.frame import Frame, cube_frame
from xplanes.scenes.importance import MOST_TILES
from xplanes.scenes.silhouettes import foreground, textureless
from xplanes.streams import counted_uniform, step_generator

SQUARE = ball_views(5, 0.5, size=24)
FOCAL = float(SQUARE.intrinsics.focal[0, 0])
VIEWS = replace(SQUARE, images=SQUARE.images[:, 4:20].contiguous(), intrinsics=FOCAL)  # 16 x 24
FRAME = cube_frame(1.4, torch.zeros(3))


def batches_of(views=VIEWS, frame=FRAME, *, seed=0, rank=0, **options):
    return RayBatches(views, frame, replace(RAYS, **options), seed=seed, rank=rank)


@pytest.mark.parametrize("background", ["white", "one", "random"])
def test_a_batch_depends_on_its_step_alone(background):
    fresh, used = batches_of(background=background), batches_of(background=background)
    for step in (0, 17, 3, 10**9):
        used.draw(step)
    torch.manual_seed(5)
    torch.rand(100)
    state = torch.get_rng_state()
    for step in (0, 1, 17, 10**9):
        assert same(fresh.draw(step), used.draw(step)), step
    assert torch.equal(torch.get_rng_state(), state), "other numbers are drawn"


def test_neighbouring_generators_share_nothing():
    keys = [
        step_generator(seed, step, stream).initial_seed()
        for seed in (-1, 0, 1, 2**32 - 1, 2**63)
        for step in range(20)
        for stream in (0, 1, 2, 1_000_003)
    ]
    assert len(set(keys)) == len(keys)


def pixels_of(batch, views, frame=FRAME):
    """View, row and column of each ray: its camera's, and where it passes the image plane."""
    cameras = views.camera_to_world.double()
    origins = frame.to_world(batch["origins"])
    away = torch.cdist(origins.double(), cameras[:, :3, 3])
    assert away.amin(dim=1).max() < 1e-5
    view = away.argmin(dim=1)
    directions = (frame.to_world(batch["origins"] + batch["directions"]) - origins).double()
    right, up, back = (directions[:, None] @ cameras[view, :3, :3])[:, 0].T
    row = -up / -back * FOCAL + views.height / 2
    column = right / -back * FOCAL + views.width / 2
    return view, row.floor().long(), column.floor().long()


TURNED = Frame(0.3, torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), torch.ones(3))


@pytest.mark.parametrize("background", ["white", "random"])
@pytest.mark.parametrize("frame", [FRAME, TURNED], ids=["plain frame", "turned frame"])
def test_targets_are_the_pixels_that_the_rays_go_through(background, frame):
    generator = torch.Generator().manual_seed(0)
    colours = torch.randint(0, 256, VIEWS.images.shape, generator=generator, dtype=torch.uint8)
    colours[..., :3] = torch.minimum(colours[..., :3], colours[..., 3:])  # multiplied by alpha
    views = replace(VIEWS, images=colours)
    batch = batches_of(views, frame, background=background).draw(3)
    view, row, column = pixels_of(batch, views, frame)
    pixel = colours[view, row, column].double() / 255
    expected = pixel[:, :3] + (1 - pixel[:, 3:]) * batch["background"].double()
    assert (batch["target"].double() - expected).abs().max() < 1e-6
    torch.testing.assert_close(batch["directions"].norm(dim=-1), torch.ones(64))
    assert torch.equal(batch["times"], views.times[view])
    white = bool((batch["background"] == 1).all())
    assert white == (background == "white")
    if white:
        images = torch.stack([views.composite(i, torch.ones(3)) for i in range(len(views))])
        torch.testing.assert_close(batch["target"], images[view, row, column])


def test_one_background_is_shared_by_a_batch_and_changes_between_batches():
    batches = batches_of(background="one")
    first, second = batches.draw(0), batches.draw(1)
    assert (first["background"] == first["background"][0]).all()
    assert not torch.equal(first["background"], second["background"])
    empty = first["alpha"] == 0
    assert empty.any()
    assert torch.equal(first["target"][empty], first["background"][empty])


def floor_views(side=120):
    """A coloured square that moves over an opaque white floor, before background above it."""
    views = ball_views(6, 0.5, size=side)
    images = torch.full_like(views.images, 255)
    images[:, :30] = 0
    for index in range(6):
        square = images[index, 60:80, 10 + 10 * index : 40 + 10 * index]
        square[..., :3] = torch.tensor([200, 30, 60], dtype=torch.uint8)
    return replace(views, images=images)


def test_pixels_of_one_colour_with_all_around_them_are_plain():
    views = floor_views()
    images = views.images.clone()
    images[2, 100, 100, 0] = 251  # As even as JPEG leaves it.
    images[3, 100, 100, 0] = 240
    images[4, 100, 100, 3] = 254
    views, reach = replace(views, images=images), 4
    found = textureless(views, [reach] * 6)
    assert found.any()
    for view, row, column in found.nonzero()[::37].tolist():
        around = images[view, max(0, row - reach) : row + reach + 1]
        around = around[:, max(0, column - reach) : column + reach + 1].flatten(0, 1).int()
        assert (around.amax(dim=0) - around.amin(dim=0)).max() <= 4, (view, row, column)
        assert (around[:, 3] == 255).all(), (view, row, column)
    # What is two blocks away from any change is found.
    assert found[:, 92:96, 40:60].all()
    assert bool(found[2, 100, 100])
    assert not found[3:5, 100, 100].any()


DRAWN = {
    "a ball": (ball_views(5, 0.5, size=40), 1),
    "a plain floor": (floor_views(), 2),
    "images of two sizes": (mixed(4), 1),
}
"""Views, and how far around silhouettes pixels are near."""


@pytest.mark.parametrize("kind", DRAWN)
@pytest.mark.parametrize(("skip", "share"), [(False, 0.1), (True, 0.1), (True, 0.4), (True, 1)])
def test_pixels_of_each_kind_are_drawn_alike_and_have_the_share_asked_for(kind, skip, share):
    views, margin = DRAWN[kind]
    options = {"skip_background": skip, "background_share": share, "per_batch": 1000}
    batches = batches_of(views, seed=7, rank=2, **options)
    batch, generator = batches.draw(11), step_generator(7, 11, 2)
    uniform = torch.rand(1000, 3, generator=generator, dtype=torch.float64).numpy()
    margins, valid = [margin] * len(views), views.valid().numpy().ravel()
    near = foreground(views, margins).numpy().ravel()
    even = textureless(views, margins).numpy().ravel() & skip
    parts = (~near & valid, near & even & valid, near & ~even & valid)
    far, even, rest = map(np.flatnonzero, parts)
    natural = np.array([len(far), len(even)]) / views.pixels
    shares = np.minimum(natural, [share, 0.2]) if skip else natural
    assert batches.skipped == pytest.approx(float((natural - shares).sum()))
    ends = np.cumsum(shares)
    even = even if len(even) else rest  # Whose share is 0 then.
    pixel = np.select(
        [uniform[:, 0] < ends[0], uniform[:, 0] < ends[1]],
        [pool[(uniform[:, 1] * len(pool)).astype(int)] for pool in (far, even)],
        rest[(uniform[:, 1] * len(rest)).astype(int)],
    )
    colour = views.images.numpy().reshape(-1, 4)[pixel].astype(np.float32) / 255
    assert np.array_equal(batch["target"], colour[:, :3] + (1 - colour[:, 3:]))
    assert np.array_equal(batch["jitter"], uniform[:, 2].astype(np.float32))
    assert np.array_equal(
        batch["times"], views.times.numpy()[pixel // (views.height * views.width)]
    )
    moved = batches_of(views, seed=7, rank=2, background_jitter=0.2, **options).draw(11)
    shown = batch["alpha"] > 0
    assert torch.equal(moved["times"][shown], batch["times"][shown])


def test_only_rays_far_from_silhouettes_move_in_time_and_not_far():
    static = batches_of(per_batch=4000, background_share=0.3).draw(3)
    moved = batches_of(per_batch=4000, background_share=0.3, background_jitter=0.2).draw(3)
    for name in ("origins", "directions", "target", "jitter"):
        assert torch.equal(static[name], moved[name]), name
    change = moved["times"] - static["times"]
    shown = static["alpha"] > 0
    assert shown.any()
    assert not change[shown].any()
    # Two of the five views stand at an end of time, where half of all moves lead nowhere.
    assert (change != 0).float().mean() == pytest.approx(0.3 * 0.8, abs=0.03)
    assert change.abs().max() == pytest.approx(0.2, abs=0.01)
    assert abs(float(change[change != 0].mean())) < 0.02
    assert moved["times"].min() >= 0
    assert moved["times"].max() <= 1


def test_a_static_scene_has_no_other_times():
    static = replace(VIEWS, times=torch.zeros(len(VIEWS)))
    assert not batches_of(static, background_jitter=0.2).draw(0)["times"].any()


def test_batches_of_open_size_follow_the_device():
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    left_open = replace(RAYS, per_batch="auto", samples_per_batch="auto")
    assert (left_open.most_rays, left_open.most_samples) == (1365, 8192)
    assert left_open.on(cpu) is left_open
    assert len(batches_of(per_batch="auto").draw(0)["times"]) == 1365
    large = left_open.on(gpu)
    assert (large.per_batch, large.samples_per_batch) == (32768, 524288)
    assert (large.fitting(256, 4096), left_open.fitting(256, 4096)) == (32768, 512)
    few = replace(left_open, per_batch=16)
    assert (few.fitting(16, 160), left_open.fitting(100, 10**6)) == (16, 64)
    assert RAYS.on(gpu) == RAYS
    one_given = replace(left_open, per_batch=2048).on(gpu)
    assert (one_given.per_batch, one_given.samples_per_batch) == (2048, 524288)
    with pytest.raises(ConfigError, match="per_batch=many"):
        replace(RAYS, per_batch="many")


# On a device


CPU = torch.device("cpu")


def splitmix(key, place):
    """A number of the generator of Steele, Lea and Flood, in Python's whole numbers."""
    bits = (key + place * 0x9E3779B97F4A7C15) % 2**64
    bits = ((bits ^ bits >> 30) * 0xBF58476D1CE4E5B9) % 2**64
    bits = ((bits ^ bits >> 27) * 0x94D049BB133111EB) % 2**64
    return bits ^ bits >> 31


def test_numbers_are_those_of_splitmix():
    for seed, step, stream in itertools.product((0, 3), (0, 10**9), (0, 1_000_003)):
        key = step_generator(seed, step, stream).initial_seed()
        expected = [(splitmix(key, place) >> 11) / 2**53 for place in range(6)]
        found = counted_uniform(seed, step, stream, (2, 3), CPU)
        assert found.flatten().tolist() == expected, (seed, step, stream)


@pytest.mark.parametrize(
    ("slopes", "options"),
    [
        *((slopes, {"background": kind}) for slopes in (False, True) for kind in ("white", "one")),
        (True, {"background": "random"}),
        (False, {"background": "random", "error_share": 0.5}),
    ],
    ids=str,
)
def test_batches_have_the_same_bits_on_every_device(fake_gpu, slopes, options):
    batches = batches_of(background_jitter=0.1, seed=2, rank=1, **options)
    if slopes:
        batches.add_slopes()
    errors = torch.full((MOST_TILES,), 0.1)
    errors[[0, 3]] = torch.tensor([1.0, 0.5])
    here, there = DeviceBatches(batches, CPU), DeviceBatches(batches, fake_gpu)
    errors_there = errors.to(fake_gpu)
    for step in (0, 7, 10**9):
        with fake_device.counted() as counts:
            drawn = there.draw(step, 48, errors_there)
        assert counts.totals[1:] == (0, 0)
        assert {value.device for value in drawn.values()} == {fake_gpu}
        expected = here.draw(step, 48, errors)
        assert same({name: value.cpu() for name, value in drawn.items()}, expected)
        assert len(drawn["times"]) == 48
        # Errors from a checkpoint may lie on the host.
        assert same(drawn, there.draw(step, 48, errors))
    assert here.draw(3).keys() == batches.draw(3).keys()
    assert not torch.equal(here.draw(3)["jitter"], here.draw(4)["jitter"])


def test_batches_are_distributed_like_those_of_the_cpu():
    plain = batches_of(per_batch=4000, background="random", background_jitter=0.1)
    drawn, expected = DeviceBatches(plain, CPU).draw(1), plain.draw(1)
    assert drawn["target"].dtype == expected["target"].dtype
    for name in ("origins", "directions", "times", "target", "background", "alpha", "jitter"):
        ours, theirs = drawn[name].double(), expected[name].double()
        spread = 2**0.5 * theirs.std(dim=0) / 4000**0.5
        assert ((ours.mean(dim=0) - theirs.mean(dim=0)).abs() < 5 * spread + 1e-9).all(), name
        torch.testing.assert_close(ours.std(dim=0), theirs.std(dim=0), rtol=0.1, atol=1e-9)
    times = plain.views.times
    moved = (drawn["times"][:, None] - times).abs().amin(dim=1) > 1e-6
    assert moved.any()
    assert not drawn["alpha"][moved].any()


def test_who_can_be_served(fake_gpu, monkeypatch):
    batches = batches_of()
    assert DeviceBatches.can_serve(batches, fake_gpu)
    assert not DeviceBatches.can_serve(batches, CPU)
    monkeypatch.setattr("xplanes.scenes.batches.memory_left", lambda _: 3.9 * batches.views.nbytes)
    assert not DeviceBatches.can_serve(batches, fake_gpu)
    batches.views = replace(batches.views)
    monkeypatch.setattr(type(batches.views), "is_stored", True)
    monkeypatch.setattr("xplanes.scenes.batches.memory_left", lambda _: float("inf"))
    assert not DeviceBatches.can_serve(batches, fake_gpu)
