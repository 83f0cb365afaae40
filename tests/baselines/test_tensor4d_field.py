"""Tensor4D's fields, renderer and losses against loops, and against what was published."""

import math

import numpy as np
import pytest
import torch

from tests.baselines import oracles
from xplanes.baselines.tensor4d.field import SkipNetwork, Tensor4D
from xplanes.baselines.tensor4d.hierarchy import (
    DYNAMIC,
    STATIC,
    HierarchicalPlanes,
    Level,
    bilinear,
)
from xplanes.baselines.tensor4d.model import (
    eikonal_error,
    feature_change,
    masked_colour_error,
    silhouette_error,
)
from xplanes.baselines.tensor4d.neus import NeusRenderer, section_opacity, weights_of


def planes(groups=STATIC, *, fine=True, size=6, filled=True):
    torch.manual_seed(0)
    levels = [Level(size, 5, 2)] + ([Level(2 * size, 5, 3)] if fine else [])
    made = HierarchicalPlanes(groups, levels, blur=4)
    made.show(fine=True, blurred=False)
    if filled:
        with torch.no_grad():
            for plane in made.planes.values():
                plane.uniform_(-1, 1)
    return made


def surface(moves=True, width=16, filled=True):
    flow = planes(DYNAMIC, fine=False, filled=filled) if moves else None
    return Tensor4D(planes(filled=filled), flow, width, octaves=(4, 3, 2))


def test_reading_a_plane_has_right_first_and_second_derivatives():
    torch.manual_seed(0)
    plane = torch.randn(4, 5, 2).double().requires_grad_()
    # Away from the texels' centres, where the slope jumps.
    columns, rows = torch.tensor([[-0.61, 0.13, 0.7], [0.22, -0.4, 0.91]]).double()
    columns.requires_grad_()
    rows.requires_grad_()
    assert torch.autograd.gradcheck(bilinear, (plane, columns, rows))
    assert torch.autograd.gradgradcheck(bilinear, (plane, columns, rows))


@pytest.mark.parametrize("groups", [STATIC, DYNAMIC])
def test_features_are_all_planes_side_by_side(groups):
    """Inside and outside of the cube."""
    made = planes(groups).double()
    arrays = {name: plane.detach().numpy() for name, plane in made.planes.items()}
    points, times = 1.5 * torch.randn(30, 3).double(), torch.rand(30).double()
    found = made(points, times)
    for n in range(30):
        place = dict(
            zip("xyzt", [*points[n].tolist(), 0.95 * (2 * float(times[n]) - 1)], strict=True)
        )
        for group, features in zip(groups, found, strict=True):
            expected = [
                oracles.plane_value(arrays[f"{level}_{group[0]}_{a}{b}"], place[a], place[b])
                for level in range(2)
                for a, b in group
            ]
            np.testing.assert_allclose(features[n].detach(), np.concatenate(expected), atol=1e-12)


def test_planes_are_read_coarsely_at_first():
    made = planes()
    points, times = 2 * torch.rand(20, 3) - 1, torch.zeros(20)
    whole = made(points, times)
    made.show(fine=False, blurred=False)
    coarse = made(points, times)
    assert all((c[:, 2:] == 0).all() for c in coarse)
    assert all(torch.equal(c[:, :2], w[:, :2]) for c, w in zip(coarse, whole, strict=True))
    made.show(fine=False, blurred=True)
    blurred = made(points, times)
    assert not any(torch.equal(b, c) for b, c in zip(blurred, coarse, strict=True))
    with torch.no_grad():
        for plane in made.planes.values():
            plane.fill_(0.7)
    assert all(torch.allclose(b[:, :2], torch.tensor(0.7)) for b in made(points, times))


def test_a_network_starts_as_a_sphere():
    field = surface(moves=False, width=256, filled=False)
    torch.manual_seed(1)
    places = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    places *= torch.rand(200, 1) * 0.9 + 0.1
    distance, slope, _, _ = field.distance_and_slope(places, torch.zeros(200))
    # A random network comes close to it, the closer the wider it is.
    error = (distance - (places.norm(dim=1) - 0.5)).detach().abs()
    assert error.mean() < 0.1
    assert error.max() < 0.3
    outward = (slope * torch.nn.functional.normalize(places, dim=1)).sum(dim=1)
    assert outward.mean().item() == pytest.approx(1, abs=0.2)
    without_octaves = SkipNetwork(3, 10, 32, 4, radius=0.5)
    assert without_octaves(torch.rand(5, 3), torch.rand(5, 10)).isfinite().all()


def test_slopes_are_the_distances_derivatives():
    field = surface().double()
    points, times = 0.8 * (2 * torch.rand(6, 3).double() - 1), torch.linspace(0, 1, 6).double()
    distance, slope, _, places = field.distance_and_slope(points, times)
    torch.testing.assert_close(places, field.canonical(points, times))
    torch.testing.assert_close(distance, field.distance(places)[0])
    step = 1e-6
    for axis in range(3):
        aside = torch.zeros(3).double()
        aside[axis] = step
        ends = [field.distance(field.canonical(points + s * aside, times))[0] for s in (1, -1)]
        change = (ends[0] - ends[1]) / (2 * step)
        torch.testing.assert_close(slope[:, axis], change, atol=1e-5, rtol=1e-4)
    with torch.no_grad():
        again = field.distance_and_slope(points, times)[1]
    torch.testing.assert_close(again, slope.detach())


def test_opacities_and_weights_equal_loops():
    torch.manual_seed(0)
    shape = (4, 9)
    distance, change = torch.randn(shape).double() / 5, -torch.rand(shape).double()
    lengths, inside = torch.rand(shape).double() / 5, torch.rand(shape) > 0.3
    opacity = section_opacity(distance, change, lengths, 20.0)
    arrays = (t.numpy() for t in (distance, change, lengths))
    np.testing.assert_allclose(opacity, oracles.section_opacities(*arrays, 20.0), atol=1e-12)
    opacity = opacity * inside
    expected = oracles.weights(opacity.numpy(), 1e-7)
    np.testing.assert_allclose(weights_of(opacity), expected, atol=1e-12)


class Ball:
    """A known surface: a ball of radius 0.4, red."""

    sharpness = torch.tensor(400.0)

    def __init__(self):
        self.asked = []

    def canonical(self, points, times):
        return points

    def distance(self, places):
        return places.norm(dim=1) - 0.4, places

    def distance_and_slope(self, points, times):
        self.asked.append(points)
        slope = torch.nn.functional.normalize(points, dim=1)
        return points.norm(dim=1) - 0.4, slope, points, points

    def colour(self, points, slopes, features, directions):
        return torch.tensor([[1.0, 0.0, 0.0]]).expand(len(points), 3)


def looked_at(origins, background):
    """A rendering of rays down the z axis, and the ball."""
    ball, origins = Ball(), torch.tensor(origins)
    renderer = NeusRenderer(ball, samples=64, more=65, coarse_sharpness=64.0)
    directions = torch.tensor([[0.0, 0.0, -1.0]]).expand(len(origins), 3)
    times, background = torch.zeros(len(origins)), torch.full((3,), background)
    return renderer.render(ball, origins, directions, times, background), ball


def test_a_ball_is_seen_where_it_is():
    image, _ = looked_at([[0.0, 0.0, 3.0], [0.0, 0.7, 3.0], [0.3, 0.0, 3.0]], 1.0)
    assert image.opacity.tolist() == pytest.approx([1, 0, 1], abs=0.01)
    assert image.depth[[0, 2]].tolist() == pytest.approx([2.6, 3 - math.sqrt(0.07)], abs=0.02)
    assert image.colour[0].tolist() == pytest.approx([1, 0, 0], abs=0.01)
    assert image.colour[1].tolist() == pytest.approx([1, 1, 1], abs=0.01)


def test_only_what_lies_in_the_cube_is_asked():
    image, ball = looked_at([[0.0, 0.3, 3.0], [0.0, 0.9, 3.0], [0.0, 1.4, 3.0]], 1.0)
    (points,) = ball.asked
    assert 0 < len(points) < len(image.samples)
    assert (points.abs() <= 1).all()
    assert len(image.weights) == len(points)
    assert image.opacity[2] == 0
    past, _ = looked_at([[0.0, 1.4, 3.0]], 0.25)
    assert past.colour.tolist() == [[0.25] * 3]


def test_losses_are_those_of_the_formulas():
    torch.manual_seed(0)
    colour, target = torch.rand(5, 3).double(), torch.rand(5, 3).double()
    mask = torch.tensor([1.0, 0, 1, 1, 0]).double()
    errors = np.abs(colour.numpy() - target.numpy())
    expected = errors[[0, 2, 3]].sum() / (3 + 1e-5)
    assert masked_colour_error(colour, target, mask).item() == pytest.approx(expected)

    opacity = torch.tensor([0.0, 0.2, 0.9, 1.0, 0.5]).double()
    likely = np.array([0.001, 1 - 0.2, 0.9, 0.999, 1 - 0.5])
    assert silhouette_error(opacity, mask).item() == pytest.approx(-np.log(likely).mean())

    slopes = torch.randn(5, 3).double()
    expected = ((np.linalg.norm(slopes.numpy(), axis=1) - 1) ** 2).sum() / 7
    assert eikonal_error(slopes, 7).item() == pytest.approx(expected)
    assert eikonal_error(slopes[:0], 0).item() == 0
    zero = torch.zeros(2, 3, requires_grad=True)
    eikonal_error(zero, 2).backward()
    assert zero.grad.isfinite().all()

    here, nearby, weights = torch.rand(6, 4).double(), torch.rand(6, 4).double(), torch.rand(6)
    gaps = ((here.numpy() - nearby.numpy()) ** 2).mean(axis=1)
    expected = (weights.double().numpy() * gaps).sum() / 3
    assert feature_change(here, nearby, weights, 3).item() == pytest.approx(expected)


def test_skip_network_lets_features_in_after_the_first_layer():
    torch.manual_seed(0)
    network = SkipNetwork(5, 4, 8, 2).double()
    values, features = torch.randn(3, 5).double(), torch.randn(3, 4).double()

    def soft(x):
        return torch.nn.functional.softplus(x, beta=100)

    first, second, third, last = ((la.weight, la.bias) for la in network.layers)
    hidden = soft(values @ first[0].T + first[1])
    hidden = torch.cat([hidden, features, values], dim=1) / math.sqrt(2)
    hidden = soft(soft(hidden @ second[0].T + second[1]) @ third[0].T + third[1])
    torch.testing.assert_close(network(values, features), hidden @ last[0].T + last[1])
