"""Which settings go together: families of models, their losses and samplers."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from xplanes.schemas.kplanes import KPlanesConfig, KPlanesLossConfig
from xplanes.schemas.samplers import (
    FixedStepConfig,
    NeusConfig,
    ProposalConfig,
    SamplerConfig,
    fixed_step_conflict,
    occupancy_conflict,
    proposal_conflict,
)
from xplanes.schemas.tensor4d import (
    Tensor4DConfig,
    Tensor4DDensityConfig,
    Tensor4DDensityLossConfig,
    Tensor4DLossConfig,
)
from xplanes.schemas.tineuvox import TiNeuVoxConfig, TiNeuVoxLossConfig


@dataclass(frozen=True)
class Family:
    """What goes with a family of models.

    Attributes:
        model: Schema of the model group.
        loss: Schema of the loss group.
        samplers: Names of the samplers that can place its samples.
    """

    model: type
    loss: type
    samplers: tuple[str, ...]


FAMILIES = {
    "kplanes": Family(KPlanesConfig, KPlanesLossConfig, ("proposal", "occupancy")),
    "tineuvox": Family(TiNeuVoxConfig, TiNeuVoxLossConfig, ("fixed_step", "occupancy", "proposal")),
    "tensor4d": Family(Tensor4DConfig, Tensor4DLossConfig, ("neus",)),
    "tensor4d_density": Family(
        Tensor4DDensityConfig, Tensor4DDensityLossConfig, ("occupancy", "proposal")
    ),
}
"""By ``model.family``; models without that key are X-Planes."""

SAMPLERS: dict[str, type] = {
    "proposal": ProposalConfig,
    "fixed_step": FixedStepConfig,
    "neus": NeusConfig,
}
"""By ``sampler.name``; all others are settings of the occupancy grid."""

SCHEMAS: dict[tuple[str, str], type] = {
    ("model", "kplanes_schema"): KPlanesConfig,
    ("loss", "kplanes_schema"): KPlanesLossConfig,
    ("model", "tineuvox_schema"): TiNeuVoxConfig,
    ("loss", "tineuvox_schema"): TiNeuVoxLossConfig,
    ("model", "tensor4d_schema"): Tensor4DConfig,
    ("model", "tensor4d_density_schema"): Tensor4DDensityConfig,
    ("loss", "tensor4d_schema"): Tensor4DLossConfig,
    ("loss", "tensor4d_density_schema"): Tensor4DDensityLossConfig,
    ("sampler", "proposal_schema"): ProposalConfig,
    ("sampler", "neus_schema"): NeusConfig,
    ("sampler", "fixed_step_schema"): FixedStepConfig,
}

POSITIVE = """model.half_side model.width model.learning_rate model.far model.margin
model.grid_learning_rate model.deformation_learning_rate model.network_learning_rate
model.decay_steps model.fine_resolution model.fine_channels model.blur_resolution
model.plane_learning_rate model.radius model.sharpness loss.smoothness_distance
sampler.more_samples sampler.coarse_sharpness sampler.far sampler.step
sampler.time_resolution sampler.channels sampler.width sampler.anneal_steps
sampler.anneal_slope sampler.update_warmup sampler.padding sampler.learning_rate""".split()
NOT_NEGATIVE = """model.warmup_steps model.near model.point_octaves model.time_octaves
model.direction_octaves model.feature_octaves loss.time_identity loss.entropy
loss.sample_colour model.fine_from model.blur_until loss.eikonal loss.opacity
loss.smoothness sampler.near sampler.histogram sampler.total_variation sampler.time_smoothness
sampler.time_identity""".split()
CHOICES: dict[str, tuple[str, ...]] = {
    "model.variant": ("hybrid", "explicit"),
    "loss.variation": ("coded", "corrected"),
    "sampler.variation": ("coded", "corrected"),
}

LISTS = ("scales", "proposal_samples", "resolutions")
"""Keys that hold one or more numbers above 0."""

XPLANES_RATES = """trainer.plane_lr trainer.time_lr trainer.decoder_lr trainer.warmup_steps
trainer.final_lr""".split()
"""Keys that only X-Planes use; baselines bring learning rates of their own."""


_CONFLICTS: dict[type, Callable[[Any], str | None]] = {
    SamplerConfig: occupancy_conflict,
    ProposalConfig: proposal_conflict,
    FixedStepConfig: fixed_step_conflict,
}


def misfit(config: dict[str, Any], family: Family, losses: str) -> str | None:
    """What is wrong between the groups of a plain configuration, in words; None for nothing.

    Args:
        config: The configuration.
        family: The family of its model.
        losses: The option of the loss group that fits it.
    """
    model, sampler, lrm = (config[group]["name"] for group in ("model", "sampler", "lrm"))
    known = {entry.name for entry in fields(family.loss)}
    if strange := sorted(set(config["loss"]) - known):
        return f"loss.{strange[0]} with model={model}: it has no such term; set loss={losses}"
    baseline = family in FAMILIES.values()
    if baseline and (missing := sorted(known - set(config["loss"]))):
        return f"loss.{missing[0]} with model={model}: it is not set; set loss={losses}"
    kind = sampler if sampler in SAMPLERS else "occupancy"
    if kind not in family.samplers:
        return f"sampler={sampler} with model={model}: must be one of {', '.join(family.samplers)}"
    if baseline and lrm != "none":
        return (
            f"lrm={lrm} with model={model}: triplanes start X-Planes alone; set lrm=none, "
            "or model=six_planes or model=nine_planes"
        )
    return None


def conflict(config: Any) -> str | None:
    """What is wrong between settings that each are allowed, in words; None for nothing."""
    for group in ("model", "sampler"):
        settings = getattr(config, group)
        if hasattr(settings, "space_low") and settings.space_low > settings.space_high:
            return (
                f"{group}.space_low={settings.space_low}: must not be above "
                f"{group}.space_high={settings.space_high}"
            )
        for name in LISTS:
            values = getattr(settings, name, [1])
            if not values or min(values) < 1:
                return f"{group}.{name}={values}: must be one or more numbers above 0"
    if isinstance(config.model, TiNeuVoxConfig):
        if config.model.near >= config.model.far:
            return f"model.near={config.model.near}: must be below model.far={config.model.far}"
        if not 0 < config.model.alpha_start < 1:
            return f"model.alpha_start={config.model.alpha_start}: must lie between 0 and 1"
    own, given = getattr(config.model, "half_side", None), config.data.half_side
    if own is not None and given is not None:
        return (
            f"data.half_side={given} with model.half_side={own}: two cubes; set "
            "model.half_side=null to use the former, or leave data.half_side out"
        )
    baseline = any(isinstance(config.model, family.model) for family in FAMILIES.values())
    if config.trainer.devices > 1 and (baseline or isinstance(config.sampler, ProposalConfig)):
        return (
            f"trainer.devices={config.trainer.devices} with model={config.model.name} and "
            f"sampler={config.sampler.name}: they train on one device; set trainer.devices=1"
        )
    check = _CONFLICTS.get(type(config.sampler))
    return None if check is None else check(config.sampler)
