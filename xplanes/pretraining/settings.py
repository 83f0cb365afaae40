"""Every setting of `xplanes pretrain-lrm`, typed. The values live in conf/."""

import math
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from omegaconf import MISSING

from xplanes.config import ConfigError, build


@dataclass
class SizeConfig:
    """Sizes of a small OpenLRM 1.1, and the camera that it believes in."""

    name: str = MISSING  # Name of the model, and of its files.
    image_size: int = MISSING  # Pixels along each side of the input.
    patch: int = MISSING  # Pixels along each side of a patch.
    encoder_depth: int = MISSING  # Blocks of the image encoder.
    registers: int = MISSING  # Register tokens of the image encoder.
    width: int = MISSING  # Channels of all tokens.
    heads: int = MISSING  # Attention heads.
    layers: int = MISSING  # Blocks of the triplane transformer.
    low_resolution: int = MISSING  # Tokens along each side of a plane; it has twice the texels.
    channels: int = MISSING  # Channels of each plane.
    camera_width: int = MISSING  # Channels of the camera embedding.
    distance: float = MISSING  # From the camera to the centre of the box [-1, 1]^3.
    density_scale: float = MISSING  # Factor on the density: one over the length of a step.


@dataclass
class PoolConfig:
    """Objects drawn once and kept on disk."""

    root: str = MISSING  # Folder of the pool.
    objects: int = MISSING  # Objects to learn from, a multiple of 256.
    views: int = MISSING  # Pictures of each.


@dataclass
class BatchConfig:
    """What a step looks at."""

    objects: int = MISSING  # Objects of a step, one input picture each.
    near: int = MISSING  # Points near the surface, per object.
    volume: int = MISSING  # Points around the object.
    free: int = MISSING  # Points in front of what a view sees.
    colour: int = MISSING  # Points at the surface, asked for their colour.
    rays: int = MISSING  # Rays rendered once rendering has begun.
    samples: int = MISSING  # Samples of a ray.


@dataclass
class ScheduleConfig:
    """Budget, optimisers and weights of the losses."""

    max_steps: int = MISSING  # Steps at most.
    max_seconds: float | None = MISSING  # Training clock at most; null for no limit.
    muon_lr: float = MISSING  # Peak learning rate of the blocks' matrices (Muon).
    adam_lr: float = MISSING  # Peak learning rate of all else (AdamW).
    weight_decay: float = MISSING  # Of both.
    warmup_steps: int = MISSING  # Steps until the peak.
    decay_share: float = MISSING  # Share of the budget in which the rates fall to zero.
    clip: float = MISSING  # Norm that gradients are scaled down to.
    average: float = MISSING  # Decay of the moving average of weights that is shipped.
    colour_weight: float = MISSING  # Of the colour at the surface.
    render_weight: float = MISSING  # Of rendered rays, colour and opacity.
    render_from: float = MISSING  # Share of the budget from which rays are rendered.
    checkpoint_seconds: float = MISSING  # Between checkpoints.
    score_seconds: float = MISSING  # Between looks at held-out objects.
    score_objects: int = MISSING  # Held-out objects looked at.
    log_every: int = MISSING  # Steps between lines and TensorBoard scalars.


@dataclass
class PretrainConfig:
    """The whole configuration of a pretraining."""

    seed: int = MISSING  # Source of all randomness.
    start: str | None = MISSING  # Weights with coarser planes to go on from; null: none.
    run: str = MISSING  # Folder of checkpoints and logs; an earlier run in it goes on.
    model: SizeConfig = field(default_factory=SizeConfig)
    pool: PoolConfig = field(default_factory=PoolConfig)
    batch: BatchConfig = field(default_factory=BatchConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)


_MAY_BE_ZERO = """seed batch.rays batch.near batch.volume batch.free batch.colour
schedule.weight_decay schedule.warmup_steps schedule.colour_weight schedule.render_weight
schedule.render_from schedule.decay_share schedule.average""".split()
_SHARES = ("schedule.render_from", "schedule.decay_share", "schedule.average")


def parse_pretraining(plain: dict[str, Any]) -> PretrainConfig:
    """A plain configuration as typed settings.

    Raises:
        ConfigError: If settings are out of range or contradict one another.
    """
    config: PretrainConfig = build(PretrainConfig, plain)
    for key, value in _leaves(config):
        if isinstance(value, str) or value is None:
            continue
        if not math.isfinite(value) or value < 0 or (value == 0 and key not in _MAY_BE_ZERO):
            least = "not be negative" if key in _MAY_BE_ZERO else "be above 0"
            raise ConfigError(f"{key}={value}: must {least}")
        if key in _SHARES and value > 1:
            raise ConfigError(f"{key}={value}: must lie between 0 and 1")
    model = config.model
    if model.image_size % model.patch:
        raise ConfigError(
            f"model.image_size={model.image_size}: must be a multiple of model.patch={model.patch}"
        )
    if model.width % model.heads:
        raise ConfigError(f"model.width={model.width}: must be a multiple of model.heads")
    if config.batch.rays and config.batch.samples < 4:
        raise ConfigError(f"batch.samples={config.batch.samples}: a ray needs at least 4")
    return config


def published_sizes(model: SizeConfig, focal: float) -> dict[str, Any]:
    """The config.json of a model: OpenLRM 1.1's keys, and those of its own camera and sizes."""
    return {
        "architecture": "openlrm-1.1",
        "camera_embed_dim": model.camera_width,
        "rendering_samples_per_ray": 96,
        "transformer_dim": model.width,
        "transformer_layers": model.layers,
        "transformer_heads": model.heads,
        "triplane_low_res": model.low_resolution,
        "triplane_high_res": 2 * model.low_resolution,
        "triplane_dim": model.channels,
        "encoder_type": "dinov2",
        "encoder_model_name": "dinov2_vits14_reg",
        "encoder_feat_dim": model.width,
        "encoder_freeze": False,
        "encoder_sizes": {
            "img_size": model.image_size,
            "patch_size": model.patch,
            "embed_dim": model.width,
            "depth": model.encoder_depth,
            "num_heads": model.heads,
            "num_register_tokens": model.registers,
        },
        "source_distance": model.distance,
        "source_focal": focal,
        "density_scale": model.density_scale,
    }


def _leaves(node: Any, prefix: str = "") -> list[tuple[str, Any]]:
    found = []
    for entry in fields(node):
        value, key = getattr(node, entry.name), f"{prefix}{entry.name}"
        found += _leaves(value, f"{key}.") if is_dataclass(value) else [(key, value)]
    return found
