"""Published configurations, and errors for invalid ones."""

import pytest
from torch import nn

from tests.lrm.reduced import CONFIGS
from tests.refusals import assert_refused
from xplanes.lrm import LRMError
from xplanes.lrm.checkpoint import build
from xplanes.lrm.config import PUBLISHED, parse_config, published_config


def test_family_is_guessed_or_named():
    for name, settings in CONFIGS.items():
        assert parse_config(settings).architecture == name
        named = {**settings, "architecture": name.replace("-", "_")}
        assert parse_config(named).architecture == name


def test_published_sizes():
    for name, size, heads in (
        ("openlrm-small-1.1", 224, 8),
        ("openlrm-base-1.1", 336, 12),
        ("openlrm-large-1.1", 448, 16),
        ("openlrm-small-1.0", 224, 12),
        ("triposr", 512, 16),
    ):
        config = parse_config(published_config(name))
        assert (config.image_size, config.heads, config.head_width) == (size, heads, 64), name
        assert config.low_resolution == 32, name
        assert config.encoder.width // config.encoder.heads == 64, name


def test_references_are_followed():
    assert parse_config(CONFIGS["triposr"]).width == 64
    for value, message in (
        ("${tokenizer.absent}", "does not exist"),
        ("${backbone.in_channels}", "circular"),
        ("${oc.env:HOME}", "in_channels"),
    ):
        backbone = {**CONFIGS["triposr"]["backbone"], "in_channels": value}
        with pytest.raises(LRMError, match=message):
            parse_config({**CONFIGS["triposr"], "backbone": backbone})


def test_what_the_file_does_not_say_can_be_given():
    more = {"image_size": 96, "image_mean": [0.5] * 3, "image_std": [0.5] * 3}
    config = parse_config({**CONFIGS["openlrm-1.0"], **more})
    assert config.image_size == 96
    assert config.encoder.mean == config.encoder.std == (0.5, 0.5, 0.5)


def test_keys_beside_or_in_the_section_of_the_model_count_alike():
    more = {"source_focal": 1.25, "density_scale": 3.0, "image_size": 140}
    for top, inner in ((more, {}), ({}, more)):
        config = parse_config({"model": {**CONFIGS["openlrm-1.1"], **inner}, **top})
        assert (config.source_focal, config.density_scale, config.image_size) == (1.25, 3.0, 140)


UNUSABLE = [
    ("openlrm-1.1", {"transformer_dim": None}, "transformer_dim=None"),
    ("openlrm-1.1", {"transformer_heads": 3}, "transformer_heads=3"),
    ("openlrm-1.1", {"triplane_high_res": 9}, "twice"),
    ("openlrm-1.1", {"encoder_feat_dim": 768}, "encoder_feat_dim=768"),
    ("openlrm-1.1", {"encoder_model_name": "dinov2_vitg14"}, "dinov2_vitg14"),
    ("openlrm-1.1", {"encoder_type": "dino"}, "encoder_type='dino'"),
    ("openlrm-1.0", {"encoder_model_name": "vit"}, "'vit'"),
    ("openlrm-1.0", {"image_mean": [1, 2]}, "image_mean"),
    ("openlrm-1.0", {"image_mean": ["a", 1, 2]}, "configuration cannot be used"),
    ("openlrm-1.1", {"encoder_sizes": [1]}, "configuration cannot be used"),
    ("openlrm-1.1", {"encoder_sizes": "small"}, "configuration cannot be used"),
    ("triposr", {"renderer": {"density_activation": "softplus"}}, "softplus"),
    ("triposr", {"renderer": {"radius": 1.0}}, "radius=1.0"),
    ("triposr", {"decoder": {"in_channels": 120, "activation": "silu"}}, "in_channels=120"),
    ("triposr", {"tokenizer": None}, "section tokenizer"),
    ("triposr", {"cond_image_size": True}, "cond_image_size=True"),
    ("triposr", {"architecture": "triplane"}, "triplane"),
]


def test_unusable_configurations_are_refused():
    for name, change, message in UNUSABLE:
        settings = {**CONFIGS[name], **change}
        assert_refused(LRMError, message, lambda settings=settings: parse_config(settings), change)


def test_configurations_and_names_of_no_known_model_are_refused():
    with pytest.raises(LRMError, match=r"config\.json"):
        parse_config({"downloads": 12})
    with pytest.raises(LRMError, match="must be one of"):
        published_config("openlrm-huge-1.1")
    assert len({published.choice for published in PUBLISHED.values()}) == len(PUBLISHED)


EPSILONS = {"openlrm-1.0": {1e-12, 1e-6}, "openlrm-1.1": {1e-6}, "triposr": {1e-12, 1e-5}}


def test_norm_epsilons():
    """Too small to show in the outputs of models with random weights."""
    for name, settings in CONFIGS.items():
        model = build(parse_config(settings))
        norms = [m for m in model.modules() if isinstance(m, nn.LayerNorm)]
        assert {norm.eps for norm in norms} == EPSILONS[name], name
        encoder = {m.eps for m in model.encoder.modules() if isinstance(m, nn.LayerNorm)}
        assert encoder == {1e-6 if name == "openlrm-1.1" else 1e-12}, name
        groups = [(m.num_groups, m.eps) for m in model.modules() if isinstance(m, nn.GroupNorm)]
        assert groups == ([(32, 1e-6)] if name == "triposr" else []), name
