"""TiNeuVox, and the fixed-step sampler, from settings."""

import torch
from torch import Tensor

from xplanes.config import TrainConfig
from xplanes.fields.base import RadianceField
from xplanes.fields.tineuvox import TiNeuVox
from xplanes.rendering.fixed_step import FixedStepRenderer
from xplanes.scenes.frame import Frame, cube_frame
from xplanes.scenes.views import Views
from xplanes.schemas.samplers import FixedStepConfig
from xplanes.schemas.tineuvox import TiNeuVoxConfig
from xplanes.training.assembly.site import (
    FIELD_STREAM,
    Site,
    check_range,
    origin_cube,
    start_values,
)
from xplanes.training.methods.base import Method
from xplanes.training.methods.tineuvox import TiNeuVoxMethod
from xplanes.training.sampling.base import Sampling
from xplanes.training.sampling.fixed_step import FixedStepSampling


def frusta_box(views: Views, near: float, far: float, margin: float) -> Tensor:
    """The box of all that cameras see between two distances, ``margin`` times as large. [2, 3]"""
    low, high = torch.full((3,), torch.inf), torch.full((3,), -torch.inf)
    for index in range(len(views)):
        origins, directions = views.image_rays(index)
        for distance in (near, far):
            ends = origins + distance * directions
            low, high = torch.minimum(low, ends.amin(dim=0)), torch.maximum(high, ends.amax(dim=0))
    room = (margin - 1) / 2 * (high - low)
    return torch.stack([low - room, high + room])


def tineuvox_box(config: TrainConfig, views: Views) -> Tensor:
    """The box of TiNeuVox' grid, in world units. [2, 3]"""
    model: TiNeuVoxConfig = config.model
    if model.half_side is None:
        return frusta_box(views, model.near, model.far, model.margin)
    return torch.tensor([[-1.0] * 3, [1.0] * 3]) * model.half_side


def tineuvox_frame(config: TrainConfig, views: Views) -> Frame:
    """The smallest cube around the world's origin that holds the grid's box."""
    if config.model.half_side is not None:
        return origin_cube(config.model.half_side, config, views)
    return cube_frame(float(tineuvox_box(config, views).abs().max()), torch.zeros(3))


def tineuvox_method(config: TrainConfig, site: Site) -> Method:
    """TiNeuVox, of any size."""
    model: TiNeuVoxConfig = config.model
    with start_values(config.seed, FIELD_STREAM):
        field = TiNeuVox(
            tineuvox_box(config, site.views),
            model.resolution,
            model.channels,
            model.width,
            octaves=(
                model.point_octaves,
                model.time_octaves,
                model.direction_octaves,
                model.feature_octaves,
            ),
            alpha=model.alpha_start,
            halvings=len(model.grow_at),
            moves=site.moments > 1,
            unit=site.unit,
            precision=site.precision,
        )
    return TiNeuVoxMethod(field, model, config.loss)


def fixed_step_sampling(config: TrainConfig, site: Site, field: RadianceField) -> Sampling:
    """Equal steps through the field's box."""
    sampler: FixedStepConfig = config.sampler
    check_range(site, sampler.near, sampler.far)
    renderer = FixedStepRenderer(
        field,
        near=sampler.near * site.frame.scale,
        far=sampler.far * site.frame.scale,
        step=sampler.step,
        threshold=sampler.threshold,
    )
    return FixedStepSampling(renderer)
