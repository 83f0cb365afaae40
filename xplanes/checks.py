"""From plain settings to typed ones, refused where they cannot work."""

import math
from dataclasses import fields, is_dataclass
from typing import Any

from xplanes.config import (
    CONF,
    XPLANES,
    BundledLRMConfig,
    ConfigError,
    DataConfig,
    DecompositionConfig,
    DemoConfig,
    ImageLRMConfig,
    LRMConfig,
    PreparationConfig,
    PretrainedLRMConfig,
    SamplerConfig,
    TrainConfig,
    TrainerConfig,
    TriplaneFileConfig,
    build,
)
from xplanes.schemas import families


def parse(config: dict[str, Any]) -> TrainConfig:
    """A plain configuration, as saved in a run directory, as typed settings.

    Raises:
        ConfigError: If settings are out of range or contradict one another.
    """
    data = DemoConfig if config["data"]["name"] == "demo" else DataConfig
    lrm = LRMConfig
    if "triplanes" in config["lrm"]:
        lrm = TriplaneFileConfig
    elif "bundled" in config["lrm"]:
        lrm = BundledLRMConfig
    elif "architecture" in config["lrm"]:
        lrm = PretrainedLRMConfig
    kind = config["model"].get("family")
    family = families.FAMILIES.get(kind, XPLANES)
    if (problem := families.misfit(config, family, kind or "default")) is not None:
        raise ConfigError(problem)
    sampler = families.SAMPLERS.get(config["sampler"]["name"], SamplerConfig)
    typed = TrainConfig(
        seed=config["seed"],
        resume=config.get("resume"),
        data=build(data, config["data"]),
        model=build(family.model, config["model"]),
        lrm=build(lrm, config["lrm"]),
        preparation=build(PreparationConfig, config["preparation"]),
        decomposition=build(DecompositionConfig, config["decomposition"]),
        sampler=build(sampler, config["sampler"]),
        loss=build(family.loss, config["loss"]),
        trainer=build(TrainerConfig, config["trainer"]),
    )
    check(typed)
    return typed


_POSITIVE = (
    """data.resolution data.views data.eval_views data.half_side data.train_views data.test_views
data.val_views model.resolution model.time_resolution model.channels model.decoder.width
model.decoder.density_scale sampler.samples sampler.render_samples sampler.grid_resolution
sampler.time_bins sampler.threshold sampler.sweep_every sampler.update_every sampler.update_cells
loss.every loss.sparse_frames loss.start_steps decomposition.penalty decomposition.tolerance
decomposition.max_iterations preparation.frames preparation.fixed_view_seconds
preparation.fixed_view_steps lrm.megabytes lrm.batch trainer.devices
trainer.max_steps trainer.max_seconds trainer.plateau trainer.rays_per_batch
trainer.samples_per_batch trainer.accumulate trainer.plane_lr trainer.time_lr trainer.decoder_lr
trainer.checkpoint_every trainer.evaluate_views trainer.log_every""".split()
    + families.POSITIVE
)
_NOT_NEGATIVE = (
    """seed model.decoder.hidden model.decoder.colour_margin model.space_scale
model.time_scale loss.total_variation loss.time_smoothness loss.time_magnitude loss.sparse_weight
decomposition.noise trainer.warmup_steps sampler.thinning loss.start_weight""".split()
    + families.NOT_NEGATIVE
)
_SHARE = """data.background_share data.background_jitter sampler.decay sampler.occlusion
trainer.final_lr model.final_rate""".split()
_CHOICES: dict[str, tuple[str, ...]] = {
    "data.eval_split": ("test", "val"),
    "model.plane_set": ("six", "nine", "three"),
    "model.decoder.activation": ("relu", "silu"),
    "model.decoder.density": ("softplus", "exp"),
    "lrm.precision": ("auto", "32", "bf16"),
    "lrm.matching": ("scale", "pad"),
    "preparation.fixed_view": ("auto", "video", "train"),
    "decomposition.method": ("adaptive", "growing", "admm", "exact"),
    "decomposition.scale": ("rms", "none"),
    "decomposition.static": ("middle", "median", "mean"),
    "decomposition.dynamic": ("random", "rank1"),
    "loss.background": ("white", "random", "one"),
    "trainer.accelerator": ("auto", "cpu", "gpu"),
    "trainer.strategy": ("auto", "ddp"),
    "trainer.precision": ("auto", "32", "bf16"),
    **families.CHOICES,
}


def check(config: TrainConfig) -> None:
    """Refuse settings that cannot work, each with the key, the value and what is allowed."""
    for key, value in _leaves(config):
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{key}={value}: must be a finite number")
        if value is None:
            continue
        if key in _POSITIVE and value <= 0:
            raise ConfigError(f"{key}={value}: must be above 0")
        if key in _NOT_NEGATIVE and value < 0:
            raise ConfigError(f"{key}={value}: must not be negative")
        if key in _SHARE and not 0 <= value <= 1:
            raise ConfigError(f"{key}={value}: must lie between 0 and 1")
        if key == "seed" and value >= 2**32:
            raise ConfigError(f"{key}={value}: must be below 4294967296 (2^32)")
        if key in _CHOICES and value not in _CHOICES[key]:
            raise ConfigError(f"{key}={value}: must be one of {', '.join(_CHOICES[key])}")
    if (problem := families.conflict(config)) is not None:
        raise ConfigError(problem)
    at = config.trainer.evaluate_at
    if any(not 0 <= share <= 1 for share in at):
        raise ConfigError(f"trainer.evaluate_at={at}: shares of the budget, from 0 to 1")
    _check_decomposition(config.decomposition)
    _check_preparation(config)
    if config.trainer.devices > 1 and config.trainer.strategy != "ddp":
        raise ConfigError(
            f"trainer.devices={config.trainer.devices} with trainer.strategy=auto: several devices "
            "need trainer=ddp"
        )


def _check_preparation(config: TrainConfig) -> None:
    elevation = config.preparation.elevation
    if not -90 <= elevation <= 90:
        raise ConfigError(f"preparation.elevation={elevation}: must lie between -90 and 90")
    models = sorted(path.stem for path in (CONF / "model").glob("*.yaml"))
    if (filming := config.preparation.fixed_view_model) not in models:
        raise ConfigError(
            f"preparation.fixed_view_model={filming}: must be one of {', '.join(models)}"
        )
    lrm = config.lrm
    if not isinstance(lrm, ImageLRMConfig):
        return
    if lrm.crop and lrm.matching == "pad":
        raise ConfigError(
            "lrm.crop=true with lrm.matching=pad: a crop settles the size already; set one of "
            "lrm.crop=false and lrm.matching=scale"
        )
    if config.trainer.devices > 1 and config.preparation.cache is None:
        raise ConfigError(
            f"preparation.cache=null with lrm={lrm.name} and trainer.devices="
            f"{config.trainer.devices}: the processes share the start through the cache; name a "
            "folder"
        )


def _check_decomposition(config: DecompositionConfig) -> None:
    weight = config.sparsity_weight
    if weight != "auto" and (isinstance(weight, str) or weight <= 0):
        raise ConfigError(
            f"decomposition.sparsity_weight={weight}: must be auto or a number above 0"
        )
    if config.dynamic == "random" and config.noise == 0:
        raise ConfigError(
            "decomposition.noise=0 with decomposition.dynamic=random: time planes of zeros never "
            "learn, as products of two zeros have no gradient; set decomposition.noise=0.01"
        )


def _leaves(node: Any, prefix: str = "") -> list[tuple[str, Any]]:
    found = []
    for entry in fields(node):
        value = getattr(node, entry.name)
        key = f"{prefix}{entry.name}"
        found += _leaves(value, f"{key}.") if is_dataclass(value) else [(key, value)]
    return found
