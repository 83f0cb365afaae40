"""The fixed-view video: the scene's own, or filmed by a field."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.baselines.runs import KPLANES, PROPOSAL
from tests.synthetic import ball_scene, ball_views, inside_ball
from tests.training.runs import small_config
from xplanes.checks import parse
from xplanes.config import ConfigError, compose_plain
from xplanes.launch import settings as settings_of
from xplanes.lrm.alignment import align
from xplanes.lrm.canonical import OPENLRM_VIEW, TRIPOSR_VIEW
from xplanes.preparation import fixed_view as module
from xplanes.preparation.cache import StageCache
from xplanes.preparation.fixed_view import canonical_pose, filming_settings, fixed_view, pick_frames
from xplanes.scenes.errors import SceneError
from xplanes.scenes.frame import Frame, scene_frame

VIEWS = {"openlrm": OPENLRM_VIEW, "triposr": TRIPOSR_VIEW}


def settings(folder: Path, *overrides: str):
    return parse(
        small_config(
            folder,
            "preparation.frames=4",
            "preparation.fixed_view_seconds=1000",
            "preparation.fixed_view_steps=60",
            *overrides,
        )
    )


def film(config, scene, folder, size=24):
    frame = scene_frame(scene.splits["train"])
    said = []
    cache = StageCache(folder)
    made = fixed_view(config, scene, frame, OPENLRM_VIEW, size, cache, say=said.append)
    return made, said


def test_the_field_that_films_has_its_models_default_settings(tmp_path: Path):
    own = settings(tmp_path, "model=nine_planes", "sampler.samples=16", "seed=3")
    filming, default = filming_settings(own), settings_of([])
    assert (filming.model, filming.loss) == (default.model, default.loss)
    # Pictures for a model of few pixels need no more samples than training.
    assert filming.sampler == replace(default.sampler, render_samples=default.sampler.samples)
    assert filming.seed == 3
    assert filming.data == own.data
    assert (filming.trainer.accelerator, filming.trainer.max_steps) == ("cpu", 60)


def test_kplanes_film_as_published(tmp_path: Path):
    filming = filming_settings(settings(tmp_path, "preparation.fixed_view_model=kplanes"))
    published = settings_of(["model=kplanes"])
    assert (filming.model, filming.sampler, filming.loss) == (
        published.model,
        published.sampler,
        published.loss,
    )
    assert not filming.data.skip_background
    assert filming.trainer.rays_per_batch == published.trainer.rays_per_batch


def test_a_model_that_is_not_there_cannot_film(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"fixed_view_model=nerf: must be one of kplanes, "):
        settings(tmp_path, "preparation.fixed_view_model=nerf")


def test_kplanes_film_in_their_own_cube(tmp_path: Path, monkeypatch):
    reduced = (*KPLANES, *PROPOSAL)
    monkeypatch.setattr(
        module, "compose_plain", lambda name, lines: compose_plain(name, [*lines, *reduced])
    )
    options = ("preparation.fixed_view_model=kplanes", "preparation.fixed_view_steps=200")
    config = settings(tmp_path, *options)
    made, said = film(config, ball_scene(count=12, size=24), tmp_path / "cache")
    assert "training kplanes for" in said[0]
    alpha = made.views.images[..., 3].float() / 255
    # Coarse planes blur it.
    assert alpha[:, 9:15, 9:15].mean() > 1.5 * alpha[:, :3, :3].mean() > 0


@pytest.mark.parametrize("count", [1, 4, 9])
def test_frames_are_picked_evenly(count):
    video = ball_views(33, 0.5)
    expected = torch.linspace(0, 1, count) if count > 1 else torch.tensor([0.4])
    picked = pick_frames(video, expected)
    assert (picked.times - expected).abs().max() <= 0.5 / 32 + 1e-6
    assert len(picked) == count


def test_of_a_scene_of_one_moment_the_frame_of_that_moment_is_picked(tmp_path: Path):
    still = ball_scene(moving=False)
    views = still.splits["train"]
    views = replace(views, times=torch.full_like(views.times, 0.5))
    scene = replace(still, splits=still.splits | {"train": views}, video=ball_views(5, 0.5))
    made, _ = film(settings(tmp_path), scene, tmp_path / "cache")
    assert made.views.times.tolist() == [0.5]


def test_a_video_of_few_frames_repeats_them():
    picked = pick_frames(ball_views(3, 0.5), torch.linspace(0, 1, 7))
    assert picked.times.tolist() == [0, 0, 0.5, 0.5, 0.5, 1, 1]


@pytest.mark.parametrize("times", [[0.0, 0.1, 0.2, 0.3], [0.6, 0.8, 1.0], [0, 0.05, 0.95, 1]])
def test_a_video_that_leaves_out_moments_is_refused(times):
    video = ball_views(len(times), 0.5, times=torch.tensor(times))
    with pytest.raises(SceneError, match=r"no frame near time .*preparation\.fixed_view=train"):
        pick_frames(video, torch.linspace(0, 1, 50))


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("azimuth", [None, 0.0, 70.0, -160.0])
def test_the_models_camera_sees_the_whole_scene_inside_its_box(name, azimuth):
    view, views = VIEWS[name], ball_views(12, 0.5)
    frame = Frame(0.7, torch.eye(3), torch.tensor([0.2, -0.1, 0.3]))
    pose = canonical_pose(views, frame, view, azimuth=azimuth, elevation=25.0)
    offset = pose[:3, 3] - frame.centre
    assert float(offset[2] / offset.norm()) == pytest.approx(math.sin(math.radians(25)), abs=1e-5)
    if azimuth is not None:
        found = math.degrees(math.atan2(float(offset[1]), float(offset[0])))
        assert found == pytest.approx(azimuth, abs=1e-3)
    side = 200
    alignment = align(
        pose, focal=view.focal * side, height=side, width=side, target=frame.centre, view=view
    )
    assert alignment.mismatch.largest < 1e-3
    ball = inside_ball(2000, 1 / frame.scale) + frame.centre
    own = alignment.frame.points(ball)
    assert own.norm(dim=-1).max() <= view.half_side + 1e-4
    local = (ball - pose[:3, 3]) @ pose[:3, :3]
    seen = local[:, :2].abs().amax(dim=-1) / -local[:, 2] * view.focal
    assert 0.3 < seen.max() <= 0.5 + 1e-4


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


def test_the_scenes_video_costs_nothing(tmp_path: Path):
    scene = replace(ball_scene(), video=ball_views(9, 0.6))
    made, said = film(settings(tmp_path), scene, tmp_path / "cache")
    assert made.seconds == 0
    assert len(made.views) == 4
    assert said == []
    assert not (tmp_path / "cache").exists()


def test_a_video_that_is_not_there_is_refused(tmp_path: Path):
    with pytest.raises(SceneError, match=r"preparation\.fixed_view=video: ball has no video"):
        film(settings(tmp_path, "preparation.fixed_view=video"), ball_scene(), tmp_path)


def test_a_field_films_the_scene_and_the_film_is_kept(tmp_path: Path, monkeypatch):
    scene, cache = ball_scene(count=12, size=24), tmp_path / "cache"
    made, said = film(settings(tmp_path), scene, cache)
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
    monkeypatch.setattr(module, "_train", None)
    again, said = film(settings(tmp_path), scene, cache)
    assert said == []
    assert again.seconds == made.seconds
    assert torch.equal(again.views.images, made.views.images)


def test_a_still_scene_is_filmed_once(tmp_path: Path):
    made, _ = film(
        settings(tmp_path, "preparation.fixed_view_steps=5"), ball_scene(moving=False), tmp_path
    )
    assert len(made.views) == 1


def test_an_interrupted_field_goes_on_where_it_stopped(tmp_path: Path, monkeypatch):
    scene, cache = ball_scene(count=12, size=24), tmp_path / "cache"
    config = settings(tmp_path, "preparation.fixed_view_steps=20")

    def stop(*_):
        raise KeyboardInterrupt

    original = module._film
    monkeypatch.setattr(module, "_film", stop)
    with pytest.raises(KeyboardInterrupt):
        film(config, scene, cache)
    assert list(cache.glob("fixed_view-*/checkpoints/last.ckpt"))
    steps = []
    monkeypatch.setattr(module, "_film", original)
    monkeypatch.setattr(
        module.RadianceModule, "training_step", lambda self, *_: steps.append(self.global_step)
    )
    film(config, scene, cache)
    assert steps == []  # all were done
    assert not list(cache.glob("fixed_view-*/"))
