"""Files of triplane sequences: round trip, and errors for invalid ones."""

import io
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.preparation.sequences import OPTIONS, moving_sequence
from tests.refusals import Evil
from xplanes.errors import ConfigError, SceneError
from xplanes.fields import Decoder
from xplanes.preparation import TriplaneSequence, load_triplanes, save_triplanes
from xplanes.scenes.frame import Frame

ROTATION = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])


def whole(channels: int = 4) -> TriplaneSequence:
    decoder = Decoder(channels, **OPTIONS)
    frame = Frame(0.5, ROTATION, torch.tensor([0.1, 0.2, 0.3]))
    return TriplaneSequence(
        moving_sequence(3, channels, 6), decoder.state_dict(), dict(OPTIONS), frame
    )


FILES = ("a.pt", "a.safetensors")


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("kind", [torch.float32, torch.float16, torch.bfloat16, torch.float64])
def test_a_sequence_comes_back_as_it_was(tmp_path, name, kind):
    sequence = replace(whole(), triplanes=whole().triplanes.to(kind))
    save_triplanes(tmp_path / name, sequence)
    back = load_triplanes(tmp_path / name)
    assert back.triplanes.dtype == kind
    assert torch.equal(back.triplanes, sequence.triplanes)
    assert all(torch.equal(back.decoder[key], v) for key, v in sequence.decoder.items())
    assert (back.decoder_config, back.frame.scale) == (OPTIONS, 0.5)
    assert torch.equal(back.frame.rotation, ROTATION)
    assert torch.equal(back.frame.centre, sequence.frame.centre)


def test_triplanes_alone_are_enough_and_a_view_of_a_larger_tensor_is_written_alone(tmp_path):
    sequence = TriplaneSequence(moving_sequence(200, 2, 8)[:2])
    for name in FILES:
        save_triplanes(tmp_path / name, sequence)
        back = load_triplanes(tmp_path / name)
        assert (back.decoder, back.decoder_config, back.frame) == (None, None, None), name
    assert (tmp_path / "a.pt").stat().st_size < sequence.triplanes.numel() * 4 + 4096


def in_file(content: object) -> bytes:
    """What torch.save makes of it."""
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def refused(path: Path, words: str) -> None:
    """A file is refused by its name, and none of its code is run."""
    with pytest.raises((ConfigError, SceneError), match=words) as caught:
        load_triplanes(path)
    assert str(path) in str(caught.value)


def test_missing_and_damaged_files_are_named(tmp_path, capsys):
    refused(tmp_path / "none.pt", "no such file")
    path = tmp_path / "a.safetensors"
    save_triplanes(path, whole())
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refused(path, "damaged")
    path = tmp_path / "a.pt"
    for content in (b"", b"text", b"PK\x03\x04 half a zip", in_file({"triplanes": Evil()})):
        path.write_bytes(content)
        refused(path, "cannot be read")
    assert capsys.readouterr().out == ""


def spoiled(entry: int, value: float) -> torch.Tensor:
    planes = moving_sequence()
    planes[entry, 1, 0, 3, 3] = value
    return planes


GOOD = torch.zeros(2, 3, 4, 5, 5)
POSE = {"scale": 1, "rotation": ROTATION, "centre": [0, 0, 0]}


def decoded(width: object = 12, channels: int = 4) -> dict:
    """Triplanes with a decoder of another number of channels, and with another width."""
    decoder = Decoder(channels, **OPTIONS).state_dict()
    return {"triplanes": GOOD, "decoder": decoder, "decoder_config": OPTIONS | {"width": width}}


def framed(**changes: object) -> dict:
    return {"triplanes": GOOD, "frame": POSE | changes}


WRONG = {
    "list": ([1, 2], "must be a dict"),
    "no triplanes": ({"planes": GOOD}, "planes: it must be a dict with the key triplanes"),
    "unknown key": ({"triplanes": GOOD, "colour": 1}, "unknown keys colour"),
    "no tensor": ({"triplanes": [1.0]}, "triplanes are list"),
    "integers": ({"triplanes": GOOD.int()}, "torch.int32"),
    "four dimensions": ({"triplanes": GOOD[0]}, r"\[3, 4, 5, 5\], but must be \[T, 3, C, H, H\]"),
    "two planes": ({"triplanes": GOOD[:, :2]}, r"must be \[T, 3, C, H, H\]"),
    "not square": ({"triplanes": GOOD[..., :3]}, r"must be \[T, 3, C, H, H\]"),
    "no frames": ({"triplanes": GOOD[:0]}, r"must be \[T, 3, C, H, H\]"),
    "nan": ({"triplanes": spoiled(2, float("nan"))}, "triplane 2 of 8 holds NaN"),
    "infinity": ({"triplanes": spoiled(5, float("inf"))}, "triplane 5 of 8 holds NaN or inf"),
    "too large": ({"triplanes": spoiled(5, 1.0).double() * 1e300}, "triplane 0 of 8 holds NaN"),
    "decoder alone": ({"triplanes": GOOD, "decoder": {}}, "given together"),
    "decoder options": (
        decoded() | {"decoder_config": {"width": 3}},
        "decoder_config has the keys width, but must have width, hidden",
    ),
    "option type": (decoded(width="12"), "decoder_config.width=12: must be a whole number"),
    "huge decoder": (decoded(width=10**9), "out of range"),
    "decoder shape": (decoded(channels=5), "decoder does not fit decoder_config and 4 channels"),
    "frame keys": ({"triplanes": GOOD, "frame": {"scale": 1.0}}, "frame must be a dict of"),
    "frame kind": ({"triplanes": GOOD, "frame": 3}, "frame must be a dict of"),
    "frame scale": (framed(scale=0), "frame.scale=0.0"),
    "frame centre": (framed(centre=[0, 0]), r"frame.centre \[2\]"),
    "mirrored": (framed(rotation=-ROTATION), "not a rotation"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_used_is_refused_with_a_message(tmp_path, case):
    content, words = WRONG[case]
    torch.save(content, tmp_path / "a.pt")
    refused(tmp_path / "a.pt", words)


def test_what_could_not_be_loaded_is_not_written(tmp_path):
    with pytest.raises(ConfigError, match="NaN"):
        save_triplanes(tmp_path / "a.pt", TriplaneSequence(spoiled(0, float("nan"))))
    assert not list(tmp_path.iterdir())
