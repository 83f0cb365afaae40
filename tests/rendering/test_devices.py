"""Off the CPU nothing of a step lies on the CPU, and nothing waits for the device.

Tensors on torch's "meta" device have no values: mixing them with others raises, and so does asking
for a value, which on a GPU would hold up the step.
"""

import contextlib

import pytest
import torch
from torch import nn

from xplanes.baselines.kplanes.field import DensityField, ExplicitDecoder, HybridDecoder, KPlanes
from xplanes.baselines.products import PlaneProducts, PlaneTerms
from xplanes.baselines.proposal import ProposalRenderer
from xplanes.decomposition.sparse_loss import SparseProduct
from xplanes.fields import Decoder, XPlanes
from xplanes.fields.xplanes import PLANE_SETS, random_planes
from xplanes.rendering.marching import _starts
from xplanes.rendering.occupancy import OccupancyGrid

RAYS = 6


@pytest.fixture(autouse=True)
def no_autocast(monkeypatch):
    """Mixed precision knows no such device."""
    monkeypatch.setattr(torch, "autocast", lambda *given, **named: contextlib.nullcontext())


def xplanes_field(plane_set="six"):
    generator = torch.Generator().manual_seed(0)
    sizes = {"channels": 3, "resolution": 6, "time_resolution": 4}
    planes = random_planes(plane_set, **sizes, space_scale=0.1, time_scale=0.1, generator=generator)
    return XPlanes(planes=planes, decoder=Decoder(3), plane_set=plane_set).to("meta")


def products(scales=(1, 2)):
    return PlaneProducts(4, 6, scales, 3, low=0.1, high=0.5)


FIELDS = {
    "three": lambda: xplanes_field("three"),
    "six": xplanes_field,
    "nine": lambda: xplanes_field("nine"),
    "hybrid": lambda: KPlanes(products(), HybridDecoder(8)).to("meta"),
    "explicit": lambda: KPlanes(products(), ExplicitDecoder(8)).to("meta"),
}


def test_rays_through_density_fields_and_back():
    for name in FIELDS:
        field = FIELDS[name]()
        proposals = nn.ModuleList([DensityField(products((1,)))]).to("meta")
        renderer = ProposalRenderer(proposals, [8], 5)
        rays = [torch.empty(RAYS, *shape, device="meta") for shape in ((3,), (3,), (), (3,))]
        rendering = renderer.render(field, *rays, None, learn=True)
        rendering.colour.sum().backward()
        assert rendering.colour.shape == (RAYS, 3), name
        for parameter in field.parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.device.type == "meta", name


def test_the_grid_takes_in_what_samples_showed():
    grid = OccupancyGrid(4, 2, step=0.1).to("meta")
    cells = torch.empty(9, dtype=torch.int64, device="meta")
    grid.observe(cells, torch.empty(9, device="meta"))
    points, times = grid.draw(cells, torch.empty(9, 4, device="meta"))
    assert (points.shape, times.shape) == ((9, 3), (9,))
    assert _starts(cells, 5).shape == (5,)


def test_regularisers():
    planes = products().to("meta")
    PlaneTerms(1.0, "coded", 1.0, 1.0).add_gradients(planes)
    assert all(plane.grad is not None for _, plane in planes.planes())
    field = xplanes_field()
    sparse = torch.empty(5, 3, 3, 6, 6)  # It starts on the CPU, and follows the planes once.
    term = SparseProduct(sparse, PLANE_SETS["six"], 2)
    gradient = torch.empty_like(field.time)
    term.add_gradient(gradient, field.time, 1.0, torch.Generator().manual_seed(0))
    assert term.sparse.device.type == "meta"
