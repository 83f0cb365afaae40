"""Which settings of the baselines are refused, what they lead to, and where their cubes lie."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from tests.balls import ball_scene, ball_views
from tests.baselines.runs import TENSOR4D, baseline_config
from tests.refusals import assert_refused
from xplanes.baselines.bounds import check_range
from xplanes.baselines.tineuvox.model import frusta_box
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.models.initialisation import Method
from xplanes.preparation.fixed_view import rendering_method
from xplanes.rendering.sampler import Site
from xplanes.scenes.frame import CubeHints, scene_frame
from xplanes.streams import TrainingState
from xplanes.training.module import RadianceModule

REFUSED = {
    "six_planes": (
        ("lrm=field", "lrm=field with model=six_planes: the initialisation is points"),
        # Samplers that need two stages or a surface refuse other models.
        ("model/sampler=fixed_step", r"name=fixed_step: needs a feature grid.* model/sampler=occ"),
        ("model/sampler=neus", r"name=neus: needs a field with a surface.* model/sampler=occ"),
        ("model/sampler=rasteriser lrm=none", "name=rasteriser: .* leave model/sampler"),
    ),
    "kplanes": (
        ("lrm=file", "lrm=file with model=kplanes: .* model=six_planes"),
        ("lrm=field", "is points, and the model takes none; set lrm=none"),
        ("model.sampler.near=null", r"model\.sampler\.near=None with far=6\.0: set both in world"),
        ("model.sampler.near=7", r"model\.sampler\.near=7\.0: must be below far=6\.0"),
        ("model.sampler.resolutions=[64]", r"with resolutions=\[64\]: both need one number per"),
        ("model.scales=[]", r"model\.scales=\[\]: must be one or more numbers above 0"),
        ("model.space_low=0.9", r"model\.space_low=0\.9: must not be above space_high=0\.5"),
        ("trainer.devices=2 trainer.strategy=ddp", r"trainer\.devices=2 .*one device"),
    ),
    "tineuvox_s": (
        ("lrm=file", "the initialisation is planes, and the model takes none; set lrm=none"),
        ("model.near=7", r"model\.near=7\.0: must be below far=6\.0"),
        ("model.sampler.near=7", r"model\.sampler\.near=7\.0: must be below far=6\.0"),
        ("model.sampler.threshold=1", "must lie between 0 and 1"),
        ("model.alpha_start=1", "must lie between 0 and 1"),
        ("model.alpha_start=0", "must lie between 0 and 1"),
        ("model.sampler.step=0", "must be above 0"),
        ("model/sampler=neus", r"name=neus: needs a field with a surface.* model/sampler=occ"),
    ),
    "tensor4d": (
        ("lrm=file", "lrm=file with model=tensor4d"),
        ("model/sampler=occupancy", r"sampler\.name=occupancy: .* model/sampler=neus"),
        ("model/sampler=proposal", r"sampler\.name=proposal: .* model/sampler=neus"),
        ("model/sampler=fixed_step", r"sampler\.name=fixed_step: .* model/sampler=neus"),
    ),
    "gaussians_hexplane": (
        ("model/sampler=occupancy lrm=none", r"sampler\.name=occupancy: .* leave model/sampler"),
        ("model.degree=4", "degree=4: must be 0 to 3"),
        ("model.precision=bf16", "precision=bf16: .* set 32 or auto"),
        ("model.scales=[]", r"scales=\[\]: must be one or more"),
        ("model.final_lr=0", r"final_lr=0\.0: the decay is exponential"),
        ("model.count=900000", r"count=900000: must not be above densify\.most=20000"),
    ),
    "gaussians_deform": (
        ("lrm=tiny", "is planes, and the model takes points"),
        ("lrm=field lrm.source=field", "source=field: must be one"),
        ("model.final_network_lr=0", r"final_network_lr=0\.0:"),
    ),
    "gaussians_spacetime": (("model.precision=bf16", "precision=bf16: Gaussians"),),
}


@pytest.mark.parametrize("model", REFUSED)
def test_settings_that_cannot_work_are_refused(scenes, model):
    for overrides, words in REFUSED[model]:
        config = baseline_config(scenes, f"model={model}", *overrides.split())
        assert_refused(ConfigError, words, partial(Experiment.read, config), overrides)


def test_a_fixed_view_is_rendered_by_rays(scenes):
    method = Method.read(baseline_config(scenes, "preparation.fixed_view_model=gaussians_hexplane"))
    with pytest.raises(ConfigError, match=r"fixed_view_model=gaussians_hexplane: .* six_planes"):
        rendering_method(method, ball_views(4, 0.6))


def settings_of(scenes, *overrides):
    return Method.read(baseline_config(scenes, *overrides)).model


def test_cameras_out_of_range_are_refused_or_named(scenes, caplog):
    settings = settings_of(scenes, "model=kplanes")
    views = ball_views(4, 0.6, distance=12.0)
    site = Site(settings.frame(views), views.times, 0, "32", views=views)
    near = ball_views(4, 0.6, distance=5.8)
    check_range(replace(site, views=near), 2.0, 6.0)
    assert "far=6: the scene is 4.5 to 7.1 world" in caplog.text
    # The sampler asks.
    with pytest.raises(ConfigError, match=r"model\.sampler\.far=6\.0: the cameras stand 12 to 12"):
        settings.sampler.build(settings.build(site).field, site)


def test_a_cube_is_the_published_one_or_the_scenes_and_a_wrong_one_is_said(scenes, caplog):
    settings, views = settings_of(scenes, "model=kplanes"), ball_views(4, 0.6)
    frame = settings.frame(views)
    assert frame.scale == pytest.approx(1 / 1.3)
    assert torch.equal(frame.centre, torch.zeros(3))
    assert replace(settings, half_side=None).frame(views).scale > 1
    assert not caplog.records
    settings.frame(ball_views(6, 3.0, distance=12.0))
    assert "model.half_side=1.3: the scene reaches 3." in caplog.text


def test_two_cubes_are_refused(scenes):
    module = RadianceModule(baseline_config(scenes, "model=kplanes"))
    with pytest.raises(ConfigError, match=r"data\.half_side=1\.5 with model\.half_side=1\.3"):
        module.build(ball_scene(), hints=CubeHints(1.5))
    module = RadianceModule(baseline_config(scenes, "model=kplanes", "model.half_side=null"))
    module.build(ball_scene(), hints=CubeHints(1.5))
    assert module.frame.scale == pytest.approx(1 / 1.5)


def test_box_holds_what_cameras_see_between_the_bounds():
    views = ball_views(5, 0.6)
    box, larger = (frusta_box(views, 2.0, 6.0, margin) for margin in (1.0, 1.05))
    origins, directions = views.image_rays(3)
    for distance in (2.0, 3.7, 6.0):
        points = origins + distance * directions
        assert ((points >= box[0]) & (points <= box[1])).all()
    torch.testing.assert_close(larger[1] - larger[0], 1.05 * (box[1] - box[0]))
    torch.testing.assert_close(larger.sum(dim=0), box.sum(dim=0))


def test_tineuvox_rates_and_cells_follow_the_published_schedule(scenes):
    settings, views = settings_of(scenes, "model=tineuvox_s"), ball_views(4, 0.6)
    frame, bounds = settings.frame(views), settings.bounds(views)
    model = settings.build(Site(frame, views.times, 0, "32", bounds))
    steps = (0, 1999, 2000, 4000, 6000, 19999)
    assert [model.voxels(s) for s in steps] == [125000, 125000, 250000, 500000, 1000000, 1000000]
    for step, since in zip(steps, (0, 1999, 0, 0, 0, 13999), strict=True):
        assert model.rate_factor(step, 0.5) == pytest.approx(0.1 ** (since / 20000))
    rates = {group["name"]: group["lr"] for group in model.groups()}
    assert (rates["grid"], rates["deformation"], rates["trunk"]) == (0.08, 0.0006, 0.0008)


def tensor4d(scenes, *overrides):
    settings = settings_of(scenes, "model=tensor4d", *TENSOR4D, *overrides)
    views = ball_views(4, 0.6)
    frame = settings.frame(views)
    assert frame.scale == scene_frame(views).scale
    return settings.build(Site(frame, views.times, 0, "32"))


def test_planes_of_tensor4ds_flow_are_trained_unless_left_out_as_released(scenes):
    for train in (True, False):
        made = tensor4d(scenes, f"model.flow_planes={str(train).lower()}")
        trained = {id(p) for group in made.groups() for p in group["params"]}
        left_out = {name for name, p in made.field.named_parameters() if id(p) not in trained}
        assert all(name.startswith("flow_planes.") for name in left_out)
        assert (len(left_out) == 0) == train
        # What is left out gathers no gradients, which nothing would clear.
        assert {n for n, p in made.field.named_parameters() if not p.requires_grad} == left_out


def test_tensor4ds_fine_level_joins_and_planes_get_sharp_at_their_steps(scenes):
    made = tensor4d(scenes)
    for step, fine, blurred in ((0, 0, 1), (14, 0, 1), (15, 1, 1), (29, 1, 1), (30, 1, 0)):
        made.before_step(TrainingState(0, step, step, 0), made.optimizer(made.groups()))
        for part in (made.field.canonical_planes, made.field.flow_planes):
            assert (bool(part.fine), bool(part.blurred)) == (fine, blurred)
