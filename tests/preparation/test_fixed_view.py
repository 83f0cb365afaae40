"""The fixed-view video: the scene's own, or rendered by a field."""

import math
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import pytest
import torch

from tests.balls import ball_scene, ball_views, inside_ball, surrounding, swinging
from tests.baselines.runs import KPLANES, PROPOSAL
from tests.refusals import assert_refused, interrupt
from tests.training.runs import SMALL, changed, small_config
from tests.training.test_health import spoil_gradient
from xplanes.errors import ConfigError, SceneError
from xplanes.lrm.alignment import align
from xplanes.lrm.canonical import OPENLRM_VIEW, TRIPOSR_VIEW
from xplanes.models.initialisation import Method, Place, RandomSettings
from xplanes.preparation import fixed_view as module
from xplanes.preparation.cache import StageCache
from xplanes.preparation.fixed_view import canonical_pose, fixed_view, pick_frames, rendering_method
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.sampler import Site
from xplanes.scenes.frame import CubeHints, Frame, scene_frame
from xplanes.training import fit as training
from xplanes.training.module import RadianceModule, TrainingError

SMALL_FIELD = tuple(text for text in SMALL if text.startswith("model."))
TIMES = torch.linspace(0, 1, 50)
VIEWS = {"openlrm": OPENLRM_VIEW, "triposr": TRIPOSR_VIEW}


def settings(folder: Path, *overrides: str) -> Method:
    few = ("preparation.frames=4", "preparation.fixed_view_steps=60")
    limit = "preparation.fixed_view_seconds=1000"
    return Method.read(small_config(folder, *few, limit, *overrides))


def default_settings(*overrides: str) -> Method:
    return Method.read(changed(overrides))


def video_of(method, scene, folder, size=24):
    said = []
    place = Place(scene, scene_frame(scene.splits["train"]), torch.device("cpu"), say=said.append)
    made = fixed_view(method, place, OPENLRM_VIEW, size, StageCache(folder))
    return made, said


def test_the_field_that_renders_has_its_models_default_settings(tmp_path):
    changed = ("model=nine_planes", "model.sampler.samples=16", "model.precision=bf16", "seed=3")
    views = ball_views(6, 0.6)
    rendering = rendering_method(settings(tmp_path, *changed), views, CubeHints(0.9))
    default = default_settings().model
    # Images for a model of few pixels need no more samples than training.
    sampler = replace(default.sampler, samples=128, render_samples=128)
    assert rendering.model == replace(default, sampler=sampler, precision="bf16")
    assert (rendering.seed, rendering.losses) == (3, {})
    assert isinstance(rendering.lrm, RandomSettings)
    # K-Planes render as published.
    own = settings(tmp_path, "preparation.fixed_view_model=kplanes")
    published = default_settings("model=kplanes").model
    found = rendering_method(own, views).model
    assert found == replace(published, precision=own.model.precision)
    assert not published.rays.skip_background


def test_all_timesteps_are_rendered_and_steps_alone_may_limit_training(
    tmp_path, small_fields, monkeypatch
):
    asked = {}
    monkeypatch.setattr(training, "fit_quietly", lambda *_, **options: asked.update(options))
    open_ones = ("preparation.frames=null", "preparation.fixed_view_seconds=null")
    made, said = video_of(settings(tmp_path, *open_ones), ball_scene(7), tmp_path / "cache", size=4)
    assert (asked["max_steps"], asked["max_seconds"]) == (60, None)
    assert made.views.times.tolist() == pytest.approx([step / 6 for step in range(7)])
    assert "training six_planes for 60 steps to render 7 frames" in said[0]
    assert made.description == "7 frames rendered by six_planes trained for 60 steps"


@pytest.mark.parametrize(("wanted", "model"), [(True, "six_planes"), (False, "kplanes")])
def test_it_leaves_the_run_as_deterministic_as_it_was(tmp_path, small_fields, wanted, model):
    options = (f"preparation.fixed_view_model={model}", "preparation.fixed_view_steps=1")
    before = torch.are_deterministic_algorithms_enabled()
    try:
        torch.use_deterministic_algorithms(wanted)
        made, said = video_of(settings(tmp_path, *options), ball_scene(), None, size=4)
        assert f"training {model} for up to 1 steps" in said[0]
        assert made.views.images.any()
        assert torch.are_deterministic_algorithms_enabled() == wanted
    finally:
        torch.use_deterministic_algorithms(before)


def elsewhere(*, scale=1.0, shift=(0.0, 0.0, 0.0), distance=4.0):
    """A ball of 0.6 at the origin, seen from ``distance``; then all of it scaled and shifted."""
    shift = torch.tensor(shift)
    poses = surrounding(6, distance * scale, 0)
    poses[:, :3, 3] += shift
    return ball_views(6, 0.6 * scale, size=16, centre=lambda _: shift, poses=poses)


AWAY = (3.6, -2.8, 2.0)
PLACES = {
    "three times as far": ({"scale": 3.0}, None),
    "a tenth": ({"scale": 0.1}, None),
    "off centre": ({"shift": AWAY}, None),
    "a long lens": ({"distance": 9.0}, None),
    "the user's cube, off centre": ({"shift": AWAY}, 1.2),
}
TINY_FIELDS = {
    "kplanes": {"resolution": 4, "scales": [1]},
    "tineuvox_s": {"resolution": 8, "grow_at": []},
}


@pytest.mark.parametrize("place", PLACES)
def test_published_bounds_give_way_where_they_do_not_fit(tmp_path, place):
    moved, half_side = PLACES[place]
    hints = CubeHints(half_side)
    views = elsewhere(**moved)
    cube = scene_frame(views, hints)
    for name, tiny in TINY_FIELDS.items():
        method = settings(tmp_path, f"preparation.fixed_view_model={name}")
        model = rendering_method(method, views, hints).model
        frame, bounds = model.frame(views, hints), model.bounds(views)
        site = Site(frame, views.times, 0, "32", views=views, bounds=bounds)
        if name == "tineuvox_s":
            # Its box is that of what the cameras see, which holds the scene from side to side.
            assert (bounds[0] < cube.centre - 0.99 / cube.scale).all()
            assert (bounds[1] > cube.centre + 0.99 / cube.scale).all()
        else:
            assert frame.scale == pytest.approx(cube.scale)
            torch.testing.assert_close(frame.centre, cube.centre)
            assert model.sampler.near is model.sampler.far is None
        model = replace(model, **tiny)
        model.sampler.build(model.build(site).field, site)


def test_a_field_that_breaks_names_settings_that_the_user_has(tmp_path, small_fields, monkeypatch):
    spoil_gradient(monkeypatch, math.nan, range(3, 1000))
    with pytest.raises(TrainingError, match=r"preparation\.fixed_view_model to another") as caught:
        video_of(settings(tmp_path), ball_scene(), tmp_path / "cache", size=4)
    assert "plane_lr" not in str(caught.value)


def test_a_model_that_is_not_there_cannot_render(tmp_path):
    with pytest.raises(ConfigError, match=r"^preparation\.fixed_view_model=nerf: .* kplanes, "):
        settings(tmp_path, "preparation.fixed_view_model=nerf")


@pytest.fixture
def small_fields(monkeypatch):
    """Fields that render are small, whichever their model."""

    def composed(_, lines):
        reduced = (*KPLANES, *PROPOSAL) if "model=kplanes" in lines else SMALL_FIELD
        return changed(tuple(lines), *reduced)

    monkeypatch.setattr(module, "compose_plain", composed)


class KnownField(RayRenderer):
    """Stands for a trained field: shows a moving ball, and keeps where rays began."""

    @property
    def device(self):
        return torch.device("cpu")

    def render(self, *_arguments, **_options):
        raise NotImplementedError

    def __init__(self, frame: Frame, radius: float, centre):
        self.frame, self.radius, self.centre = frame, radius, centre
        self.field, self.renderer, self.began = None, self, []

    def eval(self):
        return self

    def image(self, field, origins, directions, time, background):
        starts, ends = self.frame.to_world(origins), self.frame.to_world(origins + directions)
        self.began.append(starts)
        towards = torch.nn.functional.normalize(ends - starts, dim=-1)
        offset = self.centre(time) - starts
        along = (offset * towards).sum(dim=-1)
        hit = offset.square().sum(dim=-1) - along.square() < self.radius**2
        colour = torch.tensor([200.0, 100.0, 50.0]) / 255
        return {"colour": hit[:, None] * colour, "opacity": hit.float()}


def test_the_video_shows_what_the_field_holds_from_the_models_camera(tmp_path, monkeypatch):
    """In K-Planes' own cube, with rays that begin as far away as in training."""
    scene, centre, fields = ball_scene(count=12, size=24), swinging(0.3, 0.5), []

    def known(_method, place, _folder, **_budget):
        fields.append(KnownField(place.frame, 0.5, centre))
        return fields[0]

    monkeypatch.setattr(module, "trained_field", known)
    method = settings(tmp_path, "preparation.fixed_view_model=kplanes")
    made, _ = video_of(method, scene, tmp_path / "cache")
    assert fields[0].frame.scale == pytest.approx(1 / 1.3)
    views = made.views
    assert views.intrinsics.focal == pytest.approx(24 * OPENLRM_VIEW.focal)
    camera = {"size": 24, "angle": 2 * math.atan(0.5 / OPENLRM_VIEW.focal)}
    seen = {"centre": centre, "times": views.times, "poses": views.camera_to_world}
    expected = ball_views(4, 0.5, **camera, **seen)
    assert (views.images != expected.images).float().mean() < 0.005  # edges, by rounding
    assert (expected.images[0] != expected.images[2]).any()
    # Rays begin on a line through the model's camera, at the training cameras' distance.
    frame = scene_frame(scene.splits["train"])
    poses = scene.splits["train"].camera_to_world
    away = (poses[:, :3, 3] - frame.centre).norm(dim=-1).mean()
    middle = fields[0].began[0].view(24, 24, 3)[11:13, 11:13].mean(dim=(0, 1))
    torch.testing.assert_close((middle - frame.centre).norm(), away, rtol=1e-3, atol=0)


def test_frames_are_picked_evenly():
    video = ball_views(33, 0.5)
    for count in (1, 4, 9):
        expected = torch.linspace(0, 1, count) if count > 1 else torch.tensor([0.4])
        picked = pick_frames(video, expected)
        assert (picked.times - expected).abs().max() <= 0.5 / 32 + 1e-6, count
        assert len(picked) == count
    # Of few frames, some are taken more than once.
    picked = pick_frames(ball_views(3, 0.5), torch.linspace(0, 1, 7))
    assert picked.times.tolist() == [0, 0, 0.5, 0.5, 0.5, 1, 1]


def test_a_video_with_missing_timesteps_is_refused():
    for times in ([0.0, 0.1, 0.2, 0.3], [0.6, 0.8, 1.0], [0, 0.05, 0.95, 1]):
        video = ball_views(len(times), 0.5, size=4, times=torch.tensor(times))
        words = r"no frame near time .*preparation\.fixed_view=train"
        assert_refused(SceneError, words, partial(pick_frames, video, TIMES), times)


def test_the_models_camera_sees_the_whole_scene_inside_its_box():
    views, side = ball_views(12, 0.5, size=4), 200
    frame = Frame(0.7, torch.eye(3), torch.tensor([0.2, -0.1, 0.3]))
    for (name, view), azimuth in product(VIEWS.items(), (None, 0.0, 70.0, -160.0)):
        case = f"{name}, azimuth {azimuth}"
        pose = canonical_pose(views, frame, view, azimuth=azimuth, elevation=25.0)
        offset = pose[:3, 3] - frame.centre
        rise = float(offset[2] / offset.norm())
        assert rise == pytest.approx(math.sin(math.radians(25)), abs=1e-5), case
        if azimuth is not None:
            found = math.degrees(math.atan2(float(offset[1]), float(offset[0])))
            assert found == pytest.approx(azimuth, abs=1e-3), case
        alignment = align(
            pose, focal=view.focal * side, height=side, width=side, target=frame.centre, view=view
        )
        assert alignment.mismatch.largest < 1e-3, case
        ball = inside_ball(2000, 1 / frame.scale) + frame.centre
        own = alignment.frame.points(ball)
        assert own.norm(dim=-1).max() <= view.half_side + 1e-4, case
        local = (ball - pose[:3, 3]) @ pose[:3, :3]
        seen = local[:, :2].abs().amax(dim=-1) / -local[:, 2] * view.focal
        assert 0.3 < seen.max() <= 0.5 + 1e-4, case


def test_without_an_azimuth_the_axis_nearest_to_a_camera_of_that_height_is_taken():
    views = ball_views(12, 0.5)
    frame = scene_frame(views)
    offsets = views.camera_to_world[:, :3, 3] - frame.centre
    heights = torch.asin(offsets[:, 2] / offsets.norm(dim=-1))
    chosen = offsets[(heights - math.radians(40)).abs().argmin()]
    pose = canonical_pose(views, frame, OPENLRM_VIEW, azimuth=None, elevation=40.0)
    flat = torch.nn.functional.normalize(pose[:2, 3] - frame.centre[:2], dim=0)
    axes = torch.tensor([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    nearest = axes[(axes @ chosen[:2]).argmax()]
    torch.testing.assert_close(flat, nearest, atol=1e-4, rtol=0)


def test_the_scenes_video_costs_nothing(tmp_path):
    bare, cache = ball_scene(), tmp_path / "cache"
    made, said = video_of(settings(tmp_path), replace(bare, video=ball_views(9, 0.6)), cache)
    assert (made.seconds, len(made.views), said, cache.exists()) == (0, 4, [], False)
    method = settings(tmp_path, "preparation.fixed_view=video")
    with pytest.raises(SceneError, match=r"preparation\.fixed_view=video: ball has no video"):
        video_of(method, bare, cache)
    # Of a scene of one timestep, the frame of that timestep is used.
    views = ball_views(6, 0.6, times=torch.full((6,), 0.5))
    scene = replace(bare, splits=bare.splits | {"train": views}, video=ball_views(5, 0.5))
    assert video_of(settings(tmp_path), scene, cache)[0].views.times.tolist() == [0.5]


def test_a_field_renders_the_scene_and_the_video_is_cached(tmp_path, small_fields, monkeypatch):
    scene, cache = ball_scene(count=12, size=24), tmp_path / "cache"
    made, said = video_of(settings(tmp_path), scene, cache)
    assert len(said) == 1
    assert made.seconds > 0
    assert made.views.images.shape == (4, 24, 24, 4)
    assert made.views.times.tolist() == pytest.approx([0, 1 / 3, 2 / 3, 1])
    alpha = made.views.images[..., 3].float() / 255
    # A ball of 0.6 in a scene as large: it fills the middle, not the corners.
    assert alpha[:, 9:15, 9:15].mean() > 0.8
    assert alpha[:, :3, :3].mean() < 0.2
    assert (made.views.images[..., :3] <= made.views.images[..., 3:]).all()
    assert [p.suffix for p in sorted(cache.iterdir())] == [".lock", ".pt"]
    monkeypatch.setattr(module, "trained_field", None)
    again, said = video_of(settings(tmp_path), scene, cache)
    assert said == []
    assert again.seconds == made.seconds
    assert torch.equal(again.views.images, made.views.images)


def test_an_interrupted_field_is_resumed(tmp_path, small_fields, monkeypatch):
    scene, cache = ball_scene(count=12, size=24), tmp_path / "cache"
    method = settings(tmp_path, "preparation.fixed_view_steps=3")
    with monkeypatch.context() as patch:
        patch.setattr(module, "_render", interrupt)
        with pytest.raises(KeyboardInterrupt):
            video_of(method, scene, cache)
    assert list(cache.glob("fixed_view-*/checkpoints/last.ckpt"))
    again = lambda *_: pytest.fail("a step that was done is done again")  # noqa: E731
    monkeypatch.setattr(RadianceModule, "training_step", again)
    video_of(method, scene, cache)
    assert not list(cache.glob("fixed_view-*/"))


def walled(views, *, alpha=255):
    """The views before a wall of colours, or with alpha that hides the wall."""
    images = views.images.clone()
    clear = images[..., 3] == 0
    images[clear] = torch.tensor([90, 140, 60, alpha], dtype=torch.uint8)
    return replace(views, images=images)


def test_a_video_of_the_world_around_the_thing_is_not_the_lrms(tmp_path, monkeypatch):
    rendered = object()
    monkeypatch.setattr(module, "_rendered", lambda *_: rendered)
    bare = ball_scene()
    camera = bare.splits["train"].camera_to_world[:1].expand(6, 4, 4)
    video = ball_views(6, 0.6, poses=camera, size=16)
    surrounded = replace(around(bare), video=walled(video))
    method = settings(tmp_path)
    assert video_of(method, surrounded, tmp_path)[0] is rendered
    masked = video_of(method, replace(surrounded, video=video), tmp_path)[0]
    assert masked.views.files == pick_frames(video, torch.linspace(0, 1, 4)).files
    wanted = settings(tmp_path, "preparation.fixed_view=video")
    asked = video_of(wanted, surrounded, tmp_path)[0]
    assert bool((asked.views.in_memory()[..., 3] == 255).all())


def around(bare):
    """A scene whose images show a wall around the thing."""
    return replace(bare, splits={split: walled(views) for split, views in bare.splits.items()})


def test_masks_beside_opaque_images_cut_the_thing_out(tmp_path, small_fields, monkeypatch):
    bare = ball_scene(size=24)
    scene = replace(around(bare), lrm_views=bare.splits["train"])
    assert scene.is_surrounded
    trained = []
    fit = training.fit_quietly
    monkeypatch.setattr(
        training, "fit_quietly", lambda *given, **how: (trained.append(given), fit(*given, **how))
    )
    _, said = video_of(settings(tmp_path, "preparation.fixed_view_steps=3"), scene, tmp_path)
    ((field, shown, *_),) = trained
    assert shown.splits["train"] is scene.lrm_views
    assert field.field.background is None
    assert not any("no silhouettes" in words for words in said)


def test_the_video_of_a_field_in_a_world_shows_the_cube_alone(tmp_path, small_fields):
    method = settings(tmp_path, "preparation.fixed_view_steps=3")
    made, said = video_of(method, around(ball_scene(size=24)), tmp_path)
    frames = made.views.in_memory().short()
    # Colours are multiplied by alpha: none has more than its opacity, as a wall behind would.
    assert (frames[..., :3] <= frames[..., 3:] + 1).all()
    assert frames[..., 3].min() < 250
    assert "no silhouettes" in said[0]
