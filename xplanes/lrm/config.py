"""Sizes of a Large Reconstruction Model, read from the configuration published with it."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from xplanes.errors import LRMError
from xplanes.lrm.canonical import OPENLRM_VIEW


class Published(NamedTuple):
    """A published model.

    Attributes:
        config: Its configuration, as published by its authors.
        choice: The setting that selects it.
    """

    config: dict[str, Any]
    choice: str


def _sizes(width: int, layers: int, channels: int, encoder: dict[str, Any]) -> dict[str, Any]:
    return {
        "camera_embed_dim": 1024,
        "rendering_samples_per_ray": 128 if channels == 80 else 96,
        "transformer_dim": width,
        "transformer_layers": layers,
        "transformer_heads": width // 64,
        "triplane_low_res": 32,
        "triplane_high_res": 64,
        "triplane_dim": channels,
        **encoder,
    }


_FREE = {"encoder_type": "dinov2", "encoder_freeze": False}
_DINOV2_S = {**_FREE, "encoder_model_name": "dinov2_vits14_reg", "encoder_feat_dim": 384}
_DINOV2_B = {**_FREE, "encoder_model_name": "dinov2_vitb14_reg", "encoder_feat_dim": 768}
_DINO = {
    "encoder_freeze": True,
    "encoder_model_name": "facebook/dino-vitb16",
    "encoder_feat_dim": 768,
}

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
    "decoder": {"in_channels": 120, "n_neurons": 64, "n_hidden_layers": 9, "activation": "silu"},
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
    "openlrm-small-1.1": Published(_sizes(512, 12, 32, _DINOV2_S), "lrm=small"),
    "openlrm-base-1.1": Published(_sizes(768, 12, 48, _DINOV2_B), "lrm=base"),
    "openlrm-large-1.1": Published(_sizes(1024, 16, 80, _DINOV2_B), "lrm=xlarge"),
    # Version 1.0 has its configuration in model.pth, which takes precedence; camera_embed_dim and
    # transformer_heads are assumed here.
    "openlrm-small-1.0": Published(_sizes(768, 12, 32, _DINO), _old("small", "small")),
    "openlrm-base-1.0": Published(_sizes(1024, 12, 40, _DINO), _old("base", "base")),
    "openlrm-large-1.0": Published(_sizes(1024, 16, 80, _DINO), _old("large", "xlarge")),
    "triposr": Published(_TRIPOSR, "lrm=large"),
}
"""Published models by name."""


def published_config(name: str) -> dict[str, Any]:
    """The configuration of a published model.

    Raises:
        LRMError: If no published model has that name.
    """
    if name not in PUBLISHED:
        raise LRMError(f"architecture={name!r}: must be one of {', '.join(PUBLISHED)}")
    return PUBLISHED[name].config


Architecture = Literal["openlrm-1.0", "openlrm-1.1", "triposr"]

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class EncoderConfig:
    """Sizes of an image encoder.

    Attributes:
        width: Channels of a token.
        depth: Number of blocks.
        heads: Attention heads.
        hidden: Channels inside the feed-forward layers.
        patch: Side of a patch in pixels.
        grid: Patches along each side of the training images (size of the position embedding).
        norm_epsilon: Epsilon of the layer norms.
        registers: Number of register tokens, which are dropped at the end.
        layer_scale: Whether each branch is scaled per channel before it is added.
        antialias_positions: How the position embedding is resized (`interpolate_positions`).
        mean: Mean of the RGB normalisation; None for no normalisation.
        std: Standard deviation of the RGB normalisation.
    """

    width: int
    depth: int
    heads: int
    hidden: int
    patch: int
    grid: int
    norm_epsilon: float
    registers: int = 0
    layer_scale: bool = False
    antialias_positions: bool = False
    mean: tuple[float, ...] | None = None
    std: tuple[float, ...] | None = None


@dataclass(frozen=True)
class LRMConfig:
    """Sizes of a Large Reconstruction Model.

    Attributes:
        architecture: Model family.
        image_size: Side of the input image in pixels.
        encoder: The image encoder.
        width: Channels of the triplane's tokens.
        layers: Transformer blocks.
        heads: Attention heads.
        head_width: Channels of each head.
        channels: Channels C of each plane.
        low_resolution: Tokens along each side of a plane; planes have twice as many texels.
        camera_width: Channels of the camera embedding; 0 if there is none.
        decoder_width: Neurons of the decoder's hidden layers.
        decoder_hidden: Number of these layers.
        source_distance: Distance from the canonical camera to the centre of the box.
        source_focal: That camera's focal length as a share of the image's side.
        density_scale: Factor on the density.
    """

    architecture: Architecture
    image_size: int
    encoder: EncoderConfig
    width: int
    layers: int
    heads: int
    head_width: int
    channels: int
    low_resolution: int
    camera_width: int = 0
    decoder_width: int = 64
    decoder_hidden: int = 3
    source_distance: float = OPENLRM_VIEW.distance
    source_focal: float = OPENLRM_VIEW.focal
    density_scale: float = 1.0


@dataclass(frozen=True)
class Reader:
    """Reads settings from a nested configuration; errors name missing or invalid keys.

    Attributes:
        values: The section read from.
        place: Key path of the section, for messages.
        root: The whole configuration, for resolving references; ``values`` if empty.
    """

    values: Mapping[str, Any]
    place: str = ""
    root: Mapping[str, Any] = field(default_factory=dict)

    def inner(self, key: str) -> "Reader":
        """A subsection."""
        value = self.values.get(key)
        if not isinstance(value, Mapping):
            raise LRMError(f"the model's configuration has no section {self.place}{key}")
        return Reader(value, f"{self.place}{key}.", self.root or self.values)

    def integer(self, key: str, default: int | None = None) -> int:
        """A positive integer."""
        value = self._value(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise self._error(key, value, "must be a whole number above zero")
        return value

    def positive(self, key: str, default: float) -> float:
        """A finite positive number."""
        value = self._value(key, default)
        try:
            number = float(value)  # YAML 1.1 reads 1e-12 as text
        except (TypeError, ValueError):
            raise self._error(key, value, "must be a number") from None
        if not 0 < number < math.inf:
            raise self._error(key, number, "must be above zero")
        return number

    def require(self, key: str, value: Any) -> None:
        """Refuse any value other than the supported one."""
        if (found := self._value(key, value)) != value:
            raise self._error(key, found, f"only {value!r} is supported")

    def triple(self, key: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Three numbers."""
        values = self.values.get(key, default)
        if not isinstance(values, list | tuple) or len(values) != 3:
            raise self._error(key, values, "must be three numbers")
        return tuple(float(value) for value in values)

    def _error(self, key: str, value: Any, wanted: str) -> LRMError:
        return LRMError(f"the model's configuration has {self.place}{key}={value!r}: {wanted}")

    def _value(self, key: str, default: Any) -> Any:
        """A value, with references ``${a.b}``, as in TripoSR's YAML, resolved."""
        value = self.values.get(key, default)
        for _ in range(8):
            match = re.fullmatch(r"\$\{([\w.]+)\}", value) if isinstance(value, str) else None
            if match is None:
                return value
            found: Any = self.root or self.values
            for name in match[1].split("."):
                if not isinstance(found, Mapping) or name not in found:
                    raise LRMError(
                        f"the model's configuration refers to {value}, which does not exist"
                    )
                found = found[name]
            value = found
        raise LRMError(f"the model's configuration has a circular reference: {value}")


def parse_config(config: Mapping[str, Any]) -> LRMConfig:
    """Sizes from a checkpoint's own configuration.

    Args:
        config: The content of the published config.json or config.yaml (OpenLRM 1.1, TripoSR) or
            of ``kwargs`` in model.pth (OpenLRM 1.0). The key ``architecture`` may name the family:
            openlrm-1.0, openlrm-1.1 or triposr. ``image_size``, ``image_mean`` and ``image_std``
            supply values that the published file lacks. OpenLRM models of other sizes or with
            another camera use the keys ``encoder_sizes`` (img_size, patch_size, embed_dim, depth,
            num_heads, num_register_tokens), ``source_distance``, ``source_focal`` and
            ``density_scale``.

    Raises:
        LRMError: If a key is missing, out of range or not supported.
    """
    architecture = guess_architecture(config)
    try:
        if architecture == "triposr":
            return _triposr(Reader(config))
        return _openlrm(config, architecture)
    except (AttributeError, TypeError, ValueError) as problem:
        raise LRMError(f"the model's configuration cannot be used: {problem}") from problem


def guess_architecture(config: Mapping[str, Any]) -> Architecture:
    """The family that a configuration belongs to.

    Raises:
        LRMError: If the family is unknown or cannot be inferred.
    """
    named = str(config.get("architecture", "openlrm")).lower().replace("_", "-")
    for known in ("openlrm-1.0", "openlrm-1.1", "triposr"):
        if named == known:
            return known
    if named != "openlrm":
        raise LRMError(
            f"architecture={config['architecture']!r}: must be openlrm-1.0, openlrm-1.1 or "
            f"triposr, or the name of a published model and nothing else"
        )
    if "cond_image_size" in config or "image_tokenizer" in config:
        return "triposr"
    flat = config.get("model", config)
    if isinstance(flat, Mapping) and "transformer_dim" in flat:
        return "openlrm-1.1" if "encoder_type" in flat else "openlrm-1.0"
    raise LRMError(
        "the model's configuration is neither OpenLRM's (transformer_dim, ...) nor TripoSR's "
        "(image_tokenizer, ...): give the config.json or config.yaml published with the weights"
    )


DINOV2 = {"dinov2_vits14_reg": (384, 6), "dinov2_vitb14_reg": (768, 12)}
"""Width and heads of DINOv2 by name."""

SOURCE_SIZES = {512: 224, 768: 336, 1024: 448}
"""Image size by transformer width; OpenLRM 1.1's config.json does not contain it."""


def _openlrm(config: Mapping[str, Any], architecture: Architecture) -> LRMConfig:
    nested = isinstance(config.get("model"), Mapping)
    model = Reader(config).inner("model") if nested else Reader(config)
    # Keys that published files lack may be given inside or outside the section "model".
    given = Reader({**config, **model.values})
    sizes = Reader(given.values.get("encoder_sizes") or {}, "encoder_sizes.")
    width, low = model.integer("transformer_dim"), model.integer("triplane_low_res")
    if model.integer("triplane_high_res", 2 * low) != 2 * low:
        raise LRMError(
            f"the model's configuration has triplane_high_res="
            f"{model.integer('triplane_high_res')}: must be twice triplane_low_res={low}"
        )
    name = model.values.get("encoder_model_name")
    if architecture == "openlrm-1.1":
        model.require("encoder_type", "dinov2")
        encoder = _dinov2(name, sizes)
        fallback = encoder.grid * encoder.patch if sizes.values else SOURCE_SIZES.get(width, 224)
    else:
        encoder = _dino(name, sizes, given)
        fallback = 224
    model.require("encoder_feat_dim", encoder.width)
    infer = config.get("infer")
    size = infer if isinstance(infer, Mapping) else config
    fallback = Reader(size, "infer.").integer("source_size", fallback)
    heads = model.integer("transformer_heads")
    if width % heads:
        raise LRMError(f"transformer_dim={width} cannot be split into transformer_heads={heads}")
    return LRMConfig(
        architecture=architecture,
        image_size=given.integer("image_size", fallback),
        encoder=encoder,
        width=width,
        layers=model.integer("transformer_layers"),
        heads=heads,
        head_width=width // heads,
        channels=model.integer("triplane_dim"),
        low_resolution=low,
        camera_width=model.integer("camera_embed_dim"),
        source_distance=given.positive("source_distance", OPENLRM_VIEW.distance),
        source_focal=given.positive("source_focal", OPENLRM_VIEW.focal),
        density_scale=given.positive("density_scale", 1.0),
    )


def _triposr(config: Reader) -> LRMConfig:
    tokenizer, backbone = config.inner("tokenizer"), config.inner("backbone")
    upsampler, decoder = config.inner("post_processor"), config.inner("decoder")
    renderer = config.inner("renderer")
    for reader, key, value in (
        (renderer, "radius", 0.87),
        (renderer, "feature_reduction", "concat"),
        (renderer, "density_activation", "exp"),
        (renderer, "density_bias", -1.0),
        (renderer, "color_activation", "sigmoid"),
        (decoder, "activation", "silu"),
    ):
        reader.require(key, value)
    name = config.inner("image_tokenizer").values.get("pretrained_model_name_or_path")
    sizes = Reader(config.values.get("encoder_sizes") or {}, "encoder_sizes.")
    encoder = _dino(name, sizes, config)
    width, channels = tokenizer.integer("num_channels"), upsampler.integer("out_channels")
    backbone.require("in_channels", width)
    backbone.require("cross_attention_dim", encoder.width)
    upsampler.require("in_channels", width)
    decoder.require("in_channels", 3 * channels)
    return LRMConfig(
        architecture="triposr",
        image_size=config.integer("cond_image_size"),
        encoder=encoder,
        width=width,
        layers=backbone.integer("num_layers"),
        heads=backbone.integer("num_attention_heads"),
        head_width=backbone.integer("attention_head_dim"),
        channels=channels,
        low_resolution=tokenizer.integer("plane_size"),
        decoder_width=decoder.integer("n_neurons"),
        decoder_hidden=decoder.integer("n_hidden_layers"),
    )


def _dino(name: Any, sizes: Reader, given: Reader) -> EncoderConfig:
    if name != "facebook/dino-vitb16":
        raise LRMError(f"the image encoder {name!r} is not supported: only facebook/dino-vitb16")
    patch = sizes.integer("patch_size", 16)
    return EncoderConfig(
        width=sizes.integer("hidden_size", 768),
        depth=sizes.integer("num_hidden_layers", 12),
        heads=sizes.integer("num_attention_heads", 12),
        hidden=sizes.integer("intermediate_size", 3072),
        patch=patch,
        grid=sizes.integer("image_size", 224) // patch,
        norm_epsilon=1e-12,
        mean=given.triple("image_mean", IMAGENET_MEAN),
        std=given.triple("image_std", IMAGENET_STD),
    )


def _dinov2(name: Any, sizes: Reader) -> EncoderConfig:
    if name not in DINOV2:
        raise LRMError(
            f"the image encoder {name!r} is not supported: must be one of {', '.join(DINOV2)}"
        )
    width, heads = DINOV2[name]
    width, patch = sizes.integer("embed_dim", width), sizes.integer("patch_size", 14)
    return EncoderConfig(
        width=width,
        depth=sizes.integer("depth", 12),
        heads=sizes.integer("num_heads", heads),
        hidden=4 * width,
        patch=patch,
        grid=sizes.integer("img_size", 518) // patch,
        norm_epsilon=1e-6,
        registers=sizes.integer("num_register_tokens", 4),
        layer_scale=True,
        antialias_positions=True,
    )
