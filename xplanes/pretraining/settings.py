"""Every setting of `xplanes pretrain-lrm`, typed. The values live in conf/."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from xplanes.errors import ConfigError
from xplanes.settings import Count, Positive, Settings, Share, Steps, Weight


@dataclass(frozen=True, kw_only=True)
class SizeSettings(Settings):
    """Sizes of a small OpenLRM 1.1, and the camera that it believes in."""

    name: str  # Name of the model, and of its files.
    image_size: Count  # Pixels along each side of the input.
    patch: Count  # Pixels along each side of a patch.
    encoder_depth: Count  # Blocks of the image encoder.
    registers: Count  # Register tokens of the image encoder.
    width: Count  # Channels of all tokens.
    heads: Count  # Attention heads.
    layers: Count  # Blocks of the triplane transformer.
    low_resolution: Count  # Tokens along each side of a plane; it has twice the texels.
    channels: Count  # Channels of each plane.
    camera_width: Count  # Channels of the camera embedding.
    distance: Positive  # From the camera to the centre of the box [-1, 1]^3.
    density_scale: Positive  # Factor on the density: one over the length of a step.

    def check(self) -> None:
        if self.image_size % self.patch:
            raise ConfigError(
                f"image_size={self.image_size}: must be a multiple of model.patch={self.patch}"
            )
        if self.width % self.heads:
            raise ConfigError(f"width={self.width}: must be a multiple of model.heads={self.heads}")


@dataclass(frozen=True, kw_only=True)
class PoolSettings(Settings):
    """Objects drawn once and kept on disk."""

    root: str  # Folder of the pool.
    objects: Count  # Objects to learn from, a multiple of 256.
    views: Count  # Pictures of each.


@dataclass(frozen=True, kw_only=True)
class BatchSettings(Settings):
    """What a step looks at."""

    objects: Count  # Objects of a step, one input picture each.
    near: Steps  # Points near the surface, per object.
    volume: Steps  # Points around the object.
    free: Steps  # Points in front of what a view sees.
    colour: Steps  # Points at the surface, asked for their colour.
    rays: Steps  # Rays rendered once rendering has begun.
    samples: Count  # Samples of a ray.

    def check(self) -> None:
        if self.rays and self.samples < 4:
            raise ConfigError(f"samples={self.samples}: a ray needs at least 4")


@dataclass(frozen=True, kw_only=True)
class ScheduleSettings(Settings):
    """Budget, optimisers and weights of the losses."""

    max_steps: Count  # Steps at most.
    max_seconds: Positive | None  # Training clock at most; null for no limit.
    muon_lr: Positive  # Peak learning rate of the blocks' matrices (Muon).
    adam_lr: Positive  # Peak learning rate of all else (AdamW).
    weight_decay: Weight  # Of both.
    warmup_steps: Steps  # Steps until the peak.
    decay_share: Share  # Share of the budget in which the rates fall to zero.
    clip: Positive  # Norm that gradients are scaled down to.
    average: Share  # Decay of the moving average of weights that is shipped.
    colour_weight: Weight  # Of the colour at the surface.
    render_weight: Weight  # Of rendered rays, colour and opacity.
    render_from: Share  # Share of the budget from which rays are rendered.
    checkpoint_seconds: Positive  # Between checkpoints.
    score_seconds: Positive  # Between looks at held-out objects.
    score_objects: Count  # Held-out objects looked at.
    log_every: Count  # Steps between lines and TensorBoard scalars.


@dataclass(frozen=True, kw_only=True)
class PretrainingSettings(Settings):
    """The whole configuration of a pretraining."""

    seed: Steps  # Source of all randomness.
    init_from: str | None  # Weights of a model with coarser planes; null: random initialisation.
    run: str  # Folder of checkpoints and logs; an earlier run in it goes on.
    model: SizeSettings
    pool: PoolSettings
    batch: BatchSettings
    schedule: ScheduleSettings


def parse_pretraining(plain: Mapping[str, Any]) -> PretrainingSettings:
    """A plain configuration as typed settings.

    Raises:
        ConfigError: If settings are out of range or contradict one another.
    """
    PretrainingSettings.require_names(plain)
    return PretrainingSettings(**plain)


def published_sizes(model: SizeSettings, focal: float) -> dict[str, Any]:
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
