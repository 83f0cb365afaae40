"""X-Planes fields with extreme values: forward, backward, and as initialisations."""

import pytest
import torch

from tests.stress.models import settings, trained
from tests.stress.references import spread
from tests.stress.scenes import write_scene
from xplanes.fields import Decoder, XPlanes
from xplanes.fields.xplanes import SPACE_PLANES, TIME_PLANES
from xplanes.preparation.sequence import TriplaneSequence, save_triplanes
from xplanes.rendering.grid_renderer import DIAGONAL, GridRenderer
from xplanes.rendering.occupancy import OccupancyGrid

pytestmark = pytest.mark.stress

VALUES = (0.0, 1e-30, 1.0, 1e4, 1e30, "mixed")


def field_of(value, plane_set, precision, density, dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    names = (*SPACE_PLANES, *TIME_PLANES[plane_set])
    planes = {name: spread((4, 6, 6), value, generator).to(dtype) for name in names}
    torch.manual_seed(0)
    decoder = Decoder(
        4, width=16, hidden=2, density=density, density_scale=25.0, precision=precision
    ).to(dtype)
    return XPlanes(planes=planes, decoder=decoder, plane_set=plane_set)


def seen(field, samples, rays=16):
    generator = torch.Generator().manual_seed(1)
    origins = torch.randn(rays, 3, generator=generator)
    origins = 3 * origins / origins.norm(dim=1, keepdim=True)
    aim = 0.5 * torch.randn(rays, 3, generator=generator) - origins
    directions = aim / aim.norm(dim=1, keepdim=True)
    times = torch.linspace(0, 1, rays)
    renderer = GridRenderer(OccupancyGrid(8, 2, step=DIAGONAL / samples), samples)
    inputs = (t.to(field.space.dtype) for t in (origins, directions, times, torch.ones(3)))
    rendering = renderer.render(field, *inputs)
    rendering.colour.square().sum().backward()
    return rendering, [p.grad for p in field.parameters()]


@pytest.mark.parametrize("density", ["softplus", "exp"])
@pytest.mark.parametrize("precision", ["32", "bf16", "64"])
@pytest.mark.parametrize("plane_set", ["three", "six", "nine"])
def test_planes_of_every_size(tally, plane_set, precision, density):
    """Fields: planes of 0 to 1e4, 1 to 1024 samples, three types"""
    dtype = torch.float64 if precision == "64" else torch.float32
    for value in (0.0, 1e-30, 1.0, 1e4):
        for samples in (1, 16, 1024):
            number = "bf16" if precision == "bf16" else "32"
            field = field_of(value, plane_set, number, density, dtype)
            rendering, gradients = seen(field, samples)
            tally.finite(rendering.colour, rendering.opacity, rendering.depth, *gradients)


@pytest.mark.parametrize("frames", [1, 6, 300])
@pytest.mark.parametrize("value", VALUES)
def test_initial_values_of_every_size(tally, tmp_path, value, frames):
    """Runs from triplanes of 0, 1e-30, 1, 1e4, 1e30 and mixed, 1 to 300 frames"""
    scene = write_scene(tmp_path / "scenes", "ball")
    planes = spread((frames, 3, 4, 8, 8), value, torch.Generator().manual_seed(0)).float()
    save_triplanes(tmp_path / "initial.pt", TriplaneSequence(planes))
    plain = settings("six_planes", scene, "lrm=file", f"lrm.triplanes={tmp_path / 'initial.pt'}")
    state = tally.trained(lambda: trained(plain, tmp_path / "run"))
    assert state is not None or value in (1e30, "mixed")
