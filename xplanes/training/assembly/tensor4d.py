"""Tensor4D, and its sampler, from settings."""

from xplanes.config import TrainConfig
from xplanes.fields.base import RadianceField
from xplanes.fields.hierarchy import MOVING, STILL, Groups, HierarchicalPlanes, Level
from xplanes.fields.tensor4d import Tensor4D, Tensor4DDensity
from xplanes.rendering.neus import NeusRenderer
from xplanes.schemas.samplers import NeusConfig
from xplanes.schemas.tensor4d import Tensor4DConfig, Tensor4DDensityConfig
from xplanes.training.assembly.site import FIELD_STREAM, Site, start_values
from xplanes.training.methods.base import Method
from xplanes.training.methods.tensor4d import Tensor4DDensityMethod, Tensor4DMethod
from xplanes.training.sampling.base import Sampling
from xplanes.training.sampling.neus import NeusSampling


def hierarchical_planes(
    model: Tensor4DDensityConfig, groups: Groups, *, fine: bool
) -> HierarchicalPlanes:
    """Planes of the coarse level, and of the fine one."""
    rows = model.time_resolution
    levels = [Level(model.resolution, rows, model.channels)]
    if fine:
        levels.append(Level(model.fine_resolution, rows, model.fine_channels))
    return HierarchicalPlanes(groups, levels, blur=model.blur_resolution)


def tensor4d_method(config: TrainConfig, site: Site) -> Method:
    """Tensor4D as published: a surface and a flow."""
    model: Tensor4DConfig = config.model
    moves = site.moments > 1
    with start_values(config.seed, FIELD_STREAM):
        field = Tensor4D(
            hierarchical_planes(model, STILL, fine=True),
            hierarchical_planes(model, MOVING, fine=False) if moves else None,
            model.width,
            octaves=(model.point_octaves, model.time_octaves, model.direction_octaves),
            radius=model.radius,
            sharpness=model.sharpness,
        )
    return Tensor4DMethod(field, model, config.loss)


def tensor4d_density_method(config: TrainConfig, site: Site) -> Method:
    """The nine planes of Tensor4D with a density."""
    model: Tensor4DDensityConfig = config.model
    groups = MOVING if site.moments > 1 else STILL
    with start_values(config.seed, FIELD_STREAM):
        field = Tensor4DDensity(
            hierarchical_planes(model, groups, fine=True),
            model.width,
            octaves=(model.point_octaves, model.time_octaves, model.direction_octaves),
        )
    return Tensor4DDensityMethod(field, model)


def neus_sampling(config: TrainConfig, site: Site, field: RadianceField) -> Sampling:
    """Samples near the field's surface."""
    sampler: NeusConfig = config.sampler
    renderer = NeusRenderer(
        field,
        samples=sampler.samples,
        more=sampler.more_samples,
        coarse_sharpness=sampler.coarse_sharpness,
    )
    return NeusSampling(renderer)
