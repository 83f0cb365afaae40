"""TiNeuVox' field, renderer and optimiser against loops, and against what was published."""

import math

import numpy as np
import pytest
import torch

from tests.baselines import oracles
from xplanes.baselines.tineuvox.field import TiNeuVox
from xplanes.baselines.tineuvox.fixed_step import FixedStepRenderer
from xplanes.baselines.tineuvox.model import MaskedAdam, light_entropy, sample_colour_error

BOX = torch.tensor([[-2.0, -1.5, -1.0], [2.0, 1.0, 1.2]])


def field(resolution=8, channels=2, width=16, **options):
    torch.manual_seed(0)
    found = TiNeuVox(BOX, resolution, channels, width, **options)
    with torch.no_grad():
        found.grid.uniform_(-1, 1)
    return found


def inside(count):
    return BOX[0] + (BOX[1] - BOX[0]) * torch.rand(count, 3)


def test_grid_is_read_as_loops_read_it():
    made = field().double()
    points = inside(20).double()
    grid = made.grid[0].detach().numpy()
    filled = np.pad(grid, [(0, 0), *((0, -(size - 1) % 4) for size in grid.shape[1:])])
    expected = np.stack([oracles.trilinear(filled, BOX.numpy(), p) for p in points.numpy()])
    np.testing.assert_allclose(made.read(points).detach().numpy(), expected, atol=1e-12)
    assert (made.read(BOX[1:].double() + 1) == 0).all()


def test_growing_keeps_what_the_grid_shows_at_its_corners():
    made = field(halvings=2)
    before = made.grid.detach().clone()
    assert int(made.voxels) == 8**3 // 4
    made.resize(8**3)
    after = made.grid.detach()
    assert math.prod(after.shape[2:]) > 3 * math.prod(before.shape[2:])
    for x, y, z in np.ndindex(2, 2, 2):
        torch.testing.assert_close(after[0, :, -x, -y, -z], before[0, :, -x, -y, -z])


def test_initial_opacity_of_a_cell():
    for alpha in [1e-2, 1e-3]:
        made = field(alpha=alpha, unit=2.0)
        with torch.no_grad():
            made.density.weight.zero_()
            made.density.bias.zero_()
        density = made.geometry(torch.zeros(1, 3), torch.zeros(1))[0]
        # Published: 1 - exp(-softplus(shift)) over a full cell, half a cell is one step.
        assert 1 - math.exp(-density.item() * made.cell) == pytest.approx(alpha, rel=1e-4), alpha


def test_samples_lie_in_the_box_at_equal_steps():
    made = field()
    renderer = FixedStepRenderer(made, near=1.0, far=6.0, step=0.5, threshold=1e-4)
    origins = torch.tensor([[-4.0, 0.1, 0.0], [-4.0, 3.0, 0.0], [0.0, 0.0, 3.0]])
    directions = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    step = 0.5 * made.cell
    samples = renderer.place(origins, directions, made.bounds(), step)
    found = [samples.distances[samples.ray == r] for r in range(3)]
    assert len(found[1]) == 0
    for distances, begin, end in ((found[0], 2.0, 6.0), (found[2], 1.8, 4.0)):
        torch.testing.assert_close(distances.diff(), torch.full_like(distances[1:], step))
        assert float(distances[0]) == pytest.approx(begin, abs=step)
        assert float(distances[-1]) <= end < float(distances[-1]) + 2 * step


def test_rendering_equals_a_loop_over_samples():
    made = field(unit=1.0)
    with torch.no_grad():
        made.density.weight.mul_(30)
    renderer = FixedStepRenderer(made, near=0.5, far=6.0, step=0.5, threshold=1e-2)
    torch.manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(6, 3), dim=1)
    origins, times = -3 * directions, torch.rand(6)
    white = torch.ones(3)
    image = renderer.render(made, origins, directions, times, white)
    samples = image.samples
    density, features = made.geometry(samples.points, times[samples.ray])
    colours = made.colour(features, directions[samples.ray])
    kept = 0
    for r in range(6):
        light, colour = 1.0, np.zeros(3)
        for n in (samples.ray == r).nonzero()[:, 0].tolist():
            alpha = 1 - math.exp(-float(density[n].detach()) * 0.5 * made.cell)
            if alpha <= 1e-2:
                continue
            if light * alpha > 1e-2:
                colour += light * alpha * colours[n].detach().numpy()
                kept += 1
            light *= 1 - alpha
        np.testing.assert_allclose(image.colour[r].detach(), colour + light, atol=1e-5)
        assert float(image.opacity[r].detach()) == pytest.approx(1 - light, abs=1e-5)
    assert len(image.colours) == len(image.weights) == len(image.ray) == kept < len(samples)


def test_losses_are_those_of_the_formulas():
    light = np.array([1 - 1e-6, 0.7, 0.001, 1e-6])
    entropy = -(light * np.log(light) + (1 - light) * np.log(1 - light)).mean()
    opacity = torch.tensor([0.0, 0.3, 0.999, 1.0], dtype=torch.float64)
    assert light_entropy(opacity).item() == pytest.approx(entropy, rel=1e-9)

    colours, target = torch.rand(9, 3).double(), torch.rand(4, 3).double()
    weights, ray = torch.rand(9).double(), torch.tensor([0, 0, 1, 1, 1, 3, 3, 3, 3])
    gaps = ((colours.numpy() - target.numpy()[ray.numpy()]) ** 2).sum(axis=1)
    found = sample_colour_error(colours, target, weights, ray)
    assert found.item() == pytest.approx((weights.numpy() * gaps).sum() / 4, rel=1e-9)


@pytest.mark.parametrize("masked", [True, False])
def test_adam_is_that_of_the_paper_with_entries_without_gradients_left_out(masked):
    torch.manual_seed(0)
    parameter = torch.nn.Parameter(torch.randn(2, 5).double())
    optimizer = MaskedAdam([{"params": [parameter], "lr": 0.1, "masked": masked}])
    values, (first, second) = parameter.detach().numpy().copy(), np.zeros((2, 2, 5))
    for step in range(1, 6):
        parameter.grad = torch.randn(2, 5).double() * (torch.rand(2, 5) > 0.4)
        gradient = parameter.grad.numpy().copy()
        optimizer.step()
        size = 0.1 * math.sqrt(1 - 0.99**step) / (1 - 0.9**step)
        moved = (gradient != 0) | (not masked)
        first = np.where(moved, 0.9 * first + 0.1 * gradient, first)
        second = np.where(moved, 0.99 * second + 0.01 * gradient**2, second)
        values -= moved * size * first / (np.sqrt(second) + 1e-8)
        np.testing.assert_allclose(parameter.detach(), values, atol=1e-9)
