"""Images in, triplanes and a turntable video out."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.preparation.test_encode import frames_of, model_of
from tests.preparation.test_reconstruct import publish
from xplanes.cli import main
from xplanes.config import compose_plain
from xplanes.experiment import Experiment
from xplanes.preparation import load_triplanes
from xplanes.preparation.encode import straight_alpha
from xplanes.tools import turntable as module
from xplanes.tools.turntable import turntable, write_triplanes


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


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("PICTURES lrm=none", "lrm=none does not encode images.*lrm=small"),
        ("PICTURES lrm=small out=made.zip", r"out=made\.zip: must end in"),
        ("PICTURES lrm=small lrm.weight=a", r"Did you mean lrm\.weights"),
        ("PICTURES lrm=small lrm.weights=absent.pt", r"lrm\.weights=absent\.pt is not a file"),
        ("absent.png lrm=tiny", r"absent\.png"),
        (". lrm=tiny", "contains no images"),
        ("lrm=tiny", "at least one"),
    ],
)
def test_what_makes_no_triplanes_is_refused(given, words, tmp_path, pictures, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["triplanes", *given.replace("PICTURES", str(pictures)).split()]) == 1
    assert re.search(words, capsys.readouterr().err)


def test_opaque_images_cause_a_message(tmp_path, few, capsys):
    picture = tmp_path / "opaque.png"
    Image.fromarray(np.full((30, 30, 3), 90, np.uint8)).save(picture)
    weights = publish(tmp_path, "openlrm-1.1")
    given = ["lrm=small", f"lrm.weights={weights}", "preparation.cache=null"]
    experiment = Experiment.read(compose_plain("train", given))
    write_triplanes([picture], tmp_path / "a.pt", experiment)
    assert "no transparency" in capsys.readouterr().out
    assert load_triplanes(tmp_path / "a.pt").triplanes.shape == (1, 3, 6, 8, 8)
