"""Typed settings of `xplanes pretrain-lrm`. Their values are in conf/."""

from dataclasses import dataclass
from typing import Any

from xplanes.errors import ConfigError
from xplanes.settings import Count, Location, Positive, Settings, Share, Steps, Weight

NARROWEST = 12
"""Least channels per head: half of them contain a sine and a cosine for each of three axes."""


@dataclass(frozen=True, kw_only=True)
class SizeSettings(Settings):
    """Sizes of a small OpenLRM 1.1, and its canonical camera."""

    name: str  # Name of the model and its files.
    image_size: Count  # Height and width of the input image in pixels.
    patch: Count  # Side of a patch in pixels.
    encoder_depth: Count  # Blocks of the image encoder.
    registers: Count  # Register tokens of the image encoder.
    width: Count  # Channels of all tokens.
    heads: Count  # Attention heads.
    layers: Count  # Blocks of the triplane transformer.
    low_resolution: Count  # Tokens along each side of a plane; a plane has twice as many texels.
    channels: Count  # Channels of each plane.
    camera_width: Count  # Channels of the camera embedding.
    distance: Positive  # Distance of the camera from the centre of the box [-1, 1]^3.
    density_scale: Positive  # Factor on the density: 1 / (length of a step).

    def check(self) -> None:
        if self.image_size % self.patch:
            raise ConfigError(
                f"image_size={self.image_size}: must be a multiple of model.patch={self.patch}"
            )
        if self.width % self.heads:
            raise ConfigError(f"width={self.width}: must be a multiple of model.heads={self.heads}")
        if self.width // self.heads < NARROWEST:
            raise ConfigError(
                f"width={self.width}: must be at least {NARROWEST * self.heads}, {NARROWEST} for "
                f"each of model.heads={self.heads}, for sines and cosines of positions"
            )


@dataclass(frozen=True, kw_only=True)
class PoolSettings(Settings):
    """Objects that are generated once and stored on disk."""

    root: Location  # Folder of the pool.
    objects: Count  # Training objects, a multiple of 256.
    views: Count  # Images per object, at least 2: scores use views that the model did not see.

    def check(self) -> None:
        if self.views < 2:
            raise ConfigError(f"views={self.views}: must be at least 2, one of them for scores")


@dataclass(frozen=True, kw_only=True)
class BatchSettings(Settings):
    """Objects, points and rays of a training step."""

    objects: Count  # Objects per step, one input image each.
    near: Steps  # Points near the surface, per object.
    volume: Steps  # Points in the volume around the object, per object.
    free: Steps  # Points in the free space in front of the surface, per object.
    colour: Count  # Surface points with colour supervision, per object.
    rays: Steps  # Rays rendered per object, from schedule.render_from on.
    samples: Count  # Samples per ray.

    def check(self) -> None:
        if self.rays and self.samples < 4:
            raise ConfigError(f"samples={self.samples}: a ray needs at least 4")
        if not (self.near or self.volume or self.free):
            raise ConfigError("near=0: near, volume and free are all 0; one must be above")


@dataclass(frozen=True, kw_only=True)
class ScheduleSettings(Settings):
    """Budget, optimisers and loss weights."""

    max_steps: Count  # Maximum number of steps.
    max_seconds: Positive | None  # Maximum training time in seconds; null for no limit.
    muon_lr: Positive  # Peak learning rate of the blocks' matrices (Muon).
    adam_lr: Positive  # Peak learning rate of all other parameters (AdamW).
    weight_decay: Weight  # Weight decay of both optimisers.
    warmup_steps: Steps  # Warm-up steps of the learning rates.
    decay_share: Share  # Share of the budget over which the learning rates decay to zero.
    clip: Positive  # Maximum norm of the gradient.
    average: Share  # Decay of the exponential moving average of the exported weights.
    colour_weight: Weight  # Weight of the colour loss at surface points.
    render_weight: Weight  # Weight of the loss on rendered rays (colour and opacity).
    render_from: Share  # Share of the budget from which rays are rendered.
    checkpoint_seconds: Positive  # Seconds between checkpoints.
    score_seconds: Positive  # Seconds between scores on held-out objects.
    score_objects: Count  # Held-out objects that are scored.
    log_every: Count  # Steps between log lines and TensorBoard scalars.


@dataclass(frozen=True, kw_only=True)
class PretrainingSettings(Settings):
    """The whole configuration of a pretraining."""

    seed: Steps  # Seed of all random numbers.
    # Weights of a model with coarser planes; null: random initialisation.
    init_from: Location | None
    run: Location  # Folder of checkpoints and logs; an existing run is resumed.
    model: SizeSettings
    pool: PoolSettings
    batch: BatchSettings
    schedule: ScheduleSettings

    def check(self) -> None:
        if self.batch.objects > self.pool.objects:
            raise ConfigError(
                f"batch.objects={self.batch.objects}: must not be above pool.objects="
                f"{self.pool.objects}"
            )


def published_sizes(model: SizeSettings, focal: float) -> dict[str, Any]:
    """The config.json of a model: OpenLRM 1.1's keys, plus the keys for its camera and sizes."""
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
