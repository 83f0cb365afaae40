"""Models of Gaussians beside 4D-GS: how theirs move, and where all of them may begin."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.balls import ball_scene, ball_views, swinging
from tests.baselines.runs import baseline_config
from tests.baselines.test_gaussians import FRAME, control, settings, shaken, stepped
from xplanes.baselines.gaussians import points
from xplanes.baselines.gaussians.densification import densify
from xplanes.baselines.gaussians.field import DeformedGaussians, PointCloud, SpacetimeGaussians
from xplanes.errors import ConfigError
from xplanes.metrics import ssim
from xplanes.preparation.reconstruct import LoadedLRM
from xplanes.preparation.sources import BundledLRMSettings, LRMInitialiser
from xplanes.rendering.sampler import Site
from xplanes.scenes.frame import cube_frame
from xplanes.scenes.views import Scene
from xplanes.streams import TrainingState
from xplanes.training.module import RadianceModule


def cloud(count, seed=0):
    torch.manual_seed(seed)
    return PointCloud(torch.rand(count, 3) - 0.5, torch.rand(count, 3), torch.rand(count))


def spacetime(count, *, moves=True):
    field = SpacetimeGaussians(cloud(count), degree=1, extent=2.0, moves=moves, width=0.5)
    return shaken(field, network=0.1) if moves else field


def deformed(count, *, depth=3, moves=True, **noise):
    field = DeformedGaussians(
        cloud(count), degree=1, extent=2.0, moves=moves,
        depth=depth, width=8, octaves=(2, 3), **noise,
    )  # fmt: skip
    return shaken(field, network=0.1) if moves else field


def doubles(field):
    return {name: value.detach().double().numpy() for name, value in field.state_dict().items()}


@pytest.mark.parametrize("time", [0.0, 0.35, 1.0])
def test_spacetime_gaussians_follow_their_polynomials(time):
    """In float64, as the paper's Eq. 7 to 9 have them."""
    field = spacetime(20)
    posed, values = field.at(time), doubles(field)
    since = time - values["centres"]
    powers = since[:, None] ** np.array([1, 2, 3])
    life = np.exp(-((since / np.exp(values["log_widths"])) ** 2))
    for mine, theirs in (
        (posed.means, values["means"] + np.einsum("np,npc->nc", powers, values["motion"])),
        (posed.quaternions, values["quaternions"] + since[:, None] * values["spin"]),
        (posed.opacities, life / (1 + np.exp(-values["logits"]))),
        (posed.scales, np.exp(values["log_scales"])),
    ):
        np.testing.assert_allclose(mine.detach(), theirs, rtol=2e-5, atol=1e-6)
    posed.means.sum().backward()
    # Where a Gaussian moves says nothing about when it is there.
    assert field.centres.grad is None
    field.at(time).opacities.sum().backward()
    assert field.centres.grad.abs().max() > 0


@pytest.mark.parametrize("depth", [1, 3, 8])
def test_a_network_deforms_gaussians(depth):
    """The network layer by layer in float64; the input enters again after the middle layer."""
    field, time = deformed(10, depth=depth), 0.3
    values = doubles(field)

    def encoded(rows, octaves):
        waves = [f(2**n * rows) for n in range(octaves) for f in (np.sin, np.cos)]
        return np.concatenate([rows, *waves], axis=1)

    def layer(name, rows):
        return rows @ values[f"network.{name}.weight"].T + values[f"network.{name}.bias"]

    posed, times = field.at(time), np.full((10, 1), time)
    times = layer("time.2", np.maximum(layer("time.0", encoded(times, 3)), 0))
    given = hidden = np.concatenate([encoded(values["means"], 2), times], axis=1)
    for number in range(depth):
        if number == depth // 2 + 1:
            hidden = np.concatenate([given, hidden], axis=1)
        hidden = np.maximum(layer(f"hidden.{number}", hidden), 0)
    turns = values["quaternions"]
    units = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    for mine, theirs in (
        (posed.means, values["means"] + layer("shift", hidden)),
        (posed.quaternions, units + layer("turn", hidden)),
        (posed.scales, np.abs(np.exp(values["log_scales"]) + layer("growth", hidden))),
    ):
        np.testing.assert_allclose(mine.detach(), theirs, rtol=2e-5, atol=2e-6)
    posed.means.sum().backward()
    assert torch.equal(field.means.grad, torch.ones_like(field.means))
    assert field.network["time"][0].weight.grad.abs().max() > 0


def test_noise_on_time_fades_and_repeats_itself():
    field = deformed(3, noise=0.02, noise_until=0.5)
    times = [field.training_time(0.4, TrainingState(7, n, n, 0)) for n in range(400)]
    assert np.mean(times) == pytest.approx(0.4, abs=0.004)
    assert np.std(times) == pytest.approx(0.02, rel=0.1)
    half = [field.training_time(0.4, TrainingState(7, n, n, 0, 0.25)) for n in range(400)]
    np.testing.assert_allclose(np.array(half) - 0.4, (np.array(times) - 0.4) / 2, atol=1e-12)
    assert field.training_time(0.4, TrainingState(7, 3, 3, 0)) == times[3]
    assert field.training_time(0.4, TrainingState(7, 3, 3, 0, 0.5)) == 0.4
    field.deforms.fill_(False)
    assert field.training_time(0.4, TrainingState(7, 3, 3, 0)) == 0.4
    assert deformed(3).training_time(0.4, TrainingState(7, 3, 3, 0)) == 0.4


def test_loss_is_a_mixture_of_absolute_and_structural_errors():
    model = settings(model="gaussians_spacetime").build(
        Site(FRAME, torch.tensor([0.0, 1.0]), 0, "32")
    )
    image, truth = torch.rand(2, 20, 24, 3, generator=torch.Generator().manual_seed(0))
    rendering = SimpleNamespace(colour=image.view(-1, 3), image=SimpleNamespace(colour=image))
    terms = model.losses(rendering, {"target": truth.view(-1, 3)}, TrainingState(0, 0, 0, 0))
    assert float(terms["colour"]) == pytest.approx(0.8 * float((image - truth).abs().mean()))
    expected = 0.2 * (1 - ssim(image, truth))
    assert float(terms["dissimilarity"]) == pytest.approx(expected, rel=1e-4)
    shown = torch.rand(480) < 0.5
    rays = {"target": torch.where(shown[:, None], image.view(-1, 3), 0.5), "shown": shown}
    terms = model.losses(rendering, rays, TrainingState(0, 0, 0, 0))
    assert [float(term) for term in terms.values()] == pytest.approx([0, 0], abs=1e-6)


def test_halves_keep_their_time_and_their_path():
    field = spacetime(20)
    field.seen.fill_(1)
    field.slopes.fill_(1)
    optimizer = stepped(field)
    before = {name: getattr(field, name).detach().clone() for name in field.PARAMETERS}
    densify(field, optimizer, control(), torch.Generator().manual_seed(1), remove_large=False)
    assert len(field) == 40
    for name in ("centres", "log_widths", "motion", "spin"):
        assert torch.equal(getattr(field, name)[20:], before[name]), name
        assert not optimizer.state[getattr(field, name)]["exp_avg"][20:].any(), name


def test_first_points_lie_on_what_a_field_shows(tmp_path, monkeypatch):
    """A ball that swings: points on its surface, where it is at their times."""
    path, radius = swinging(0.4, 1), 0.35
    views = ball_views(40, radius, size=24, centre=path)
    scene = Scene("ball", {"train": views, "test": views})
    config = baseline_config(
        *(tmp_path, "model=gaussians_spacetime", "lrm=field", "lrm.steps=80", "model.count=300"),
        f"preparation.cache={tmp_path}/cache",
    )
    frame, said = cube_frame(1.3, torch.tensor([0.1, 0.0, 0.0])), []
    module = RadianceModule(config)
    module.build(scene, frame, say=said.append)
    found, field = module.initialisation, module.field
    assert said == ["points: training six_planes for 80 steps"]
    assert len(field) == 300
    assert found.seconds["field"] > 0
    assert found.description == "300 points on the surfaces of six_planes, trained for 80 steps"
    assert torch.equal(field.centres, found.values.cloud.times)
    assert set(field.centres.tolist()) <= set(views.times.tolist())
    places = frame.to_world(field.means.detach())
    centres = torch.stack([path(time) for time in field.centres.tolist()])
    error = ((places - centres).norm(dim=1) - radius).abs()
    assert error.median() < 0.12
    assert torch.corrcoef(torch.stack([places[:, 0], centres[:, 0]]))[0, 1] > 0.5
    assert len(places.unique(dim=0)) == 300
    colours = field.base.detach()[:, 0] * 0.28209479177387814 + 0.5
    expected = torch.tensor([200.0, 100.0, 50.0]) / 255
    # So early nearer than grey, which is 0.3 away.
    assert (colours.median(dim=0).values - expected).abs().max() < 0.25
    widest = field.scales.detach().amax(dim=1)
    assert widest.max() <= 1.5001 * widest.median()
    again = RadianceModule(config)
    again.build(scene, frame, say=said.append)
    assert len(said) == 1
    assert torch.equal(again.field.means, field.means)
    monkeypatch.setattr(points, "ROUNDS", 1)
    monkeypatch.setattr(points, "OPAQUE", 2.0)
    early = RadianceModule(config | {"lrm": config["lrm"] | {"steps": 1}})
    with pytest.raises(ConfigError, match=r"lrm\.steps=1: six_planes has no surfaces"):
        early.build(scene, frame, say=said.append)


def test_points_of_other_weights_are_made_anew(tmp_path, monkeypatch):
    """The cache knows the LRM by its weights: the same name may stand for new ones."""
    views, made = ball_views(4, 0.6, size=8), []
    config = baseline_config(
        *(tmp_path, "model=gaussians_spacetime", "lrm=field", "lrm.source=tiny"),
        f"preparation.cache={tmp_path}/cache",
    )

    def train(_field, place, _folder, **_):
        made.append(key)
        return SimpleNamespace(frame=place.frame)

    monkeypatch.setattr(points, "trained_field", train)
    monkeypatch.setattr(points, "surface_points", lambda *_, **__: cloud(8))
    for key in ("first", "first", "second", "first"):
        source = LRMInitialiser(None, LoadedLRM(None, key, 0.0))
        monkeypatch.setattr(BundledLRMSettings, "load", lambda *_, source=source: source)
        RadianceModule(config).build(Scene("ball", {"train": views}), say=lambda _: None)
    assert made == ["first", "second"]


def test_checkpoints_of_gaussians_are_built_without_points():
    views = ball_scene().splits["train"]
    model = settings(model="gaussians_spacetime")
    site = Site(FRAME, views.times, 0, "32", views=views)
    assert len(model.build(site).field) == 4000
    assert len(model.build(replace(site, views=None)).field) == 1
