"""The data module goes on where a checkpoint left off."""

from types import SimpleNamespace

import torch

from tests.synthetic import ball_scene
from xplanes.scenes.batches import RayBatches
from xplanes.scenes.datamodule import RayDataModule
from xplanes.scenes.frame import cube_frame


def module_of(trained=0, rank=0):
    scene, frame = ball_scene(), cube_frame(1.4, torch.zeros(3))

    def batches(number):
        return RayBatches(
            scene.splits["train"],
            frame,
            rays=8,
            seed=3,
            background="random",
            skip_background=True,
            background_share=0.1,
            background_jitter=0.0,
            rank=number,
        )

    module = RayDataModule(scene, frame, batches)
    module.trainer = SimpleNamespace(
        global_rank=rank, lightning_module=SimpleNamespace(batches=trained)
    )
    return module, batches


def take(module, count):
    stream = iter(module.train_dataloader())
    return [next(stream) for _ in range(count)]


def same(first, second):
    return all(torch.equal(first[name], second[name]) for name in first)


def test_batches_are_those_of_the_steps_in_order():
    for rank in (0, 1):
        module, batches = module_of(rank=rank)
        for step, batch in enumerate(take(module, 4)):
            assert same(batch, batches(rank).draw(step)), (rank, step)


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


def test_every_pass_over_the_loader_starts_at_the_same_batch():
    module, _ = module_of()
    loader = module.train_dataloader()
    first, again = next(iter(loader)), next(iter(loader))
    assert same(first, again)
