"""Shapes that deform: rays against a dense search, bounds, and what deformation keeps."""

import math

import pytest
import torch

from tests.synthetic.rays import float_rays
from xplanes.synthetic.demo.assembly import Assembly, Joint, Part
from xplanes.synthetic.demo.geometry import Box, Checker, Ellipsoid, Plain
from xplanes.synthetic.demo.implicit import Bent, Blend, Drop, Fluid, Lobed, Twisted, Waving
from xplanes.synthetic.demo.motions import Steady, Swing
from xplanes.synthetic.demo.render import camera_at, render_image

FLUID = Fluid(
    drops=(
        Drop((-0.3, 0.0, 0.0), 0.2, x=Swing(0, 0.25, 1)),
        Drop((0.3, 0.1, 0.0), 0.25, x=Swing(0, -0.3, 1), size=Swing(1, 0.2, 1)),
        Drop((0.0, 0.0, 0.3), 0.1, y=Steady(-0.4, 0.8), z=Swing(0, 0.1, 2)),
    ),
    blend=0.05,
    half=(0.95, 0.8, 0.6),
)

SHAPES = {
    "fluid": FLUID,
    "twisted": Twisted(half=(0.2, 0.12, 0.5), rounding=0.03, twist=Swing(0, 90, 1)),
    "bent": Bent(length=0.8, radius=0.1, tip=0.04, bend=Swing(20, 200, 1)),
    "waving": Waving(half=(0.5, 0.03, 0.25), reach=0.15, waves=1.3, phase=Steady(0, 1)),
    "lobed": Lobed(radius=0.35, lobes=5, swell=Swing(0.1, 0.12, 1), most=0.22,
                   stretch=Swing(1, 0.2, 1), tallest=(0.8, 1.2)),
}  # fmt: skip

TIMES = (0.0, 0.24, 0.7)


@pytest.mark.parametrize("name", SHAPES)
def test_rays_meet_the_surface_where_a_dense_search_finds_it(name):
    origins, directions = float_rays(600, seed=1, distance=3.0, spread=0.6)
    steps = torch.linspace(1.6, 4.4, 3000)
    for time in TIMES:
        shape = SHAPES[name].at(time)
        points = origins[:, None] + steps[:, None] * directions[:, None]
        inside = shape.inside(points.reshape(-1, 3)).reshape(len(origins), -1)
        first = steps[inside.to(torch.uint8).argmax(dim=1)]
        expected = torch.where(inside.any(dim=1), first, torch.inf)
        distance = shape.hit(origins, directions)
        # Rays that only graze the shape may count either way.
        deep = inside.sum(dim=1) > 15
        assert 40 < deep.sum() < 590
        assert (distance - expected)[deep].abs().max() < 3e-3
        touched = distance.isfinite() & ~inside.any(dim=1)
        assert touched.float().mean() < 0.01
        hits = origins[deep] + distance[deep, None] * directions[deep]
        assert shape.signed_distance(hits).abs().max() < 2e-4
        assert ((shape.normal(hits) * directions[deep]).sum(dim=-1) < 0.05).all()


@pytest.mark.parametrize("name", SHAPES)
def test_the_bound_is_no_larger_than_the_distance_and_the_box_holds_the_shape(name):
    torch.manual_seed(2)
    cube = 2.4 * torch.rand(8000, 3) - 1.2
    for time in TIMES:
        shape = SHAPES[name].at(time)
        points = torch.cat([cube, cube * torch.tensor(shape.extent)])
        value = shape.value(points)
        inside = points[value < 0]
        assert len(inside) > 100
        assert (inside.abs() <= torch.tensor(shape.extent) + 1e-5).all()
        within = (points.abs() <= 1.05 * torch.tensor(shape.extent)).all(dim=-1) & (value > 0)
        nearest = torch.cdist(points[within], inside).amin(dim=1)
        assert (value[within] <= nearest + 1e-5).all()


def test_rays_from_inside_leave():
    torch.manual_seed(3)
    points = 0.2 * torch.rand(200, 3) + torch.tensor([-0.1, -0.1, 0.1])
    shape = Twisted(half=(0.4, 0.4, 0.5), rounding=0.03, twist=Steady(40, 0))
    directions = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    distance = shape.hit(points, directions)
    assert distance.isfinite().all()
    ends = points + distance[:, None] * directions
    assert shape.value(ends).abs().max() < 2e-4


def test_a_stalk_keeps_its_length_and_its_girth():
    for degrees in (0.0, 40.0, -130.0, 300.0):
        stalk = Bent(length=0.8, radius=0.1, tip=0.1, bend=Steady(degrees, 0))
        angle = math.radians(degrees) or 1e-9
        along = torch.linspace(0, 0.8, 50)
        turn = along * angle / 0.8
        axis = torch.stack(
            [0.8 / angle * (1 - turn.cos()), torch.zeros(50), 0.8 / angle * turn.sin()], dim=-1
        )
        if degrees == 0:
            axis = torch.stack([torch.zeros(50), torch.zeros(50), along], dim=-1)
        assert torch.allclose(stalk.value(axis), torch.full((50,), -0.1), atol=6e-3)
        assert torch.allclose(stalk.material(axis)[:, 2], along, atol=6e-3)


def test_patterns_stick_to_what_deforms():
    """A point of the material keeps its colour while the column twists."""
    shape = Twisted(half=(0.2, 0.2, 0.5), rounding=0.02, twist=Swing(0, 80, 1))
    pattern = Checker(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (0.07, 0.07, 0.07))
    assembly = Assembly((Part(shape, pattern),), light=None)
    colours = []
    for time in (0.0, 0.1, 0.25):
        angle = math.radians(80 * math.sin(2 * math.pi * time)) * 0.3 / 0.5
        x, y = 0.13, -0.16
        place = [x * math.cos(angle) - y * math.sin(angle),
                 x * math.sin(angle) + y * math.cos(angle), 0.3]  # fmt: skip
        colours.append(assembly.pose(time).parts[0].colour(torch.tensor([place])))
    assert torch.equal(colours[0], colours[1])
    assert torch.equal(colours[0], colours[2])


def test_colours_mix_where_drops_merge():
    paints = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    surface = Blend(FLUID, paints).at(0.0)
    ends = surface.colour(torch.tensor([[-0.5, 0.0, 0.0], [0.55, 0.1, 0.0]]))
    assert ends[0, 0] > 0.95
    assert ends[1, 1] > 0.95
    merged = Blend(FLUID, paints).at(0.25).colour(torch.tensor([[0.0, 0.02, -0.05]]))
    assert merged[0, :2].min() > 0.1
    assert merged.sum().item() == pytest.approx(1)


def test_a_scale_joint_scales_all_that_it_carries():
    grow = Joint("grow", kind="scale", motion=Steady(2.0, 1.0))
    arm = Joint("arm", "grow", (0.2, 0.0, 0.1), (0, 30, 0), "slide", (1, 0, 0), Steady(0.1, 0.0))
    pattern = Checker(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (0.1, 0.1, 0.1))
    parts = (Part(Box((0.3, 0.2, 0.1)), pattern, "arm", (0.1, 0, 0)),
             Part(Ellipsoid((0.1, 0.2, 0.1)), Plain((0.0, 1.0, 0.0)), "grow"))  # fmt: skip
    scaled = Assembly(parts, (grow, arm)).pose(0.5)
    plain = Assembly(parts, (Joint("grow"), arm)).pose(0.5)
    torch.manual_seed(0)
    points = 2 * torch.rand(4000, 3) - 1
    assert torch.equal(scaled.inside(2.5 * points), plain.inside(points))
    ways = torch.nn.functional.normalize(torch.randn(4000, 3), dim=-1)
    far, near = (p.cast(s * points, ways).distance for p, s in ((scaled, 2.5), (plain, 1)))
    assert torch.allclose(far, 2.5 * near, atol=1e-4)
    for low, high in zip(scaled.bounds(), plain.bounds(), strict=True):
        assert torch.allclose(low, 2.5 * high)
    near, far = camera_at(30, 20), camera_at(30, 20)
    far[:3, 3] *= 2.5
    images = (render_image(plain, near, 48), render_image(scaled, far, 48))
    difference = images[0].astype(int) - images[1].astype(int)
    assert (abs(difference).max(axis=-1) > 2).mean() < 0.005
    # All of a placed assembly may be scaled.
    whole = Assembly((Part(Box((0.3, 0.2, 0.1)), Plain((1.0, 0.0, 0.0))),))
    low, high = whole.placed((1.0, 0.0, 0.0), scale=3.0).pose(0).bounds()
    assert torch.allclose(low, torch.tensor([0.1, -0.6, -0.3]))
    assert torch.allclose(high, torch.tensor([1.9, 0.6, 0.3]))
