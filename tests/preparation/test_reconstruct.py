"""A scene to a triplane sequence, placed in the world, with reduced models of every family."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tests.balls import ball_scene, ball_views, inside_ball, surrounding
from tests.lrm.reduced import SIDES, reduced
from tests.lrm.reference import compare
from tests.training.runs import small_config
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.fields import Decoder, XPlanes
from xplanes.lrm import LRMError
from xplanes.lrm.triposr import CHORD
from xplanes.models.initialisation import Method, Place
from xplanes.preparation.cache import StageCache
from xplanes.preparation.encode import straight_alpha
from xplanes.preparation.fixed_view import FixedView
from xplanes.preparation.reconstruct import align_to, picture_crop, reconstruct
from xplanes.run import prepare, train
from xplanes.scenes.frame import scene_frame

CHOICES = {
    "openlrm-1.0": "lrm=small lrm.architecture=openlrm-small-1.0".split(),
    "openlrm-1.1": ["lrm=small"],
    "triposr": ["lrm=large"],
}
FILES = {"openlrm-1.0": "model.pth", "openlrm-1.1": "model.safetensors", "triposr": "model.ckpt"}


def publish(folder: Path, name: str) -> Path:
    """A reduced model as its authors would publish it."""
    config, state = reduced(name)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(config))
    path = folder / FILES[name]
    if name == "openlrm-1.1":
        save_file(state, path)
    else:
        torch.save(state, path)
    return path


def plain_settings(folder: Path, name: str, *overrides: str) -> dict:
    given = (f"lrm.weights={publish(folder / name, name)}", "lrm.precision=32")
    return small_config(folder, *CHOICES[name], *given, "preparation.frames=3", *overrides)


def settings(folder: Path, name: str, *overrides: str) -> Method:
    return Method.read(plain_settings(folder, name, *overrides))


def silent(_: str) -> None:
    pass


def video_scene(size=24, count=6):
    """A scene with a video of a ball that hangs beside the middle."""

    def centre(time):
        return torch.tensor([0.2, -0.1, 0.2 * time])

    scene = ball_scene(count, size)
    pose = surrounding(1, 4.0, seed=7).expand(count, 4, 4)
    video = ball_views(count, 0.5, size=size, poses=pose, centre=centre)
    return replace(scene, video=video)


def made_of(method, scene):
    frame = scene_frame(scene.splits["train"])
    place = Place(scene, frame, torch.device("cpu"), say=silent)
    lrm = method.lrm.load_model(silent)
    return reconstruct(method, method.lrm, place, lrm, StageCache(None)), lrm, frame


@pytest.mark.parametrize(
    ("name", "matching"),
    [("openlrm-1.0", "scale"), ("openlrm-1.1", "pad"), ("triposr", "scale"), ("triposr", "pad")],
)
def test_the_field_is_the_models_at_its_place_in_the_world(tmp_path, name, matching):
    method = settings(tmp_path, name, f"lrm.matching={matching}", "lrm.crop=false")
    scene = video_scene()
    made, lrm, frame = made_of(method, scene)
    sequence, model = made.sequence, lrm.model
    assert len(sequence.triplanes) == 3
    alignment = align_to(FixedView(scene.video, frame.centre, 0.0, ""), model, method.lrm)
    decoder = Decoder(sequence.triplanes.shape[2], **dict(sequence.decoder_config))
    decoder.load_state_dict(dict(sequence.decoder))
    picture = straight_alpha(scene.video.images[:1])
    own = model.encode(model.prepare(alignment.crop.apply(picture)))[0]
    world = inside_ball(400, 0.8) + frame.centre
    in_model = alignment.frame.points(world)
    # Near the border the planes fade, where those of the larger cube go on.
    texel = 2 * model.half_side / own.shape[-1]
    kept = in_model.abs().amax(dim=-1) < model.half_side - texel
    in_field = sequence.frame.points(world)
    kept &= in_field.abs().amax(dim=-1) < 1 - 2 / sequence.triplanes.shape[-1]
    assert kept.sum() > 100
    times = torch.zeros(len(world))

    def ask(triplane, decoder, points):
        planes = dict(zip(("xy", "xz", "yz"), triplane, strict=True))
        return XPlanes(planes=planes, decoder=decoder, plane_set="three")(points, times)

    colour, density = ask(sequence.triplanes[0], decoder, in_field)
    expected_colour, expected = ask(own, model.decoder, in_model / model.half_side)
    compare(colour[kept], expected_colour[kept], atol=2e-4, rtol=0, case=name)
    # Both as density per unit of the world.
    density, expected = density * sequence.frame.scale, expected * alignment.frame.scale
    compare(density[kept], expected[kept], rtol=2e-3, atol=1e-5, case=name)
    assert density[kept].max() > 1e-4
    if name == "triposr":
        assert model.decoder.density_scale == pytest.approx(1 / CHORD)


@pytest.mark.parametrize("name", SIDES)
def test_the_cube_holds_all_that_the_views_show_and_the_report_is_whole(tmp_path, name):
    made, lrm, frame = made_of(settings(tmp_path, name), video_scene())
    ball = inside_ball(3000, 1 / frame.scale) + frame.centre
    assert made.sequence.frame.points(ball).abs().max() <= 1 + 1e-4
    assert made.report["frames"] == made.report["distinct"] == 3
    assert made.report["cached"] == 0
    apart = made.report["mismatch_pixels"]
    assert 0 < apart["mean"] < apart["largest"] < 24
    assert f"up to {apart['largest']:.1f} px apart" in made.description
    assert made.seconds["fixed_view"] == 0
    assert made.seconds["lrm"] > lrm.seconds > 0
    assert made.picture.shape == (160, 3 * 160, 3)
    assert made.picture.std() > 0.01


def test_one_crop_holds_the_object_at_all_times(tmp_path):
    frames = video_scene(size=48).video.images
    crop = picture_crop(frames, crop=True)
    tight = (frames[..., 3].amax(dim=0) > 0).nonzero()
    spans = tight.amax(dim=0) - tight.amin(dim=0)
    assert crop.side == int(int(spans.max()) / 0.85)
    assert picture_crop(frames, crop=False).side == 48
    floaters = frames.clone()
    floaters[:, 1, 1] = 20
    assert picture_crop(floaters, crop=True) == crop
    opaque = torch.full_like(frames, 255)
    assert picture_crop(opaque, crop=True).side == 48
    with pytest.raises(LRMError, match=r"empty.*lrm\.crop=false"):
        picture_crop(torch.zeros_like(frames), crop=True)


def test_weights_of_another_size_are_refused_before_any_scene_is_read(tmp_path):
    plain = plain_settings(tmp_path, "openlrm-1.1")
    wrong = publish(tmp_path / "wrong", "triposr")
    (tmp_path / "wrong" / "config.json").unlink()
    plain["lrm"]["weights"] = str(wrong)
    with pytest.raises(LRMError, match=r"does not fit openlrm-small-1\.1"):
        train(prepare(Experiment.read(plain), tmp_path / "run"), resume=False)
    assert not (tmp_path / "excavator_32px_s0").exists()


def test_missing_weights_name_the_way_out(tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(LRMError, match=r"446 MB.*CC-BY-NC-4\.0.*lrm\.weights=FILE"):
        Method.read(small_config(tmp_path, "lrm=small")).lrm.load(silent)
    with pytest.raises(ConfigError, match=r"lrm\.batch=0"):
        settings(tmp_path, "openlrm-1.1", "lrm.batch=0")
