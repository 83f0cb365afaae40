"""Scenes in a world: a background joins where images show one, and nothing changes elsewhere."""

import functools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from tests.balls import ball_views, swinging
from tests.baselines.runs import KPLANES, PROPOSAL, TINEUVOX
from tests.training.runs import same_state, small_config, train_quietly
from xplanes import RadianceModule, SceneDataModule
from xplanes.backend import waves
from xplanes.baselines.proposal import spaced, unspaced
from xplanes.evaluation import render
from xplanes.evaluation.render import FRAMES, run_track, write_run_video
from xplanes.rendering.behind import background_colour
from xplanes.scenes.views import Scene
from xplanes.training.building import loss_terms
from xplanes.training.collapse import CollapseWatch
from xplanes.training.evaluation import affordable
from xplanes.training.scores import score_view

STEPS = 30


def world(directions):
    """What lies behind the ball: colours that depend on direction alone. [..., 3]"""
    x, y, z = directions.unbind(dim=-1)
    return 0.5 + 0.4 * torch.stack([(2 * x).sin(), (3 * y).cos(), z], dim=-1)


@functools.cache
def scene(kind):
    """A ball that swings: with alpha, before a white wall without alpha, or in a world."""
    splits = {}
    for split, count, seed in (("train", 12, 0), ("test", 2, 1)):
        views = ball_views(count, 0.5, centre=swinging(0.3, 1), size=24, seed=seed)
        images = views.images.clone()
        for index in range(count if kind != "alpha" else 0):
            behind = torch.ones(24, 24, 3)
            if kind == "world":
                behind = world(views.image_rays(index)[1]).view(24, 24, 3)
            clear = images[index, ..., 3] == 0
            images[index, clear] = torch.nn.functional.pad(255 * behind, (0, 1), value=255)[
                clear
            ].byte()
        splits[split] = replace(views, images=images)
    return Scene("ball", splits)


def built(kind, *overrides):
    module = RadianceModule(small_config(Path(), "model.rays.per_batch=512", *overrides))
    module.build(scene(kind))
    return module


def same_parameters(groups, parameters):
    """Groups of the optimiser hold each parameter once."""
    listed = [id(p) for group in groups for p in group["params"]]
    assert sorted(listed) == sorted(map(id, parameters))


def picture(module, kind="world"):
    views, background = scene(kind).splits["train"], scene(kind).background
    return score_view(module.field, module.renderer, module.frame, views, 0, background)[1]


def rendered(module, kind):
    """A batch of a scene, and what the field shows of it."""
    batch = SceneDataModule.of(scene(kind)).batches_for(module, 0).draw(0)
    return batch, module.sampler.render(module.field, batch, module.state)


def terms(module, kind):
    """The terms of the loss of a batch."""
    batch, rendering = rendered(module, kind)
    return loss_terms(module.parts, module.method.losses, rendering, batch, module.state)


@pytest.mark.parametrize("kind", ["alpha", "white"])
def test_a_plain_background_stays_as_it_was(kind):
    with_, without = built(kind), built(kind, "model.background=null")
    assert not scene(kind).is_surrounded
    assert with_.field.background is None
    same_state(with_.state_dict(), without.state_dict())
    assert [group["name"] for group in with_.model.groups()] == ["space", "time", "decoder"]
    assert "opacity" in terms(with_, kind)


def test_a_world_gets_a_background_and_the_planes_are_initialised_as_ever():
    with_, without = built("world"), built("world", "model.background=null")
    assert scene("world").is_surrounded
    assert without.field.background is None
    assert "a background" in with_.field.outline
    for name, value in without.state_dict().items():
        if not name.startswith("field."):
            continue  # Before a world, thin fog counts as empty.
        if name == "field.decoder.layers.3.bias":  # No colour that nears a white background.
            value = value - torch.tensor([0.0, 1.0, 1.0, 1.0])
        torch.testing.assert_close(value, with_.state_dict()[name])
    same_parameters([*with_.model.groups(), *with_.sampler.groups()], with_.parameters())
    expected = "colour passing distortion border unseen exposures"
    assert set(terms(with_, "world")) == set(expected.split())


@pytest.mark.parametrize(
    ("kind", "overrides", "weight"),
    [
        ("alpha", ["model.fine.texels=8"], 0.2),
        ("alpha", ["model.fine=null"], 0.1),
        ("world", ["model.fine.texels=8"], 0.3),
        ("world", ["model.plane_set=three", "model.fine.texels=8"], 0.2),
        ("world", ["model.plane_set=three", "model.fine=null"], 0.1),
    ],
)
def test_total_variation_of_space_planes_depends_on_what_they_show(kind, overrides, weight):
    weights = "fine.coarse_variation=0.2", "loss.total_variation_with_background=0.3"
    smooth = ["model.loss.total_variation=0.1", *(f"model.{key}" for key in weights)]
    smooth += ["model.loss.variation_views=null"]
    if "model.fine=null" in overrides:
        smooth.remove("model.fine.coarse_variation=0.2")
    assert built(kind, *smooth, *overrides).model.total_variation == weight


def test_the_background_is_smoother_where_few_cameras_look():
    def pull(views):
        module = built("world", f"model.loss.variation_views={views}", "model.loss.every=1")
        planes = module.field.background.planes
        with torch.no_grad():
            planes.copy_(waves(planes.device, *planes.shape))
        for parameter in module.field.parameters():
            parameter.grad = torch.zeros_like(parameter)
        module.model.regularise(module.state)
        return planes.grad

    positions = built("world").site.positions
    torch.testing.assert_close(pull(4 * positions), 2 * pull("null"))


def test_light_that_passes_the_cube_costs_until_the_field_has_taken_shape():
    module = built("world", "model.loss.passing=0.5", "model.loss.passing_steps=200")
    batch, rendering = rendered(module, "world")
    passed = float((1 - rendering.opacity.detach()).mean())
    for step, weight in ((0, 0.5), (50, 0.375), (199, 0.0025), (200, None), (900, None)):
        terms = module.model.losses(rendering, batch, replace(module.state, step=step))
        found = terms.get("passing")
        assert (found is None) == (weight is None), step
        if weight is not None:
            assert float(found) == pytest.approx(weight * passed)
    # A short run spends at most 30% of its budget on it.
    for progress, weight in ((0.1, 0.5 * 2 / 3), (0.3, 0)):
        state = replace(module.state, step=50, progress=progress)
        found = float(module.model.losses(rendering, batch, state).get("passing", 0))
        assert found == pytest.approx(weight * passed)
        assert (module.model.group_rate_factor("time", 50, progress) > 0) == (weight == 0)


def test_in_a_rig_light_stopped_at_the_border_passes_for_longer():
    weights = "model.loss.passing=0.5", "model.loss.passing_steps=20"
    module = built("world", *weights, "model.loss.rig_passing_steps=200")
    twice = replace(module.site, times=module.site.times.repeat(2))
    rig = module.model.settings.build(twice)
    batch, rendering = rendered(module, "world")
    border = float(rendering.border.detach())
    assert border > 0
    passed = float((1 - rendering.opacity.detach()).mean())
    state = replace(module.state, step=100)
    found = rig.losses(rendering, batch, state)["passing"].detach()
    assert float(found) == pytest.approx(0.25 * (passed + border))
    assert "passing" not in module.model.losses(rendering, batch, state)
    assert rig.group_rate_factor("time", 100, 0.1) == 0
    assert module.model.group_rate_factor("time", 100, 0.1) > 0


def test_time_planes_wait_as_long_as_light_that_passes_the_cube_costs():
    world, white = built("world"), built("white")
    for module, step, waits in ((world, 150, True), (world, 200, False), (white, 150, False)):
        rates = [module.model.group_rate_factor(name, step, 0.1) for name in ("space", "time")]
        assert rates[0] > 0
        assert rates[1] == (0 if waits else rates[0])
    free = built("world", "model.loss.passing=0").model
    assert free.group_rate_factor("time", 150, 0.1) == free.group_rate_factor("space", 150, 0.1)
    shaped = world.model.settings.build(replace(world.site, initialised=True))  # From an LRM.
    assert shaped.group_rate_factor("time", 150, 0.1) == 0


def test_large_views_are_few():
    views = scene("white").splits["train"]
    assert affordable(1.0, views) == 200_000 // (views.height * views.width)
    assert affordable(1.0, SimpleNamespace(height=400, width=500)) == 2  # pyright: ignore
    for limit in (7, 1, 0.5):
        assert affordable(limit, views) == limit


@pytest.mark.parametrize(("kind", "pruned"), [("world", 40), ("white", 20)])
def test_rays_have_half_the_samples_until_the_grid_is_pruned(kind, pruned):
    module = built(kind, "model.sampler.sweep_at=[20,40]", "model.sampler.sweep_every=50")
    batch, _ = rendered(module, kind)
    first, last, after = (
        module.sampler.render(module.field, batch, replace(module.state, step=step)).samples
        for step in (0, pruned - 1, pruned)
    )
    assert last.candidates == first.candidates
    assert after.candidates / last.candidates == pytest.approx(2, rel=0.05)


@pytest.mark.parametrize("kind", ["world", "white"])
def test_before_a_background_planes_are_less_smooth_in_time_and_cells_stay_longer(kind):
    factor = "model.loss.time_factor_with_background=0.25"
    module = built(
        kind, factor, "model.sampler.sweep_at=[20,40]", "model.rays.match_exposure=false"
    )
    world, loss, used = kind == "world", module.model.settings.loss, module.model.weights
    for name in ("time_variation", "time_smoothness", "time_magnitude"):
        assert getattr(used, name) == getattr(loss, name) * (0.25 if world else 1)
    assert module.grid.decay == (0.9 if world else 0.6)
    assert module.sampler.settings.sweep_at == ([40] if world else [20, 40])


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("world")
    module = built("world")
    before = picture(module)
    trainer = train_quietly(module, scene("world"), folder, 2 * STEPS, callbacks=[CollapseWatch()])
    trainer.save_checkpoint(folder / "end.ckpt")
    return module.eval(), before, folder / "end.ckpt"


def test_training_learns_what_lies_behind(trained):
    module, before, _ = trained
    truth, found = scene("world").splits["train"].composite(0, torch.ones(3)), picture(module)
    errors = [(each["colour"] - truth).square().mean() for each in (found, before)]
    assert errors[0] < 0.7 * errors[1]
    # Light that passes the cube has the background's colour, in images as in training.
    rays = module.frame.rays(*scene("world").splits["train"].image_rays(0))
    with torch.no_grad():
        behind = background_colour(module.field.background, *rays).view(24, 24, 3)
    clear = found["opacity"] < 1e-4
    if clear.any():
        torch.testing.assert_close(found["colour"][clear], behind[clear], atol=1e-3, rtol=0)


def test_a_checkpoint_brings_the_background_back(trained):
    module, _, path = trained
    again = RadianceModule.load_from_checkpoint(path)
    assert again.site.surrounded
    assert torch.equal(picture(again.eval())["colour"], picture(module)["colour"])


BASELINES = {
    "kplanes": (*KPLANES, *PROPOSAL),
    "tineuvox_s": (*TINEUVOX, "model.background.samples=4"),
}


def baseline(model, kind):
    module = RadianceModule.compose(f"model={model}", *BASELINES[model])
    module.build(scene(kind))
    return module


@pytest.mark.slow
@pytest.mark.parametrize("model", BASELINES)
def test_baselines_see_the_world_in_their_own_way(model):
    module = baseline(model, "world")
    _, rendering = rendered(module, "world")
    sum(terms(module, "world").values()).backward()
    module.model.regularise(module.state)
    if model == "tineuvox_s":
        assert "a background" in module.field.outline
        assert module.field.background.planes.grad.abs().sum() > 0
    else:
        assert "contracted space" in module.field.outline
        assert rendering.samples.distances.max() > 10  # The cube ends at 6.
    same_parameters(module.model.groups(), module.field.parameters())
    outline = module.field.outline.replace(" over contracted space", "")
    assert baseline(model, "alpha").field.outline in outline


@pytest.mark.slow
def test_what_is_behind_a_box_begins_where_rays_leave_it():
    module = baseline("tineuvox_s", "world")
    field, renderer = module.field, module.renderer
    rays = module.frame.rays(*scene("world").splits["train"].image_rays(0))
    with torch.no_grad():
        field.density.bias.fill_(-60.0)  # Empty: all light passes.
        found = renderer.image(field, *rays, 0.0, torch.ones(3))
        leave = renderer.ends(*rays, field.bounds())[1]
        expected = background_colour(field.background, *rays, ends=lambda *_: (None, leave))
    assert found["opacity"].max() < 1e-6
    torch.testing.assert_close(found["colour"], expected)
    low, high = field.bounds()
    ends = rays[0] + leave[:, None] * rays[1]
    assert (ends > low - 1e-4).all()
    assert (ends < high + 1e-4).all()


def test_samples_of_contracted_space_are_even_in_distance_then_in_its_inverse():
    places = torch.linspace(0, 0.999, 200, dtype=torch.float64)
    distances = unspaced(places)
    torch.testing.assert_close(spaced(distances), places)
    near, far = places < 0.5, places > 0.5
    torch.testing.assert_close(distances[near], 2 * places[near])
    step = (1 / distances[far]).diff()
    torch.testing.assert_close(step, step[:1].expand_as(step))


def test_the_video_of_a_world_is_seen_from_where_cameras_were(tmp_path):
    for kind in ("world", "alpha"):
        module = built(kind)
        track = run_track(scene(kind), module.frame)
        poses = torch.stack([camera.camera_to_world for camera in track.cameras])
        own = scene(kind).splits["train"].camera_to_world
        nearest = torch.cdist(poses.flatten(1), own.flatten(1)).amin(dim=1)
        assert bool((nearest < 1e-6).all()) == bool(track.shown) == (kind == "world")
        assert {(camera.height, camera.width) for camera in track.cameras} == {(48, 48)}
        path = write_run_video(module, scene(kind), tmp_path / kind)
        with Image.open(path) as frames:
            shown = 2 * len(track.cameras) - 2 if track.shown else FRAMES
            assert (frames.n_frames, frames.size) == (shown, (48, 48))  # type: ignore[attr-defined]


def test_pixels_of_the_video_without_a_ray_are_left_empty(tmp_path, monkeypatch):
    shown = torch.arange(48).expand(48, 48) < 24
    monkeypatch.setattr(render, "pixels_with_rays", lambda *_: shown)
    path = write_run_video(built("world"), scene("world"), tmp_path)
    with Image.open(path) as video:
        frame = np.asarray(video.convert("RGB")).astype(float) / 255
    assert frame[:, 30:].min() > 0.97  # White, but for compression.
    assert frame[:, :18].mean() < 0.9
