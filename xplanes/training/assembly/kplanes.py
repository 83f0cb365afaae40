"""K-Planes, and the proposal sampler, from settings."""

from torch import nn

from xplanes.config import TrainConfig
from xplanes.fields.base import RadianceField
from xplanes.fields.kplanes import DensityField, ExplicitDecoder, HybridDecoder, KPlanes
from xplanes.fields.products import PlaneProducts
from xplanes.rendering.proposal import ProposalRenderer
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views
from xplanes.schemas.kplanes import KPlanesConfig
from xplanes.schemas.samplers import ProposalConfig
from xplanes.training.assembly.site import (
    FIELD_STREAM,
    SAMPLER_STREAM,
    Site,
    check_range,
    origin_cube,
    scene_cube,
    start_values,
    time_rows,
)
from xplanes.training.methods.base import Method
from xplanes.training.methods.kplanes import KPlanesMethod
from xplanes.training.sampling.base import Sampling
from xplanes.training.sampling.proposal import ProposalSampling


def kplanes_frame(config: TrainConfig, views: Views) -> Frame:
    """A cube around the world's origin, or the scene's."""
    if config.model.half_side is None:
        return scene_cube(config, views)
    return origin_cube(config.model.half_side, config, views)


def kplanes_method(config: TrainConfig, site: Site) -> Method:
    """K-Planes, hybrid or explicit."""
    model: KPlanesConfig = config.model
    rows = model.time_resolution or time_rows(site.views.times)
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
