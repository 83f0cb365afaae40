"""The published baselines and their samplers from settings: names to classes, for the builder."""

from xplanes.schemas.kplanes import KPlanesConfig
from xplanes.schemas.samplers import FixedStepConfig, NeusConfig, ProposalConfig
from xplanes.schemas.tensor4d import Tensor4DConfig, Tensor4DDensityConfig
from xplanes.schemas.tineuvox import TiNeuVoxConfig
from xplanes.training.assembly.kplanes import kplanes_frame, kplanes_method, proposal_sampling
from xplanes.training.assembly.site import Plan, SamplingBuilder, Site, scene_cube, time_rows
from xplanes.training.assembly.tensor4d import (
    neus_sampling,
    tensor4d_density_method,
    tensor4d_method,
)
from xplanes.training.assembly.tineuvox import (
    fixed_step_sampling,
    tineuvox_frame,
    tineuvox_method,
)

__all__ = ["PLANS", "SAMPLINGS", "Site", "scene_cube", "time_rows"]

PLANS: dict[type, Plan] = {
    KPlanesConfig: Plan(kplanes_frame, kplanes_method),
    TiNeuVoxConfig: Plan(tineuvox_frame, tineuvox_method),
    Tensor4DConfig: Plan(scene_cube, tensor4d_method),
    Tensor4DDensityConfig: Plan(scene_cube, tensor4d_density_method),
}
"""By the schema of the model group."""

SAMPLINGS: dict[type, SamplingBuilder] = {
    ProposalConfig: proposal_sampling,
    FixedStepConfig: fixed_step_sampling,
    NeusConfig: neus_sampling,
}
"""By the schema of the sampler group."""
