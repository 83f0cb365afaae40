"""Images in, triplanes and a turntable video out."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.preparation.test_encode import frames_of, model_of
from tests.preparation.test_reconstruct import publish
from xplanes.cli import main
from xplanes.config import compose_plain
from xplanes.errors import ConfigError, SceneError
from xplanes.experiment import Experiment
from xplanes.lrm import LRMError
from xplanes.preparation import load_triplanes
from xplanes.preparation.encode import straight_alpha
from xplanes.tools import turntable as module
from xplanes.tools.turntable import find_pictures, turntable, write_triplanes


def settings(*overrides: str) -> Experiment:
    return Experiment.read(compose_plain("train", overrides))


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """A folder of three pictures, two of them equal."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number, frame in enumerate(straight_alpha(frames_of(2))[[0, 1, 0]]):
        pixels = (frame.permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
        Image.fromarray(pixels).save(folder / f"{number}.png")
    return folder


@pytest.fixture
def few(monkeypatch):
    """A short video of small images."""
    monkeypatch.setattr(module, "FRAMES", 6)
    monkeypatch.setattr(module, "SIDE", 24)


def test_images_become_triplanes_and_a_video(tmp_path, pictures, few, capsys):
    weights, out = publish(tmp_path, "openlrm-1.1"), tmp_path / "made.safetensors"
    arguments = ["lrm=small", f"lrm.weights={weights}", f"preparation.cache={tmp_path}/cache"]
    assert main(["triplanes", str(pictures), *arguments, f"out={out}"]) == 0
    assert f"wrote {out}: 3 triplanes of 8 x 8 texels and 6 channels" in capsys.readouterr().out
    sequence = load_triplanes(out)
    assert sequence.triplanes.shape == (3, 3, 6, 8, 8)
    assert torch.equal(sequence.triplanes[0], sequence.triplanes[2])
    assert not torch.equal(sequence.triplanes[0], sequence.triplanes[1])
    model = model_of()
    for name, tensor in model.decoder.state_dict().items():
        assert torch.equal(sequence.decoder[name], tensor)
    assert sequence.decoder_config == model.decoder.options
    with Image.open(out.with_suffix(".webp")) as video:
        assert video.size == (24, 24)


def test_images_of_a_folder_come_in_the_order_of_their_numbers(tmp_path):
    for name in ("f_10.png", "f_2.png", "f_1.png", ".f_3.png", "notes.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in module.find_pictures([tmp_path])] == ["f_1.png", "f_2.png", "f_10.png"]


def test_the_video_begins_at_the_models_camera_and_completes_one_orbit(few):
    model = model_of()
    with torch.no_grad():
        # Dense where the features of plane xz are positive: on the side x > 0.
        for layer in model.decoder.layers:
            layer.weight.zero_()
            layer.bias.zero_()
            layer.weight[0, 0] = 1
        model.decoder.layers[0].weight[0] = 0
        model.decoder.layers[0].weight[0, 6] = 1
        model.decoder.layers[-1].bias[0] = -5
    triplane = torch.zeros(1, 3, 6, 8, 8)
    triplane[0, 1, 0, :, 4:] = 100.0
    frames = [frame.float() for frame in turntable(triplane, model, torch.device("cpu"))]
    assert len(frames) == 6
    # Half a turn later the sides are exchanged.
    for frame in (frames[0], frames[3].flip(1)):
        assert frame[:, :10].mean() > 250
        assert frame[:, 14:].mean() < 200


def test_settings_that_make_no_triplanes_are_refused(tmp_path, pictures):
    def make(*arguments, out="made.pt"):
        write_triplanes([pictures], Path(out), settings(*arguments))

    with pytest.raises(ConfigError, match=r"lrm=none does not encode images.*lrm=small"):
        make("lrm=none")
    with pytest.raises(ConfigError, match=r"out=made\.zip: must end in"):
        make("lrm=small", out="made.zip")
    with pytest.raises(ConfigError, match=r"Did you mean lrm\.weights"):
        make("lrm=small", "lrm.weight=a")
    with pytest.raises(LRMError, match=r"lrm\.weights=absent\.pt is not a file"):
        make("lrm=small", "lrm.weights=absent.pt")


def test_missing_images_are_named(tmp_path):
    cases = (
        ([tmp_path / "absent.png"], "absent"),
        ([tmp_path], "contains no images"),
        ([], "at least one"),
    )
    for paths, words in cases:
        with pytest.raises(SceneError, match=words):
            find_pictures(paths)


def test_opaque_images_cause_a_message(tmp_path, few, capsys):
    picture = tmp_path / "opaque.png"
    Image.fromarray(np.full((30, 30, 3), 90, np.uint8)).save(picture)
    weights = publish(tmp_path, "openlrm-1.1")
    experiment = settings("lrm=small", f"lrm.weights={weights}", "preparation.cache=null")
    write_triplanes([picture], tmp_path / "a.pt", experiment)
    assert "no transparency" in capsys.readouterr().out
    assert load_triplanes(tmp_path / "a.pt").triplanes.shape == (1, 3, 6, 8, 8)
