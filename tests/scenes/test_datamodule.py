"""The data module: resuming from a checkpoint, and evaluation views."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch.utils.data import DistributedSampler

from tests.balls import RAYS as WHITE
from tests.balls import ball_scene
from tests.scenes.common import same
from xplanes.errors import ConfigError
from xplanes.readers.listing import held_out_places
from xplanes.scenes.batches import RayBatches
from xplanes.scenes.datamodule import UNIFORM, SceneDataModule, spread_order
from xplanes.scenes.frame import cube_frame, scene_frame

FRAME = cube_frame(1.4, torch.zeros(3))
RAYS = replace(WHITE, per_batch=8, background="random")


def module_of(trained=0, rank=0):
    """The data as a trainer has it, and what it should draw."""
    scene = ball_scene()
    data = SceneDataModule.of(scene, seed=3)
    training = SimpleNamespace(batches=trained, ray_settings=RAYS, frame=FRAME)
    data.trainer = SimpleNamespace(global_rank=rank, lightning_module=training, limit_val_batches=0)
    views = scene.splits["train"]
    return data, lambda number: RayBatches(views, FRAME, RAYS, seed=3, rank=number)


def take(module, count):
    stream = iter(module.train_dataloader())
    return [next(stream) for _ in range(count)]


@pytest.mark.parametrize("rank", [0, 1])
def test_batches_are_those_of_the_steps_in_order(rank):
    module, batches = module_of(rank=rank)
    for again in (False, True):  # Another module begins with the first batch.
        for step, batch in enumerate(take(module, 4)):
            assert same(batch, batches(rank).draw(step)), (again, step)
        module.setup("fit")


def test_a_resumed_run_draws_what_an_uninterrupted_one_would():
    for trained in (0, 1, 5):
        straight = take(module_of()[0], trained + 3)
        state = module_of(trained=trained)[0].state_dict()
        assert state == {"batches": trained}
        assert type(state["batches"]) is int  # checkpoints hold builtins and tensors only
        resumed, _ = module_of()
        resumed.load_state_dict(state)
        for a, b in zip(straight[trained:], take(resumed, 3), strict=True):
            assert same(a, b), trained


def test_passes_over_the_loader_follow_one_another():
    """A trainer that starts epochs sees batches that no epoch before had."""
    module, batches = module_of()
    loader = module.train_dataloader()
    first, second = next(iter(loader)), next(iter(loader))
    assert same(first, batches(0).draw(0))
    assert same(second, batches(0).draw(1))
    views = module.scene.splits["train"]
    assert len(loader) == len(views) * views.height * views.width // RAYS.per_batch


def test_no_rays_of_held_out_views_are_trained_on():
    """Though the batches were asked for before, as when loops are warmed up."""
    data = SceneDataModule.of(ball_scene(count=16))
    assert len(data.batches(0).views) == 16
    data.setup("fit")
    held_out, views = data.scene.splits["val"], data.batches(0).views
    assert len(held_out) + len(views) == 16
    assert not set(held_out.files) & set(views.files)


@pytest.mark.parametrize("cameras", [2, 4, 8, 16, 24])
def test_held_out_views_are_of_many_cameras(cameras):
    """Views of a timestep follow one another in the order of their cameras."""
    times = [step / 80 for step in range(80) for _ in range(cameras)]
    places = held_out_places(times, 8)
    assert [place // 8 for place in places] == list(range(10 * cameras))
    counts = torch.tensor([place % cameras for place in places]).bincount(minlength=cameras)
    assert counts.min() >= 5, counts
    assert counts.max() <= 20, counts
    # Those of one camera are spread evenly.
    assert held_out_places([step / 30 for step in range(30)], 8) == [4, 12, 20, 28]
    assert held_out_places([0.0], 8) == []


def test_neither_the_video_nor_other_views_show_what_is_held_out():
    scene = ball_scene(count=16)
    train = scene.splits["train"]
    data = SceneDataModule.of(replace(scene, video=train, lrm_views=train))
    data.setup("fit")
    splits = data.scene.splits
    assert list(data.scene.video.files) == list(splits["train"].files)
    assert list(data.scene.lrm_views.files) == list(splits["train"].files)
    held_out = [index for index, file in enumerate(train.files) if file in splits["val"].files]
    data = SceneDataModule.of(replace(scene, video=train.subset(torch.tensor(held_out))))
    data.setup("fit")
    assert data.scene.video is None, "all of it is held out"


def test_how_many_views_are_scored_does_not_change_what_is_trained_on():
    held_out = {}
    for most, counts in ((None, (35, 5)), (2, (35, 2))):
        data = SceneDataModule.of(ball_scene(count=40))
        data.settings = replace(data.settings, eval_views=most or data.settings.eval_views)
        data.setup("fit")
        assert tuple(len(data.scene.splits[name]) for name in ("train", "val")) == counts
        held_out[most] = set(data.scene.splits["val"].files)
        assert data.held_out == 5
    assert held_out[2] < held_out[None]


def test_each_module_gets_batches_of_its_own_frame_and_settings():
    data = SceneDataModule.of(ball_scene(), seed=3)
    views = data.scene.splits["train"]
    # A module that says nothing gets rays over all pixels in the scene's cube.
    expected = RayBatches(views, scene_frame(views), UNIFORM, seed=3).draw(0)
    assert same(take(data, 1)[0], expected)
    assert len(expected["times"]) == 1024
    for frame, settings in (
        (FRAME, RAYS),
        (scene_frame(views), RAYS),
        (FRAME, replace(RAYS, per_batch=16)),
    ):
        module = SimpleNamespace(ray_settings=settings, frame=frame)
        expected = RayBatches(views, frame, settings, seed=3)
        assert same(data.batches_for(module, 0).draw(0), expected.draw(0))


def test_whole_views_are_cameras_and_what_they_saw():
    data = SceneDataModule.of(ball_scene())
    views = data.scene.splits["test"]
    for loader in (data.test_dataloader(), data.predict_dataloader()):
        batches = list(loader)
        assert [batch["index"] for batch in batches] == list(range(len(views)))
        for index, batch in enumerate(batches):
            for found, expected in zip(
                batch["camera"].rays(), views.image_rays(index), strict=True
            ):
                assert torch.equal(found, expected)
            assert batch["file"] == views.files[index]
            assert torch.equal(batch["alpha"], views.image(index)[..., 3])
            assert batch["time"] == views.times[index]
            assert torch.equal(batch["background"], data.scene.background)
            assert torch.equal(batch["target"], views.composite(index, data.scene.background))


def test_a_folder_that_holds_no_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=f"{tmp_path} is not a run directory"):
        SceneDataModule.from_run(tmp_path)


def test_however_few_validation_views_are_scored_they_are_spread():
    assert spread_order(1) == [0]
    for count in (5, 8, 11, 100):
        order = spread_order(count)
        assert sorted(order) == list(range(count))
        for first in range(2, count):
            gaps = torch.tensor([*sorted(order[:first]), count]).diff()
            assert gaps.max() <= 4 * count / first, (count, first)


def test_processes_share_the_views():
    data = SceneDataModule.of(ball_scene())
    whole = [batch["index"] for batch in data.val_dataloader()]
    found = []
    for rank in range(2):
        data.trainer = SimpleNamespace(global_rank=rank, world_size=2)
        found.append([batch["index"] for batch in data.val_dataloader()])
    assert sorted(found[0] + found[1]) == sorted(whole)
    assert not set(found[0]) & set(found[1])
    # Lightning would divide them once more.
    assert isinstance(data.val_dataloader().sampler, DistributedSampler)
    # Lightning scores nothing in a process without a view, for which the others would wait.
    data.trainer = SimpleNamespace(global_rank=len(whole), world_size=len(whole) + 1)
    assert [batch["index"] for batch in data.val_dataloader()] == whole[:1]


def test_what_a_test_will_score_is_not_trained_on():
    """Even if nothing is scored during training."""
    train = ball_scene(count=16).splits["train"]
    data = SceneDataModule.of(replace(ball_scene(), splits={"train": train}))
    data.trainer = SimpleNamespace(limit_val_batches=0, lightning_module=None)
    data.setup("fit")
    trained = set(data.scene.splits["train"].files)
    data.setup("test")
    assert not trained & set(data.scene.splits[data.test_split].files)
    assert len(trained) == 14


def test_the_seed_of_the_overrides_draws_the_rays():
    assert SceneDataModule.compose("data=blender", "data.scene=x", "seed=7").seed == 7
    assert SceneDataModule.compose("data=blender", "data.scene=x", "seed=7", seed=8).seed == 8
