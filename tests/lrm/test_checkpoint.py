"""Published files load strictly, and what does not match is refused with a message."""

import json
import pickle
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import torch
from safetensors.torch import save_file

from tests.lrm.reduced import CONFIGS, SIDES, published_shapes, random_state, reduced
from tests.lrm.reference import FOLDER, VERSIONS, compare, config
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


FILES = ["model.safetensors", "pytorch_model.bin", "model.ckpt"]


@pytest.fixture(scope="module")
def models():
    """A reduced model of each family, loaded from a file."""
    with TemporaryDirectory() as folder:
        return {
            name: load(settings, save(Path(folder) / f"{name}.safetensors", state))
            for name, (settings, state) in ((name, reduced(name)) for name in FAMILIES)
        }


def test_every_published_form_of_file_loads(tmp_path):
    for name, file in product(FAMILIES, FILES):
        case = f"{name} from {file}"
        settings, state = reduced(name)
        model = load(settings, save(tmp_path / file, state))
        assert isinstance(model, LRM), case
        assert model.config.architecture == name, case
        assert not model.training, case
        assert not any(p.is_meta or p.requires_grad for p in model.parameters()), case
        parameters = sum(p.numel() for p in model.parameters())
        assert parameters == sum(t.numel() for t in state.values()), case


def test_encode_and_decode(models):
    for name, model in models.items():
        images = torch.rand(3, 3, SIDES[name], SIDES[name])
        triplanes = model.encode(images)
        assert triplanes.shape == (3, 3, 6, 8, 8), name
        assert triplanes.isfinite().all(), name
        assert not triplanes.requires_grad, name
        compare(model.encode(images[1:2]), triplanes[1:2], atol=1e-5, case=name)
        rgb, density = model.decoder(torch.randn(10, 18))
        assert rgb.shape == (10, 3), name
        assert density.shape == (10,), name
        assert (density > 0).all(), name
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


def test_each_tensor_is_needed_and_none_is_superfluous():
    for name in FAMILIES:
        settings, state = reduced(name)
        model = build(parse_config(settings))
        assert mismatches(model, state) == [], name
        for key in state:
            rest = {other: tensor for other, tensor in state.items() if other != key}
            assert "lacks" in mismatches(model, rest)[0], f"{name}: {key}"
        strange = {**state, "encoder.model.mask_token": torch.zeros(1)}
        assert "unknown" in mismatches(model, strange)[0], name
        for key, tensor in state.items():
            problem = mismatches(model, {**state, key: tensor.new_zeros(*tensor.shape, 1)})[0]
            assert problem.startswith(f"{key} is ["), name


def test_the_same_weights_twice_are_refused():
    settings, state = reduced("openlrm-1.1")
    twice = {**state, "transformer.layers.0.cross_attn.q_proj_weight": torch.zeros(32, 32)}
    assert "unknown" in mismatches(build(parse_config(settings)), twice)[0]


def test_only_the_unused_pooler_is_passed_over():
    settings, state = reduced("triposr")
    pooler = {
        f"image_tokenizer.model.pooler.dense.{p}": torch.zeros(2, 2) for p in ("weight", "bias")
    }
    assert mismatches(build(parse_config(settings)), {**state, **pooler}) == []
    other = {"image_tokenizer.model.pooler.weight": torch.zeros(2, 2)}
    assert "unknown" in mismatches(build(parse_config(settings)), {**state, **other})[0]


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


def test_pickled_and_safetensors_weights_load_alike(tmp_path):
    for folder, file in ((VERSIONS["1.0"], "model.pth"), ("triposr_tiny", "model.ckpt")):
        first = load(config(folder), FOLDER / folder / file)
        content = torch.load(FOLDER / folder / file, weights_only=True)
        state = content.get("weights", content)
        copy = save(tmp_path / "model.safetensors", {k: v.contiguous() for k, v in state.items()})
        second = load(config(folder), copy)
        for (name, one), (_, other) in zip(
            first.state_dict().items(), second.state_dict().items(), strict=True
        ):
            assert torch.equal(one, other), f"{folder}: {name}"


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


def test_half_precision_files_become_float32(tmp_path):
    settings, state = reduced("openlrm-1.1")
    half = {name: tensor.half() for name, tensor in state.items()}
    model = load(settings, save(tmp_path / "model.safetensors", half))
    assert {p.dtype for p in model.parameters()} == {torch.float32}


class Intruder:
    def __reduce__(self):
        return print, ("code was run",)


def test_pickled_code_is_never_run(tmp_path, capsys):
    path = tmp_path / "model.ckpt"
    torch.save({"weights": Intruder()}, path)
    with pytest.raises(LRMError, match="never run"):
        load(CONFIGS["triposr"], path)
    path.write_bytes(pickle.dumps(Intruder(), protocol=2))
    with pytest.raises(LRMError, match="never run"):
        load(CONFIGS["triposr"], path)
    assert capsys.readouterr().out == ""


def test_damaged_files_are_named(tmp_path):
    settings, state = reduced("triposr")
    for file in ("model.safetensors", "model.ckpt"):
        path = save(tmp_path / file, state)
        whole = path.read_bytes()
        for content in (whole[: len(whole) // 2], whole[:10], b"", b"<html>not found</html>"):
            path.write_bytes(content)
            with pytest.raises(LRMError, match=file):
                load(settings, path)
        for content in (b"error", b"\x80\x02" + bytes(range(256)), bytes(64)):
            path.write_bytes(content)
            with pytest.raises(LRMError, match=file):
                load(settings, path)
        path.unlink()
        with pytest.raises(LRMError, match="is not a file"):
            load(settings, path)


def test_files_without_weights_are_refused(tmp_path):
    for content in ({"step": 3}, [1, 2], {}, {"weights": {"a": 1}}):
        path = tmp_path / "model.ckpt"
        torch.save(content, path)
        with pytest.raises(LRMError, match="no named weights"):
            load(CONFIGS["triposr"], path)


def test_a_model_that_fits_nothing_published_says_so(tmp_path):
    settings = CONFIGS["openlrm-1.1"]
    path = save(tmp_path / "model.safetensors", random_state(parse_config(settings)))
    with pytest.raises(LRMError, match="fits no published model"):
        load({"architecture": "openlrm-small-1.1"}, path)


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
    width = {"tokenizer": settings["tokenizer"] | {"num_channels": 33}}
    inner = {"backbone": settings["backbone"] | {"in_channels": 33}}
    last = {"post_processor": settings["post_processor"] | {"in_channels": 33}}
    path = save(tmp_path / "model.safetensors", state)
    with pytest.raises(LRMError, match="configuration cannot be used"):
        load(settings | width | inner | last, path)
