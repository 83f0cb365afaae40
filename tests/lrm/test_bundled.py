"""Bundled models: loaded, or refused by their checksum."""

import hashlib
import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tests.lrm.reduced import reduced
from tests.refusals import flip
from xplanes.components import build
from xplanes.config import compose_plain
from xplanes.lrm import LRMError
from xplanes.lrm.weights import CHECKSUM, bundled_models, load_bundled
from xplanes.preparation.sources import BundledLRMSettings


def ship(folder: Path, name: str, seed: int = 0) -> Path:
    """A reduced model in the form in which the package carries its own."""
    config, state = reduced("openlrm-1.1")
    state = {key: (tensor + seed).half() for key, tensor in state.items()}
    path = folder / f"{name}.safetensors"
    save_file(state, path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / f"{name}.json").write_text(json.dumps({**config, CHECKSUM: digest}))
    return path


def test_a_model_is_loaded_from_half_precision(tmp_path):
    path = ship(tmp_path, "tiny")
    assert bundled_models(tmp_path) == ["tiny"]
    model, found = load_bundled("tiny", tmp_path)
    assert found == path
    expected = reduced("openlrm-1.1")[1]["pos_embed"]
    assert model.position.dtype == torch.float32
    torch.testing.assert_close(model.position, expected, atol=2e-3, rtol=1e-3)
    assert model.encode(torch.rand(1, 3, 56, 56)).isfinite().all()


def test_changed_weights_are_refused(tmp_path):
    path = ship(tmp_path, "tiny")
    flip(path, -5)
    words = r"tiny\.safetensors is damaged or belongs to another model: its SHA-256"
    with pytest.raises(LRMError, match=words):
        load_bundled("tiny", tmp_path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(LRMError, match=r"tiny\.safetensors is damaged"):
        load_bundled("tiny", tmp_path)


def test_a_model_that_is_not_there_is_named_with_those_that_are(tmp_path):
    ship(tmp_path, "tiny")
    with pytest.raises(LRMError, match=r"huge\.safetensors.*no such model.*contains tiny"):
        load_bundled("huge", tmp_path)
    (tmp_path / "tiny.json").unlink()
    with pytest.raises(LRMError, match=r"tiny\.json: no such model.*contains none"):
        load_bundled("tiny", tmp_path)


def test_the_file_that_is_named_is_the_one_that_is_read(tmp_path):
    path = ship(tmp_path, "own")

    def settings(weights: Path) -> BundledLRMSettings:
        lrm = compose_plain("train", ["lrm=tiny", f"lrm.weights={weights}"])["lrm"]
        return build(lrm, BundledLRMSettings, "lrm")

    assert settings(path).load_model(print).key
    beside = tmp_path / "own.ckpt"
    for name in (beside, tmp_path / "absent.safetensors"):
        with pytest.raises(LRMError, match=rf"lrm.weights=.*{name.name}: there is no such file"):
            settings(name).load_model(print)
    beside.write_bytes(path.read_bytes())
    with pytest.raises(LRMError, match=r"own\.ckpt is not a .safetensors file.*lrm=large"):
        settings(beside).load_model(print)
