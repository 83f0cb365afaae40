"""Files of triplane sequences: round trip, and errors for invalid ones."""

from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import pytest
import torch

from tests.preparation.sequences import OPTIONS, moving_sequence
from tests.refusals import assert_refused
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


def test_a_sequence_comes_back_as_it_was(tmp_path):
    kinds = (torch.float32, torch.float16, torch.bfloat16, torch.float64)
    for name, kind in product(FILES, kinds):
        case = f"{kind} in {name}"
        sequence = replace(whole(), triplanes=whole().triplanes.to(kind))
        save_triplanes(tmp_path / name, sequence)
        back = load_triplanes(tmp_path / name)
        assert back.triplanes.dtype == kind, case
        assert torch.equal(back.triplanes, sequence.triplanes), case
        assert all(torch.equal(back.decoder[key], v) for key, v in sequence.decoder.items()), case
        assert back.decoder_config == OPTIONS, case
        assert back.frame.scale == 0.5, case
        assert torch.equal(back.frame.rotation, ROTATION), case
        assert torch.equal(back.frame.centre, sequence.frame.centre), case


def test_triplanes_alone_are_enough(tmp_path):
    for name in FILES:
        save_triplanes(tmp_path / name, TriplaneSequence(moving_sequence()))
        back = load_triplanes(tmp_path / name)
        assert (back.decoder, back.decoder_config, back.frame) == (None, None, None), name


def test_a_view_of_a_larger_tensor_is_written_alone(tmp_path):
    large = moving_sequence(200, 2, 8)
    save_triplanes(tmp_path / "a.pt", TriplaneSequence(large[:2]))
    assert (tmp_path / "a.pt").stat().st_size < large[:2].numel() * 4 + 4096


def refusal(path: Path) -> str:
    with pytest.raises((ConfigError, SceneError)) as caught:
        load_triplanes(path)
    assert str(path) in str(caught.value)
    return str(caught.value)


def test_missing_and_damaged_files_are_named(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.pt")
    save_triplanes(tmp_path / "a.safetensors", whole())
    content = (tmp_path / "a.safetensors").read_bytes()
    (tmp_path / "a.safetensors").write_bytes(content[: len(content) // 2])
    assert "damaged" in refusal(tmp_path / "a.safetensors")
    for content in (b"", b"text", b"PK\x03\x04 half a zip"):
        (tmp_path / "a.pt").write_bytes(content)
        assert "cannot be read" in refusal(tmp_path / "a.pt"), content


def spoiled(entry: int, value: float) -> torch.Tensor:
    planes = moving_sequence()
    planes[entry, 1, 0, 3, 3] = value
    return planes


GOOD = torch.zeros(2, 3, 4, 5, 5)

WRONG = {
    "list": ([1, 2], "must be a dict"),
    "no triplanes": ({"planes": GOOD}, "planes: there must be a dict with the key triplanes"),
    "unknown key": ({"triplanes": GOOD, "colour": 1}, "unknown keys colour"),
    "no tensor": ({"triplanes": [1.0]}, "triplanes are list"),
    "integers": ({"triplanes": GOOD.int()}, "torch.int32"),
    "four dimensions": ({"triplanes": GOOD[0]}, r"\[3, 4, 5, 5\], but must be \[T, 3, C, H, H\]"),
    "two planes": ({"triplanes": GOOD[:, :2]}, r"must be \[T, 3, C, H, H\]"),
    "not square": ({"triplanes": GOOD[..., :3]}, r"must be \[T, 3, C, H, H\]"),
    "no frames": ({"triplanes": GOOD[:0]}, r"must be \[T, 3, C, H, H\]"),
    "nan": ({"triplanes": spoiled(2, float("nan"))}, "triplane 2 of 8 holds NaN"),
    "infinity": ({"triplanes": spoiled(5, float("inf"))}, "triplane 5 of 8 holds NaN or inf"),
    "beyond single precision": (
        {"triplanes": spoiled(5, 1.0).double() * 1e300},
        "triplane 0 of 8 holds NaN or infinity",
    ),
    "decoder alone": ({"triplanes": GOOD, "decoder": {}}, "given together"),
    "decoder options": (
        {"triplanes": GOOD, "decoder": {}, "decoder_config": {"width": 3}},
        "decoder_config has the keys width, but must have width, hidden",
    ),
    "option type": (
        {"triplanes": GOOD, "decoder": {}, "decoder_config": OPTIONS | {"width": "12"}},
        "decoder_config.width=12: must be a whole number",
    ),
    "huge decoder": (
        {"triplanes": GOOD, "decoder": {}, "decoder_config": OPTIONS | {"width": 10**9}},
        "out of range",
    ),
    "decoder shape": (
        {
            "triplanes": GOOD,
            "decoder": Decoder(5, **OPTIONS).state_dict(),
            "decoder_config": OPTIONS,
        },
        "decoder does not fit decoder_config and 4 channels",
    ),
    "frame keys": ({"triplanes": GOOD, "frame": {"scale": 1.0}}, "frame must be a dict of"),
    "frame kind": ({"triplanes": GOOD, "frame": 3}, "frame must be a dict of"),
    "frame scale": (
        {"triplanes": GOOD, "frame": {"scale": 0, "rotation": ROTATION, "centre": [0, 0, 0]}},
        "frame.scale=0.0",
    ),
    "frame centre": (
        {"triplanes": GOOD, "frame": {"scale": 1, "rotation": ROTATION, "centre": [0, 0]}},
        r"frame.centre \[2\]",
    ),
    "mirrored": (
        {"triplanes": GOOD, "frame": {"scale": 1, "rotation": -ROTATION, "centre": [0, 0, 0]}},
        "not a rotation",
    ),
}


def test_what_cannot_be_used_is_refused_with_a_message(tmp_path):
    path = tmp_path / "a.pt"
    for case, (content, words) in WRONG.items():
        torch.save(content, path)
        said = assert_refused((ConfigError, SceneError), words, partial(load_triplanes, path), case)
        assert str(path) in said, case


def test_what_could_not_be_loaded_is_not_written(tmp_path):
    with pytest.raises(ConfigError, match="NaN"):
        save_triplanes(tmp_path / "a.pt", TriplaneSequence(spoiled(0, float("nan"))))
    assert not list(tmp_path.iterdir())


def test_files_are_no_code(tmp_path):
    class Evil:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "executed",))

    torch.save({"triplanes": Evil()}, tmp_path / "a.pt")
    assert "cannot be read" in refusal(tmp_path / "a.pt")
    assert not (tmp_path / "executed").exists()
