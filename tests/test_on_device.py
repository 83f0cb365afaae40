"""Off the CPU: training, images, scores and preparation on a device that refuses what a GPU would.

The budgets are what is reached today. A change that lowers a number lowers it here, too.
"""

import functools
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar
from unittest.mock import Mock, patch

import pytest
import torch
from lightning.pytorch.callbacks import Callback

from tests import fake_device, on_device
from tests.balls import ball_scene
from tests.baselines.runs import KPLANES, NEUS, PROPOSAL, TENSOR4D, TINEUVOX, baseline_config
from tests.baselines.test_gaussians_runs import SMALL as GAUSSIANS
from tests.lrm.reduced import SIDES
from tests.preparation.sequences import moving_sequence
from tests.preparation.test_encode import frames_of, model_of
from tests.training.runs import small_config
from xplanes import RadianceModule, SceneDataModule
from xplanes.decomposition import decompose, space_planes, time_planes, unexplained_energy
from xplanes.fields.background import Background
from xplanes.fields.xplanes import PLANE_SETS
from xplanes.lrm.images import square_crop
from xplanes.models.base import LossTerm
from xplanes.preparation.cache import StageCache
from xplanes.preparation.encode import encode
from xplanes.rendering.behind import behind
from xplanes.rendering.box import ray_box
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.scenes import batches
from xplanes.scenes.batches import DeviceBatches
from xplanes.scenes.views import Views
from xplanes.training.clock import SHARED, Interrupt, Stopped, TrainingClock
from xplanes.training.diagnosis import TrainingError
from xplanes.training.fit import warm_up_loops
from xplanes.training.meters import due
from xplanes.training.scores import score_view

NOWHERE = Path("nowhere")
"""Folder of a scene that is handed over instead."""

CONFIGS = {
    "six": lambda *more: small_config(NOWHERE, *more),
    "nine": lambda *more: small_config(NOWHERE, "model=nine_planes", *more),
    "kplanes": lambda *more: baseline_config(NOWHERE, "model=kplanes", *KPLANES, *PROPOSAL, *more),
    "tineuvox": lambda *more: baseline_config(NOWHERE, "model=tineuvox_s", *TINEUVOX, *more),
    "gaussians": lambda *more: baseline_config(
        NOWHERE, "model=gaussians_hexplane", *GAUSSIANS, *more
    ),
    "tensor4d": lambda *more: baseline_config(NOWHERE, "model=tensor4d", *TENSOR4D, *NEUS, *more),
}


on_the_cpu = functools.partial(on_device.trainer, accelerator="cpu", strategy="auto")


def trained(name, steps, *more, trainer=on_device.trainer, losses=None, watch=()):
    """A module after some steps, its data, and the counts of each step."""
    module = RadianceModule(CONFIGS[name](*more))
    module.method = replace(module.method, losses=losses or {})
    data = SceneDataModule.of(ball_scene(6, 16))
    counts = on_device.StepCounts()
    callbacks = [counts, *watch]
    trainer(max_steps=steps, callbacks=callbacks, limit_val_batches=0).fit(module, data)
    return module, data, counts.steps


@pytest.fixture(scope="module")
def trained_once():
    """What several tests look at, by the name of its configuration; not to be changed."""

    @functools.cache
    def train(name):
        clock = TrainingClock()
        with fake_device.counted() as counts:
            # The share lets each step know how well it shows what is not background.
            found = trained(name, STEPS[name], *SHARE.get(name, ()), watch=[clock])
        found[0].to(torch.device(fake_device.NAME, 0)).zero_grad(set_to_none=True)
        return *found, clock, counts

    return train


def test_the_device_refuses_what_a_gpu_refuses_and_counts_what_it_is_asked(fake_gpu):
    with fake_device.counted() as counts:
        there = torch.arange(6, device=fake_gpu).float()
        assert counts.totals == (2, 0, 0)
        assert (there + torch.tensor(1.0)).device == fake_gpu  # A single number is passed along.
        moved = torch.ones(2).to(fake_gpu)
        assert counts.totals == (3, 0, 1)
        assert (there[there > 2] + 1).tolist() == [4.0, 5.0, 6.0]
        assert counts.waits == {"index": 1, "to the CPU": 1}
        assert float(there.sum()) == 15
        assert counts.waits.total() == 3
    with pytest.raises(RuntimeError, match="two devices, fake and cpu"):
        moved + torch.ones(2)
    with pytest.raises(RuntimeError, match="generator of the CPU"):
        torch.rand(2, device=fake_gpu, generator=torch.Generator())
    own = torch.Generator(fake_gpu).manual_seed(0)
    with fake_device.counted() as after:
        assert torch.rand(2, device=fake_gpu, generator=own).device == fake_gpu
    assert after.totals == (1, 0, 0)
    assert counts.operations.total() < 12  # Nothing was added since.


def encoded(model, frames, cache, place):
    return encode(model, "key", frames, square_crop(*frames.shape[1:3]), cache, place, batch=2)


@pytest.mark.parametrize("name", SIDES)
def test_an_lrm_encodes_there(fake_gpu, name):
    here, there = (
        encoded(model_of(name), frames_of(3), StageCache(None), place)
        for place in (torch.device("cpu"), fake_gpu)
    )
    torch.testing.assert_close(there.triplanes, here.triplanes)


@pytest.mark.filterwarnings("ignore:robust PCA stopped")
def test_triplanes_become_planes_there(fake_gpu):
    def planes(place):
        parts = decompose(moving_sequence(6, 4, 12).to(place), max_iterations=20)
        found = [space_planes(parts.low_rank, static="mean", resolution=16).cpu()]
        for plane_set in ("six", "nine"):
            generator = torch.Generator().manual_seed(0)
            sizes = {"resolution": 16, "time_resolution": 4, "noise": 0.01}
            time = time_planes(parts.sparse, plane_set=plane_set, generator=generator, **sizes)
            left = unexplained_energy(time, parts.sparse, rows=PLANE_SETS[plane_set])
            found += [time.cpu(), torch.tensor(left)]
        return found

    for there, here in zip(planes(fake_gpu), planes("cpu"), strict=True):
        torch.testing.assert_close(there, here, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("name", ["six", pytest.param("nine", marks=pytest.mark.slow)])
def test_training_there_comes_to_the_numbers_of_plain_torch(fake_gpu, monkeypatch, name):
    monkeypatch.setenv("XPLANES_CPU_LOOPS", "0")
    monkeypatch.setattr(DeviceBatches, "can_serve", lambda *_: False)
    # What draws other random numbers is left out.
    options = (
        "model.sampler.update_every=1000",
        "model.sampler.sweep_at=[8]",
        "model.rays.samples_per_batch=16384",
        "model.precision=32",
        "model.sampler.thinning=0",
        "model.sampler.coarse_first=false",
    )
    there, _, _ = trained(name, 10, *options)
    here, _, _ = trained(name, 10, *options, trainer=on_the_cpu)
    assert there.tally.counts == here.tally.counts
    assert there.tally.counts["no_room"] == 0
    for ours, theirs in zip(there.parameters(), here.parameters(), strict=True):
        # Adam makes as much of a tiny gradient, in which rounding shows, as of a large one.
        torch.testing.assert_close(ours.cpu(), theirs, atol=3e-4, rtol=1e-4)


def test_what_a_step_shows_is_read_now_and_then(fake_gpu, trained_once):
    looked = [batches for batches in range(1, 100) if due(batches)]
    assert looked == [1, 2, 4, 8, 16, 32, 64, 96]
    module, _, steps, *_ = trained_once("six")
    # The sweep of step 15 lists the occupied cells, and an epoch of Lightning's ends now and then.
    waiting = {n + 1 for n, counts in enumerate(steps) if counts.waits["to the CPU"]}
    assert waiting == {1, 2, 4, 8, 16}
    assert module.batches == 17
    seen = module.tally.counts
    left = seen["candidates"] - seen["empty"] - seen["occluded"]
    assert 0 < seen["samples"] <= left  # Others would be of rays without room.
    # The last batch is read at the end.
    assert 17 * 128 < seen["rays"] + seen["no_room"] <= 17 * 256
    assert 0 < module.tally.last["psnr"] < 40
    assert 0 < module.tally.last["foreground"] < 1


def test_slots_are_those_of_the_next_batch():
    module = RadianceModule.compose("lrm=none", "model.rays.samples_per_batch=8192")
    module.build(ball_scene())
    module._trainer, module.rays = Mock(), 64
    with (
        patch.object(module.tally, "read", return_value=(64, 64 * 16)),
        patch.object(module.sampler, "expect") as expected,
    ):
        module._read_tally()
    assert module.rays == 512
    expected.assert_called_once_with(512 * 16)


@dataclass(frozen=True, kw_only=True)
class Broken(LossTerm):
    """Not finite at some steps, in value or gradient."""

    steps: ClassVar = range(0)
    gradient: ClassVar = False

    def value(self, field, rendering, rays, state):
        first = next(field.parameters())
        if state.step not in self.steps:
            return 0 * first.sum()
        return (first * 0 + 1e-30).log().sum() * 1e30 * 1e30 if self.gradient else first.sum() / 0


@pytest.mark.parametrize("gradient", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_steps_that_are_not_finite_are_left_out(fake_gpu, monkeypatch, gradient):
    monkeypatch.setattr(Broken, "gradient", gradient)
    monkeypatch.setattr(Broken, "steps", range(3, 6))
    seen = {}

    class Watch(Callback):
        def on_train_batch_end(self, trainer, pl_module, *_):
            seen[trainer.global_step] = pl_module.field.space.detach().cpu().clone()

    module, _, _ = trained("six", 7, losses={"broken": Broken(weight=1.0)}, watch=[Watch()])
    assert torch.equal(seen[3], seen[6])
    assert not torch.equal(seen[2], seen[3])
    assert not torch.equal(seen[6], seen[7])
    assert module.tally.skipped == 3
    monkeypatch.setattr(Broken, "steps", range(100))
    monkeypatch.setattr("xplanes.training.module.PATIENCE", 5)  # Seen where the host looks next.
    with pytest.raises(TrainingError, match=r"for [5-8] steps in a row.*losses\.broken"):
        trained("six", 32, losses={"broken": Broken(weight=1.0)})


def test_a_background_is_the_same_without_a_list_of_rays(fake_gpu):
    generator = torch.Generator().manual_seed(0)
    background = Background(4, 8, width=8, samples=5, precision="32")
    origins, directions = torch.randn(2, 12, 3, generator=generator)
    directions = torch.nn.functional.normalize(directions, dim=1)
    opacity = torch.rand(12, generator=generator)
    opacity[:4] = 1
    field = SimpleNamespace(background=background)
    box = functools.partial(ray_box, half=0.6)
    found = [behind(field, origins, directions, opacity, None, ends=e) for e in (ray_box, box)]
    assert not torch.allclose(*found)  # It begins where rays leave the field's box.
    field.background = background.to(fake_gpu)
    rays = [part.to(fake_gpu) for part in (origins, directions, opacity)]
    for ends, here in zip((ray_box, box), found, strict=True):
        with fake_device.counted() as counts:
            there = behind(field, *rays, None, ends=ends)
        assert counts.totals[1:] == (0, 0)
        torch.testing.assert_close(there.cpu(), here)
        assert (here[:4] == 0).all()


def test_warming_up_does_all_of_a_step_and_changes_nothing(fake_gpu, trained_once, monkeypatch):
    module, data, *_ = trained_once("six")
    images = Mock(side_effect=AssertionError("images may take all memory"))
    monkeypatch.setattr(Views, "__deepcopy__", images, raising=False)
    before = {name: value.cpu().clone() for name, value in module.state_dict().items()}
    with fake_device.counted() as counts:
        warm_up_loops(module, data, fake_gpu)
    for name in ("_fused_adam_", "scatter_reduce_", "grid_sampler_2d_backward"):
        assert counts.operations[name], name
    assert counts.waits["synchronize"] == 1
    for name, value in module.state_dict().items():
        assert torch.equal(value.cpu(), before[name]), name
    assert all(p.grad is None for p in module.parameters())


def test_the_clock_counts_what_the_device_has_still_to_do(fake_gpu, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(torch.fake, "synchronize", lambda device: now.append(now.pop() + 0.5))
    module, trainer = SimpleNamespace(device=fake_gpu), SimpleNamespace(world_size=1)
    clock = TrainingClock()
    clock.on_train_start(trainer, module)
    clock.on_train_batch_end(trainer, module, None, None, 0)
    assert clock.seconds == 0
    with clock.off():
        now[0] += 3
    clock.on_train_batch_end(trainer, module, None, None, 1)
    assert clock.seconds == 0.5  # What was asked before the block, not what it asked.
    clock.on_train_end(trainer, module)
    assert clock.seconds == 1


def test_processes_that_share_a_run_end_in_time_however_short_their_epochs_are():
    trainer, module = Mock(should_stop=False, world_size=2), Mock(device=torch.device("cpu"))
    trainer.strategy.reduce = lambda number, reduce_op: number
    trainer.strategy.reduce_boolean_decision = lambda decision, all: decision
    clock, interrupt = TrainingClock(max_seconds=1e-9), Interrupt()
    clock.on_train_start(trainer, module)
    interrupt.asked = True

    def train(number):
        trainer.fit_loop.epoch_loop.total_batch_idx = number
        for callback in (clock, interrupt):
            callback.on_train_batch_end(trainer, module, None, None, number % 5)

    for number in range(SHARED - 1):
        train(number)
    assert not trainer.should_stop
    with pytest.raises(Stopped):
        train(SHARED - 1)
    assert trainer.should_stop


def test_an_lrm_whose_frames_are_cached_stays_where_it_is(fake_gpu, tmp_path):
    model, frames, cache = model_of(), frames_of(2), StageCache(tmp_path)
    first = encoded(model, frames, cache, fake_gpu)
    model = model_of()
    with fake_device.counted() as counts:
        again = encoded(model, frames, cache, fake_gpu)
    assert counts.totals == (0, 0, 0)
    assert torch.equal(first.triplanes, again.triplanes)


BUDGETS = {
    "six": {2: (479, 0, 0), 8: (804, 0, 0)},
    "nine": {2: (491, 0, 0), 8: (834, 0, 0)},
    "kplanes": {2: (1054, 0, 0)},
    "tineuvox": {2: (690, 4, 0)},
    "gaussians": {2: (1020, 14, 14)},
    "tensor4d": {2: (3536, 1, 0)},
}
"""Operations at most, waits and copies of a normal step, and of one that maintains the grid."""

STEPS = {name: max(known) + 1 for name, known in BUDGETS.items()} | {"six": 17}
SHARE = {"six": ("model.rays.background_share=0.2",)}


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.slow] * (n not in ("six", "kplanes"))) for n in BUDGETS],
)
def test_steps_keep_to_their_budget_and_views_are_scored(fake_gpu, trained_once, name):
    module, data, steps, clock, whole = trained_once(name)
    for step, (most, waits, copies) in BUDGETS[name].items():
        counts = steps[step]
        assert counts.operations.total() <= most, counts.operations
        assert (counts.waits.total(), counts.copies.total()) == (waits, copies), counts
    assert clock.seconds > 0
    assert whole.waits["synchronize"] == 1  # At the end alone.
    assert all(p.isfinite().all() for p in module.parameters())
    views, background = data.scene.splits["test"], data.scene.background
    score, images = score_view(module.field, module.renderer, module.frame, views, 0, background)
    assert 0 < score.psnr < 60
    assert images["colour"].device.type == "cpu"


class Upkeep(Callback):
    """Steps after which the grid was swept, or looked at here and there, and learning rates."""

    def __init__(self, monkeypatch):
        self.sweeps, self.looks, self.rates = [], [], []
        noted = {"sweep": self.sweeps, "update": self.looks, "update_by": self.looks}
        for name, steps in noted.items():
            real = getattr(OccupancyGrid, name)

            def noting(grid, *given, real=real, steps=steps):
                steps.append(len(self.rates))
                return real(grid, *given)

            monkeypatch.setattr(OccupancyGrid, name, noting)

    def on_train_batch_end(self, trainer, module, *rest):
        self.rates.append(module.optimizers().param_groups[0]["lr"])


@pytest.mark.parametrize(
    ("trainer", "size", "sweeps", "looks", "warm", "rays"),
    [
        (on_device.trainer, "auto", [2, 5, 10], [0, 6], 4, 512),
        pytest.param(*(on_device.trainer, "256", [4, 10], [0, 6], 7, 256), marks=pytest.mark.slow),
        (on_the_cpu, "auto", [4, 10], [0, 6], 7, 256),
    ],
)
def test_larger_batches_shorten_the_schedules(
    fake_gpu, monkeypatch, trainer, size, sweeps, looks, warm, rays
):
    """On a GPU, where nobody has chosen a size; here with batches twice as large as the CPU's."""
    monkeypatch.setattr(batches, "CPU_RAYS", 256)
    monkeypatch.setattr(batches, "GPU_RAYS", 512)
    upkeep = Upkeep(monkeypatch)
    options = (
        *(f"model.rays.per_batch={size}", "model.rays.samples_per_batch=16384"),
        "model.sampler.samples=24",
        *("model.sampler.sweep_at=[4]", "model.sampler.sweep_every=10"),
        "model.sampler.update_every=6",
        *("model.warmup_steps=7", "model.final_lr=1.0"),
    )
    module, _, _ = trained("six", 11, *options, trainer=trainer, watch=[upkeep])
    assert upkeep.sweeps == sweeps
    assert upkeep.looks == looks
    assert upkeep.rates.index(max(upkeep.rates)) == warm - 1
    assert module.rays == rays
