"""Initialisation of a model: random, or from a model with coarser planes."""

from functools import partial

import pytest
import torch

from tests.refusals import assert_refused
from tests.synthetic.pretraining.small import same, small_config, small_plain, small_sizes
from xplanes.components import read_settings
from xplanes.errors import ConfigError
from xplanes.lrm import LRMError, load
from xplanes.lrm.canonical import canonical_vector
from xplanes.lrm.config import parse_config
from xplanes.lrm.weights import bundled_models, load_bundled
from xplanes.synthetic.pretraining.initialisation import grow_model, init_model
from xplanes.synthetic.pretraining.pool import FOCAL
from xplanes.synthetic.pretraining.run import export, published_state
from xplanes.synthetic.pretraining.settings import PretrainingSettings, published_sizes

SIZES = published_sizes(small_config().model, FOCAL)


def test_models_are_deterministic_given_the_seed():
    first, again, other = (init_model(small_sizes(), seed).state_dict() for seed in (0, 0, 1))
    assert same(first, again)
    assert not same(first, other)


def test_planes_attend_to_their_line_of_sight_in_the_image():
    config = small_sizes("model.image_size=96", "model.width=128", "model.low_resolution=12")
    model = init_model(config, 0)
    with torch.no_grad():
        image = model.encoder(torch.ones(1, 3, 96, 96))
        camera = model.camera(canonical_vector(model.view)[None])
        block = model.blocks[0]
        query = block.image_attention.query(block.norm1(model.position, camera))
        key = block.image_attention.key(image)
        query, key = (part.unflatten(-1, (2, -1))[0, :, 0] for part in (query, key))
        weights = (query @ key.T / 8).softmax(dim=-1)
    side = 12
    xz = weights[side * side : 2 * side * side]
    reach = 0.5 * config.source_distance / config.source_focal
    for row, column in ((2, 3), (6, 6), (10, 1), (5, 9)):
        best = int(xz[row * side + column].argmax()) - 1
        x, z = (2 * (column + 0.5) / side - 1), (2 * (row + 0.5) / side - 1)
        seen_x = reach * (2 * (best % 12 + 0.5) / 12 - 1)
        seen_z = -reach * (2 * (best // 12 + 0.5) / 12 - 1)
        assert abs(seen_x - x) < 0.15
        assert abs(seen_z - z) < 0.15
    # A token of the plane xy looks along the whole column of the picture.
    columns = weights[4 * side + 3, 1:].unflatten(0, (12, 12)).sum(dim=0)
    assert abs(int(columns.argmax()) - 3) <= 1


def test_finer_planes_are_initialised_from_coarser_ones():
    torch.manual_seed(0)
    earlier = init_model(small_sizes(), 0)
    finer = small_sizes("model.low_resolution=8")
    grown, before = grow_model(earlier, finer).state_dict(), earlier.state_dict()
    position = grown.pop("position")
    before.pop("position")
    assert same(grown, before)
    torch.testing.assert_close(position, init_model(finer, 0).position.data)
    with torch.no_grad():
        earlier.position += 0.3
    torch.testing.assert_close(grow_model(earlier, finer).position.data, position + 0.3)


def test_exported_weights_are_loaded_unchanged(tmp_path):
    model = init_model(small_sizes(), 2)
    path = export(model, SIZES, tmp_path, "small")
    loaded, found = load_bundled("small", tmp_path)
    assert bundled_models(tmp_path) == ["small"]
    assert found == path
    assert loaded.view.distance == SIZES["source_distance"]
    assert loaded.view.focal == pytest.approx(1.38889, abs=1e-5)
    assert loaded.decoder.density_scale == SIZES["density_scale"]
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor.half().float())
    state = published_state(model)
    assert set(state) == set(published_state(loaded))  # type: ignore[arg-type]
    # Queries and keys are equally wide.
    assert "transformer.layers.0.cross_attn.in_proj_weight" in state
    assert not [name for name in state if "q_proj" in name]
    assert loaded.encode(torch.rand(2, 3, 24, 24)).shape == (2, 3, 8, 8, 8)
    assert load(SIZES, path).config == loaded.config


def test_the_camera_and_scale_have_the_published_defaults():
    for key, default in (("source_distance", 2.0), ("source_focal", 0.75), ("density_scale", 1.0)):
        plain = {k: v for k, v in SIZES.items() if k != key}
        assert getattr(parse_config(plain), key) == default, key
        for wrong in (0, -1.0, float("inf"), "far"):
            call = partial(parse_config, {**SIZES, key: wrong})
            assert_refused(LRMError, key, call, f"{key}={wrong}")


def test_settings_that_cannot_work_are_refused_by_name():
    for section, change, message in (
        ("model", {"patch": 7}, r"model\.image_size=24.*model\.patch=7"),
        ("model", {"heads": 5}, r"model\.width=48"),
        ("model", {"heads": 24}, r"model\.width=48: must be at least 288"),
        ("pool", {"views": 1}, r"pool\.views=1"),
        ("batch", {"objects": 0}, r"batch\.objects=0"),
        ("batch", {"objects": 10**6}, r"batch\.objects=1000000.*pool\.objects"),
        ("batch", {"colour": 0}, r"batch\.colour=0"),
        ("batch", {"samples": 2}, r"batch\.samples=2"),
        ("batch", {"near": 0, "volume": 0, "free": 0}, r"batch\.near=0"),
        ("schedule", {"max_steps": 0}, r"schedule\.max_steps=0"),
        ("schedule", {"clip": -1.0}, r"schedule\.clip=-1"),
        ("schedule", {"decay_share": 1.5}, r"schedule\.decay_share=1\.5"),
    ):
        plain = small_plain()
        plain[section] |= change
        read = partial(read_settings, PretrainingSettings, plain)
        assert_refused(ConfigError, message, read, change)
