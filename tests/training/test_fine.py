"""Fine planes: as many texels as the images show, trained from their first step on, resumed."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.balls import ball_scene
from tests.training.runs import UNSCORED, changed, gone_on, same_state, small_config
from xplanes.models import x_planes
from xplanes.models.initialisation import Method
from xplanes.rendering.sampler import Site
from xplanes.scenes.frame import cube_frame
from xplanes.training.module import RadianceModule

FINE = ("model.fine.texels=40", "model.fine.start=2", "model.fine.channels=3")


def settings(*overrides: str):
    return Method.read(small_config(Path("none"), *overrides)).model


def site(pixels: float, *, surrounded: bool = False, positions: int | None = 50) -> Site:
    seen = {"pixels": pixels, "surrounded": surrounded, "positions": positions}
    frame, times = cube_frame(1.0, torch.zeros(3)), torch.tensor([0.0, 1.0])
    return Site(frame, times, seed=0, precision="32", **seen)


@pytest.mark.parametrize(
    ("pixels", "texels"), [(0, 0), (100, 0), (140, 0), (190, 128), (400, 256), (4000, 256)]
)
def test_fine_planes_have_the_texels_that_the_images_show(pixels, texels):
    model = settings("model.resolution=64")
    assert model.fine_texels(site(pixels)) == texels
    assert model.texels(site(pixels)) == max(64, texels)
    assert model.fine_texels(site(pixels, surrounded=True)) == 0
    static = replace(site(pixels, surrounded=True), times=torch.zeros(2))
    assert model.fine_texels(static) == texels


def test_coarse_planes_have_more_texels_where_a_moving_camera_shows_surroundings():
    model = settings("model.resolution=auto")
    found = {
        96: [site(480, surrounded=True), site(4000, surrounded=True, positions=500)],
        64: [
            site(479, surrounded=True),
            site(480, surrounded=True, positions=49),
            site(480, surrounded=True, positions=None),
            site(480),
            replace(site(480, surrounded=True), times=torch.zeros(2)),
            None,
        ],
    }
    for texels, sites in found.items():
        assert [model.coarse_texels(each) for each in sites] == [texels] * len(sites)
    assert model.texels(found[96][0]) == 96
    field = model.build_field(found[96][0])
    assert (field.space.shape[1], field.time.shape[2]) == (96, 96)
    assert settings("model.resolution=50").coarse_texels(found[96][0]) == 50


def test_they_may_be_given_or_left_out():
    assert settings("model.fine.texels=100").fine_texels(site(0)) == 100
    assert settings("model.fine=null").fine_texels(site(4000)) == 0
    assert changed(("recipe=paper",))["model"]["fine"] is None
    # No finer than twice the space planes, or with more channels than they have.
    assert settings("model.resolution=200").fine_texels(site(4000)) == 0
    module = RadianceModule.compose("lrm=none", "model.channels=4", "model.fine.texels=32")
    module.build(ball_scene())
    assert module.field.fine.shape[-1] == 4 < module.parts.settings.fine.channels


def test_they_are_zero_until_their_first_step_and_go_on_exactly(tmp_path):
    whole, *parts = gone_on(ball_scene(), small_config(tmp_path, *FINE), tmp_path, 5, 2, 3)
    for part in parts:
        same_state(whole["state_dict"], part["state_dict"])
    for step in (2, 3):
        state = torch.load(tmp_path / f"step={step}.ckpt", weights_only=True)["state_dict"]
        assert state["field.fine"].shape == (3, 40, 40, 3)
        assert bool(state["field.fine"].any()) == (step > 2)
    groups = whole["optimizer_states"][0]["param_groups"]
    assert [group["name"] for group in groups] == ["space", "time", "fine", "decoder"]


def test_a_checkpoint_knows_how_many_texels_the_images_asked_for(train, monkeypatch):
    monkeypatch.setattr(x_planes, "TEXEL_STEP", 4)
    folder = train("model.resolution=8", "trainer.max_steps=2", *UNSCORED)
    module = RadianceModule.load_from_checkpoint(folder / "checkpoints" / "last.ckpt")
    texels = module.method.model.fine_texels(module.site)
    assert texels == module.field.fine.shape[1] > 8
