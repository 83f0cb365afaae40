"""The published baselines and their samplers from settings: names to classes, for the builder."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from xplanes.config import ConfigError, TrainConfig
from xplanes.fields.base import RadianceField
from xplanes.fields.hierarchy import MOVING as MOVING_GROUPS
from xplanes.fields.hierarchy import STILL as STILL_GROUPS
from xplanes.fields.hierarchy import Groups, HierarchicalPlanes, Level
from xplanes.fields.kplanes import DensityField, ExplicitDecoder, HybridDecoder, KPlanes
from xplanes.fields.products import PlaneProducts
from xplanes.fields.tensor4d import Tensor4D, Tensor4DDensity
from xplanes.fields.tineuvox import TiNeuVox
from xplanes.rendering.fixed_step import FixedStepRenderer
from xplanes.rendering.neus import NeusRenderer
from xplanes.rendering.proposal import ProposalRenderer
from xplanes.scenes.batches import step_generator
from xplanes.scenes.frame import Frame, cube_frame, scene_frame
from xplanes.scenes.views import Views
from xplanes.schemas.kplanes import KPlanesConfig
from xplanes.schemas.samplers import FixedStepConfig, NeusConfig, ProposalConfig
from xplanes.schemas.tensor4d import Tensor4DConfig, Tensor4DDensityConfig
from xplanes.schemas.tineuvox import TiNeuVoxConfig
from xplanes.training.methods.base import Method
from xplanes.training.methods.kplanes import KPlanesMethod
from xplanes.training.methods.tensor4d import Tensor4DDensityMethod, Tensor4DMethod
from xplanes.training.methods.tineuvox import TiNeuVoxMethod
from xplanes.training.sampling.base import Sampling
from xplanes.training.sampling.fixed_step import FixedStepSampling
from xplanes.training.sampling.neus import NeusSampling
from xplanes.training.sampling.proposal import ProposalSampling

FIELD_STREAM, SAMPLER_STREAM = 1_000_099, 1_000_117
"""Random streams of the start values."""


@dataclass(frozen=True)
class Site:
    """What a field is built for.

    Attributes:
        views: Training views.
        frame: The field's frame.
        precision: Of matrix products: "32" or "bf16".
        begun: Whether the field starts from something that it shows.
    """

    views: Views
    frame: Frame
    precision: str
    begun: bool = False

    @property
    def unit(self) -> float:
        """World units per unit of the frame."""
        return 1 / self.frame.scale

    @property
    def moments(self) -> int:
        """Number of distinct times; 1 for a scene that stands still."""
        return len(self.views.times.unique())


@contextmanager
def start_values(seed: int, stream: int) -> Iterator[None]:
    """Draw random start values from a stream of the run's seed, and leave other streams alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(step_generator(seed, 0, stream).initial_seed())
        yield


def kplanes_frame(config: TrainConfig, views: Views) -> Frame:
    """A cube around the world's origin, or the scene's."""
    if config.model.half_side is None:
        return scene_frame(views, config.data.half_side)
    return cube_frame(config.model.half_side, torch.zeros(3))


def kplanes_method(config: TrainConfig, site: Site) -> Method:
    """K-Planes, hybrid or explicit."""
    model: KPlanesConfig = config.model
    rows = model.time_resolution or max(2, math.ceil(site.moments / 2))
    decoder = {"hybrid": HybridDecoder, "explicit": ExplicitDecoder}[model.variant]
    with start_values(config.seed, FIELD_STREAM):
        products = PlaneProducts(
            model.channels,
            model.resolution,
            model.scales,
            rows if site.moments > 1 else None,
            low=model.space_low,
            high=model.space_high,
        )
        decode = decoder(products.features, model.width, precision=site.precision)
    return KPlanesMethod(KPlanes(products, decode, site.unit), model, config.loss)


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


def proposal_sampling(config: TrainConfig, site: Site, field: RadianceField) -> Sampling:
    """Density fields that train along, for any field."""
    sampler: ProposalConfig = config.sampler
    bounds = {}
    if sampler.near is not None and sampler.far is not None:
        check_range(site, sampler.near, sampler.far)
        bounds = {"near": sampler.near * site.frame.scale, "far": sampler.far * site.frame.scale}
    proposals = nn.ModuleList()
    with start_values(config.seed, SAMPLER_STREAM):
        for resolution in sampler.resolutions:
            products = PlaneProducts(
                sampler.channels,
                resolution,
                [1],
                sampler.time_resolution if site.moments > 1 else None,
                low=sampler.space_low,
                high=sampler.space_high,
            )
            proposals.append(
                DensityField(
                    products,
                    sampler.width,
                    linear=sampler.linear,
                    unit=site.unit,
                    precision=site.precision,
                )
            )
    renderer = ProposalRenderer(
        proposals, sampler.proposal_samples, sampler.samples, padding=sampler.padding, **bounds
    )
    return ProposalSampling(renderer, sampler)


def check_range(site: Site, near: float, far: float) -> None:
    """Refuse distances between which the cameras do not see the centre of the field's cube.

    Raises:
        ConfigError: With the cameras' distances.
    """
    away = (site.views.camera_to_world[:, :3, 3] - site.frame.centre).norm(dim=-1)
    nearest, farthest = float(away.min()), float(away.max())
    if nearest <= near or farthest >= far:
        raise ConfigError(
            f"sampler.near={near} with sampler.far={far}: the cameras stand {nearest:.3g} to "
            f"{farthest:.3g} world units from the centre of the field's cube; set both to numbers "
            "around these"
        )


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
            hierarchical_planes(model, STILL_GROUPS, fine=True),
            hierarchical_planes(model, MOVING_GROUPS, fine=False) if moves else None,
            model.width,
            octaves=(model.point_octaves, model.time_octaves, model.direction_octaves),
            radius=model.radius,
            sharpness=model.sharpness,
        )
    return Tensor4DMethod(field, model, config.loss)


def tensor4d_density_method(config: TrainConfig, site: Site) -> Method:
    """The nine planes of Tensor4D with a density."""
    model: Tensor4DDensityConfig = config.model
    groups = MOVING_GROUPS if site.moments > 1 else STILL_GROUPS
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


def scene_cube(config: TrainConfig, views: Views) -> Frame:
    """The scene's own cube."""
    return scene_frame(views, config.data.half_side)


@dataclass(frozen=True)
class Plan:
    """How a family of models is built.

    Attributes:
        frame: Its frame, for training views.
        method: Its field and training.
    """

    frame: Callable[[TrainConfig, Views], Frame]
    method: Callable[[TrainConfig, Site], Method]


PLANS: dict[type, Plan] = {
    KPlanesConfig: Plan(kplanes_frame, kplanes_method),
    TiNeuVoxConfig: Plan(tineuvox_frame, tineuvox_method),
    Tensor4DConfig: Plan(scene_cube, tensor4d_method),
    Tensor4DDensityConfig: Plan(scene_cube, tensor4d_density_method),
}
"""By the schema of the model group."""

SAMPLINGS: dict[type, Callable[[TrainConfig, Site, RadianceField], Sampling]] = {
    ProposalConfig: proposal_sampling,
    FixedStepConfig: fixed_step_sampling,
    NeusConfig: neus_sampling,
}
"""By the schema of the sampler group."""
