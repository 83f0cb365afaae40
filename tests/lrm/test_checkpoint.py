"""Published files load strictly, and what does not match is refused with a message."""

import json
import pickle

import pytest
import torch
from safetensors.torch import save_file

from tests.lrm.reduced import CONFIGS, SIDES, published_shapes, reduced
from tests.lrm.reference import FOLDER, compare
from tests.refusals import Evil
from xplanes.lrm import LRM, LRMError, load
from xplanes.lrm.checkpoint import build, fill, mismatches
from xplanes.lrm.config import PUBLISHED, parse_config, published_config

FAMILIES = list(CONFIGS)


def save(path, state):
    if path.suffix == ".safetensors":
        save_file(state, path)
    else:
        torch.save(state, path)
    return path


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """A reduced model of each family, loaded from a file."""
    folder, given = tmp_path_factory.mktemp("models"), {name: reduced(name) for name in FAMILIES}
    return {
        name: load(settings, save(folder / f"{name}.safetensors", state))
        for name, (settings, state) in given.items()
    }


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("file", ["model.safetensors", "pytorch_model.bin", "model.ckpt"])
def test_every_published_form_of_file_loads(tmp_path, name, file):
    settings, state = reduced(name)
    model = load(settings, save(tmp_path / file, state))
    assert isinstance(model, LRM)
    assert model.config.architecture == name
    assert not model.training
    assert not any(p.is_meta or p.requires_grad for p in model.parameters())
    assert sum(p.numel() for p in model.parameters()) == sum(t.numel() for t in state.values())


def test_encoding_is_of_each_image_alone_and_in_bfloat16_too(models):
    for name, model in models.items():
        images = torch.rand(3, 3, SIDES[name], SIDES[name])
        triplanes = model.encode(images)
        assert triplanes.shape == (3, 3, 6, 8, 8), name
        assert triplanes.isfinite().all(), name
        assert not triplanes.requires_grad, name
        compare(model.encode(images[1:2]), triplanes[1:2], atol=1e-5, case=name)
        with torch.autocast("cpu", torch.bfloat16):
            rough = model.encode(images).float()
        assert (rough - triplanes).norm() < 0.1 * triplanes.norm(), name


def test_field_decoder_is_trainable_and_counts_in_field_units(models):
    model = models["triposr"]
    decoder, features = model.field_decoder(), torch.randn(5, 18)
    assert all(p.requires_grad for p in decoder.parameters())
    compare(decoder(features)[1], model.decoder(features)[1] * 0.87)
    assert not any(p.requires_grad for p in model.decoder.parameters())


def test_camera_matters(models):
    for name in ("openlrm-1.0", "openlrm-1.1"):
        model = models[name]
        images = torch.rand(1, 3, SIDES[name], SIDES[name])
        camera = torch.randn(1, 16)
        change = model.encode(images) - model.encode(images, camera)
        assert change.abs().max() > 1e-3, name
        with pytest.raises(LRMError, match=r"\[1, 16\]"):
            model.encode(images, camera[0])
        with pytest.raises(LRMError, match="multiple of"):
            model.encode(torch.rand(1, 3, 50, 50))


def test_wrong_images_are_refused(models):
    for model in models.values():
        with pytest.raises(LRMError, match=r"must be \[N, 3, S, S\]"):
            model.encode(torch.rand(1, 3, 48, 64))
        with pytest.raises(LRMError, match="floating point"):
            model.encode(torch.zeros(1, 3, 48, 48, dtype=torch.uint8))


def test_triposr_takes_no_camera_and_any_size(models):
    model = models["triposr"]
    assert model.encode(torch.rand(1, 3, 50, 50)).shape == (1, 3, 6, 8, 8)
    with pytest.raises(LRMError, match="camera must be None"):
        model.encode(torch.rand(1, 3, 64, 64), torch.zeros(1, 16))


@pytest.mark.parametrize("name", FAMILIES)
def test_each_tensor_is_needed_and_has_one_shape(name):
    settings, state = reduced(name)
    model = build(parse_config(settings))
    assert mismatches(model, state) == []
    for key, tensor in state.items():
        rest = {other: value for other, value in state.items() if other != key}
        assert "lacks" in mismatches(model, rest)[0], key
        problem = mismatches(model, {**state, key: tensor.new_zeros(*tensor.shape, 1)})[0]
        assert problem.startswith(f"{key} is ["), key


MORE = (
    *((name, {"encoder.model.mask_token": torch.zeros(1)}, "unknown") for name in FAMILIES),
    # The same weights twice.
    ("openlrm-1.1", {"transformer.layers.0.cross_attn.q_proj_weight": torch.zeros(32, 32)}, "unkn"),
    # Only the unused pooler is passed over.
    ("triposr", {"image_tokenizer.model.pooler.weight": torch.zeros(2, 2)}, "unknown"),
    ("triposr", {"image_tokenizer.model.pooler.dense.weight": torch.zeros(2, 2)}, ""),
    ("triposr", {"image_tokenizer.model.pooler.dense.bias": torch.zeros(2, 2)}, ""),
)


@pytest.mark.parametrize(("name", "more", "words"), MORE)
def test_no_tensor_is_superfluous_but_the_unused_pooler(name, more, words):
    settings, state = reduced(name)
    found = mismatches(build(parse_config(settings)), {**state, **more})
    assert words in found[0] if words else found == []


LISTINGS = {
    name: name.replace("-1.0", "-obj-1.0") + ".json" if name.endswith("1.0") else f"{name}.json"
    for name in PUBLISHED
}
POOLER = 768 * 768 + 768


def test_full_size_listings_load_strictly_and_are_told_apart():
    """Names and shapes of the published tensors, without their values."""
    small, base = "openlrm-small-1.1", "openlrm-base-1.1"
    others = {name: build(parse_config(published_config(name))) for name in (small, base)}
    for name, file in LISTINGS.items():
        listing = json.loads((FOLDER / "fullsize_shapes" / file).read_text())
        model = build(parse_config(listing["config"]))
        state = {key: torch.empty(shape, device="meta") for key, shape in listing["shapes"].items()}
        assert len(state) == listing["num_tensors"], name
        fill(model, state)
        unused = POOLER if name == "triposr" else 0
        count = sum(parameter.numel() for parameter in model.parameters())
        assert count == listing["num_parameters"] - unused, name
        assert model.config == parse_config(published_config(name)), name
        with pytest.raises(LRMError) as caught:
            fill(others[small if name == base else base], state)
        assert str(caught.value).endswith(f"It fits {name} ({PUBLISHED[name].choice})")


def test_configuration_inside_the_file_wins_for_a_published_name(tmp_path):
    sizes = published_config("openlrm-small-1.0")
    carried = {"model": {**sizes, "camera_embed_dim": 16}, "infer": {"source_size": 384}}
    shapes = published_shapes(parse_config(carried))
    state = {name: torch.zeros(1).expand(shape) for name, shape in shapes.items()}
    path = tmp_path / "model.pth"
    torch.save({"weights": state, "kwargs": carried}, path)
    model = load({"architecture": "openlrm-small-1.0"}, path)
    assert (model.config.camera_width, model.image_size) == (16, 384)
    with pytest.raises(LRMError, match=r"does not fit openlrm-base-1\.0"):
        load({"architecture": "openlrm-base-1.0"}, path)


CONTENTS = (
    *(
        (content, "no named weights")
        for content in ({"step": 3}, [1, 2], {}, {"weights": {"a": 1}})
    ),
    ({"weights": Evil()}, "never run"),
    (pickle.dumps(Evil(), protocol=2), "never run"),
    (b"\x80\x02" + bytes(range(256)), r"model\.ckpt"),
)


@pytest.mark.parametrize(("content", "words"), CONTENTS, ids=lambda given: repr(given)[:30])
def test_files_without_weights_are_refused_and_no_code_of_theirs_is_run(
    tmp_path, capsys, content, words
):
    path = tmp_path / "model.ckpt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(LRMError, match=words):
        load(CONFIGS["triposr"], path)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("file", ["model.safetensors", "model.ckpt"])
def test_damaged_files_are_named(tmp_path, file):
    settings, state = reduced("triposr")
    path = save(tmp_path / file, state)
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], whole[:10], b"", b"<html>not found", bytes(64)):
        path.write_bytes(content)
        with pytest.raises(LRMError, match=file):
            load(settings, path)
    path.unlink()
    with pytest.raises(LRMError, match="is not a file"):
        load(settings, path)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_weights_that_are_not_finite_are_named(tmp_path, value):
    settings, state = reduced("triposr")
    name = next(key for key, tensor in state.items() if tensor.ndim == 2)
    state = {key: tensor.clone() for key, tensor in state.items()}
    state[name][0, 0] = value
    path = save(tmp_path / "model.safetensors", state)
    with pytest.raises(LRMError, match=rf"model\.safetensors holds NaN or infinity.*{name}"):
        load(settings, path)


def test_sizes_that_make_no_model_are_refused(tmp_path):
    settings, state = reduced("triposr")
    odd = {"tokenizer": "num_channels", "backbone": "in_channels", "post_processor": "in_channels"}
    settings = settings | {part: settings[part] | {key: 33} for part, key in odd.items()}
    path = save(tmp_path / "model.safetensors", state)
    with pytest.raises(LRMError, match="configuration cannot be used"):
        load(settings, path)
