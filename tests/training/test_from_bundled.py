"""Runs initialised from the bundled model, the default of `python train.py`."""

from dataclasses import replace

import pytest
import torch

from tests.balls import ball_scene
from tests.training.runs import UNSCORED, changed, composed, metrics, scores
from xplanes.lrm.weights import bundled_models
from xplanes.models.initialisation import Initialisation, Method, Place
from xplanes.preparation.sources import LRMInitialiser
from xplanes.scenes.frame import scene_frame
from xplanes.tools.runs import load_run

SETTINGS = (
    "model.channels=32",
    "model.decoder.width=64",
    "model.resolution=32",
    "preparation.cache=null",
    "preparation.frames=6",
    "trainer.max_steps=12",
    "callbacks.evaluation.at=[0]",
)


def test_the_default_initialisation_is_a_bundled_model():
    assert composed().lrm.name == "auto"
    assert composed().lrm.bundled in bundled_models()


@pytest.mark.parametrize(
    ("overrides", "masked", "used"),
    [
        ((), False, False),
        ((), True, True),
        (("preparation.fixed_view=train",), False, True),
        (("lrm=tiny",), False, True),
    ],
)
def test_without_a_video_only_an_lrm_that_is_asked_for_sees_a_scene(
    monkeypatch, overrides, masked, used
):
    found = Initialisation(None, None, description="a video was rendered")
    monkeypatch.setattr(LRMInitialiser, "initialise", lambda *_: found)
    scene = ball_scene()
    if masked:
        scene = replace(scene, lrm_views=scene.splits["train"])
    place = Place(scene, scene_frame(scene.splits["train"]), torch.device("cpu"))
    method = Method.read(changed((), *overrides))
    initial = method.lrm.load().initialise(method, place)
    assert (initial.description == found.description) == used
    if not used:
        assert (initial.values, initial.lrm) == (None, {"name": "none"})
        assert "no video of a fixed camera" in initial.description


@pytest.mark.parametrize("name", ["auto", pytest.param("mini", marks=pytest.mark.slow)])
def test_it_knows_the_scene_before_the_first_step(train, name):
    random = scores(train(*SETTINGS, "lrm=none", name="random"))
    folder = train(*SETTINGS, f"lrm={name}")
    informed = scores(folder)
    assert informed[0] > random[0] + 3
    assert informed[-1] > random[-1] + 1
    content = metrics(folder)
    assert content["lrm"].get("name", name) == ("tiny" if name == "auto" else name)
    assert content["lrm"]["mismatch_pixels"]["largest"] < 0.1
    assert content["seconds"]["prepare"]["lrm"] > 0
    assert content["seconds"]["prepare"]["fill"] > 0


def test_a_scene_without_motion_trains_as_a_static_one(train):
    folder = train(*SETTINGS, "lrm=tiny", "data.scene=still_life", "trainer.max_steps=1", *UNSCORED)
    assert (metrics(folder)["lrm"]["frames"], metrics(folder)["lrm"]["distinct"]) == (1, 1)
    assert metrics(folder)["decomposition"] == {}
    assert metrics(folder)["skipped"]["static"] == 1.0
    loaded = load_run(folder)
    assert not loaded.module.field.moves
    assert loaded.module.renderer.grid.time_bins == 1
    said = (folder / "train.log").read_text()
    assert "static, without time planes" in said
    assert "frames are equal" in said
