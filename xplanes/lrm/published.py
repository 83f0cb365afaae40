"""The configurations of the published models."""

from dataclasses import dataclass
from typing import Any

from xplanes.lrm.errors import LRMError


@dataclass(frozen=True)
class Published:
    """A published model.

    Attributes:
        config: Its own configuration, as its authors publish it.
        choice: The setting that selects it.
    """

    config: dict[str, Any]
    choice: str


def _openlrm(width: int, layers: int, channels: int, **other: Any) -> dict[str, Any]:
    return {
        "camera_embed_dim": 1024,
        "rendering_samples_per_ray": 128 if channels == 80 else 96,
        "transformer_dim": width,
        "transformer_layers": layers,
        "transformer_heads": width // 64,
        "triplane_low_res": 32,
        "triplane_high_res": 64,
        "triplane_dim": channels,
        **other,
    }


def _openlrm_1_1(letter: str, encoder_width: int, *sizes: int) -> dict[str, Any]:
    return _openlrm(
        *sizes,
        encoder_type="dinov2",
        encoder_model_name=f"dinov2_vit{letter}14_reg",
        encoder_feat_dim=encoder_width,
        encoder_freeze=False,
    )


def _openlrm_1_0(*sizes: int) -> dict[str, Any]:
    return _openlrm(
        *sizes, encoder_model_name="facebook/dino-vitb16", encoder_feat_dim=768, encoder_freeze=True
    )


_TRIPOSR = {
    "cond_image_size": 512,
    "image_tokenizer": {"pretrained_model_name_or_path": "facebook/dino-vitb16"},
    "tokenizer": {"plane_size": 32, "num_channels": 1024},
    "backbone": {
        "in_channels": 1024,
        "num_attention_heads": 16,
        "attention_head_dim": 64,
        "num_layers": 16,
        "cross_attention_dim": 768,
    },
    "post_processor": {"in_channels": 1024, "out_channels": 40},
    "decoder": {
        "in_channels": 120,
        "n_neurons": 64,
        "n_hidden_layers": 9,
        "activation": "silu",
    },
    "renderer": {
        "radius": 0.87,
        "feature_reduction": "concat",
        "density_activation": "exp",
        "density_bias": -1.0,
        "num_samples_per_ray": 128,
    },
}


def _old(size: str, choice: str) -> str:
    return f"lrm={choice} lrm.architecture=openlrm-{size}-1.0 lrm.file=model.pth"


PUBLISHED: dict[str, Published] = {
    "openlrm-small-1.1": Published(_openlrm_1_1("s", 384, 512, 12, 32), "lrm=small"),
    "openlrm-base-1.1": Published(_openlrm_1_1("b", 768, 768, 12, 48), "lrm=base"),
    "openlrm-large-1.1": Published(_openlrm_1_1("b", 768, 1024, 16, 80), "lrm=xlarge"),
    # Version 1.0 carries its own configuration in model.pth, which wins; camera_embed_dim and
    # transformer_heads are assumed here.
    "openlrm-small-1.0": Published(_openlrm_1_0(768, 12, 32), _old("small", "small")),
    "openlrm-base-1.0": Published(_openlrm_1_0(1024, 12, 40), _old("base", "base")),
    "openlrm-large-1.0": Published(_openlrm_1_0(1024, 16, 80), _old("large", "xlarge")),
    "triposr": Published(_TRIPOSR, "lrm=large"),
}
"""Published models by name."""


def published_config(name: str) -> dict[str, Any]:
    """The configuration of a published model.

    Raises:
        LRMError: If there is none of that name.
    """
    if name not in PUBLISHED:
        raise LRMError(f"architecture={name!r}: must be one of {', '.join(PUBLISHED)}")
    return PUBLISHED[name].config
