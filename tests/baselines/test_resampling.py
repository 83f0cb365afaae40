"""Placing samples by what earlier samples found, against loops."""

import itertools

import numpy as np
import pytest
import torch

from tests.baselines import oracles
from xplanes.baselines.proposal import Level, ProposalRenderer, dense_samples, histogram_loss
from xplanes.baselines.resampling import covering_weights, ray_weights, resample, uniform_edges
from xplanes.rendering.compositing import composite_reference


def bins(rays, count, seed=0):
    """Random ascending edges from 0 to 1, and weights, some of them 0."""
    generator = torch.Generator().manual_seed(seed)
    inner = torch.rand(rays, count - 1, generator=generator, dtype=torch.float64).sort(dim=1).values
    ends = torch.zeros(rays, 1).double(), torch.ones(rays, 1).double()
    mass = torch.rand(rays, count, generator=generator, dtype=torch.float64)
    mass[mass < 0.3] = 0
    return torch.cat([ends[0], inner, ends[1]], dim=1), mass / count


def test_resampling_equals_loops():
    for padding, jittered in itertools.product([0.01, 1e-6], [True, False]):
        edges, mass = bins(6, 9)
        uniform = torch.rand(6, 8, dtype=torch.float64) if jittered else None
        found = resample(edges, mass, 7, uniform, padding)
        moved = torch.full((6, 8), 0.5) if uniform is None else uniform
        places = (torch.arange(8) + moved) / 8
        for r in range(6):
            row = edges[r].numpy(), mass[r].numpy(), places[r].numpy()
            case = f"padding={padding}, jittered={jittered}"
            np.testing.assert_allclose(
                found[r], oracles.resample(*row, padding), atol=1e-9, err_msg=case
            )


def test_jittered_edges_keep_their_half_bins():
    plain = uniform_edges(3, 8, None, torch.device("cpu"))
    torch.testing.assert_close(plain[0], torch.linspace(0, 1, 9))
    low = uniform_edges(3, 8, torch.zeros(3, 9), torch.device("cpu"))
    high = uniform_edges(3, 8, torch.ones(3, 9), torch.device("cpu"))
    assert (low[0, 0], high[0, -1]) == (0, 1)
    torch.testing.assert_close(low[:, 1:], high[:, :-1])
    torch.testing.assert_close(high[0, 0], torch.tensor(1 / 16))


def test_covering_weights_equal_loops():
    fine, _ = bins(8, 12, seed=1)
    coarse, mass = bins(8, 7, seed=2)
    found = covering_weights(fine, coarse, mass)
    for r in range(8):
        expected = oracles.covering(fine[r].numpy(), coarse[r].numpy(), mass[r].numpy())
        np.testing.assert_allclose(found[r], expected, atol=1e-12)


def test_histogram_loss_equals_loops_and_pulls_at_the_density_fields_alone():
    fine, mass = bins(5, 12, seed=1)
    levels = [bins(5, count, seed=count) for count in (9, 6)]
    masses = [m.mul(0.2).requires_grad_() for _, m in levels]
    mass.requires_grad_()
    made = [Level(edges, m) for (edges, _), m in zip(levels, masses, strict=True)]
    loss = histogram_loss([*made, Level(fine, mass)])
    arrays = [(level.edges.numpy(), level.weights.detach().numpy()) for level in made]
    expected = oracles.histogram(fine.numpy(), mass.detach().numpy(), arrays)
    assert expected > 0
    assert loss.item() == pytest.approx(expected, rel=1e-12)
    loss.backward()
    assert mass.grad is None
    # More mass in the density fields can only help.
    assert all(m.grad.max() < 1e-12 and m.grad.min() < -1e-3 for m in masses)


def test_ray_weights_equal_loops_and_the_compositor():
    density, lengths = 9 * torch.rand(5, 12).double(), torch.rand(5, 12).double()
    depth = density * lengths
    found = ray_weights(depth)
    expected = oracles.weights(1 - np.exp(-depth.numpy()))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    samples = dense_samples(torch.zeros(60, 3), lengths)
    colour = torch.zeros(60, 3).double()
    args = (depth.flatten(), colour, samples.distances, samples.ray, samples.starts)
    torch.testing.assert_close(composite_reference(*args)[1], found.flatten())


def slab(points, times):
    """Opaque red between x = 0.2 and 0.4."""
    inside = (points[:, 0] > 0.2) & (points[:, 0] < 0.4)
    return torch.tensor([[1.0, 0.0, 0.0]]).expand(len(points), 3), 200.0 * inside


class Slab(torch.nn.Module):
    def forward(self, points, times):
        return slab(points, times)[1]


def test_a_surface_is_found_by_few_samples():
    fields = torch.nn.ModuleList([Slab(), Slab()])
    origins = torch.tensor([[-3.0, 0.0, 0.0], [-3.0, 5.0, 0.0]])
    directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(2, 3)
    for bounds in ({}, {"near": 1.0, "far": 5.0}):
        renderer = ProposalRenderer(fields, [64, 32], 16, **bounds)
        image = renderer.render(slab, origins, directions, torch.zeros(2), torch.ones(3))
        assert image.colour[0].tolist() == pytest.approx([1, 0, 0], abs=0.01)
        assert float(image.depth[0]) == pytest.approx(3.2, abs=0.05)
        assert len(image.samples) == 32
    # The second ray passes the cube by: nothing of it can be seen through the cube's bounds.
    outside = ProposalRenderer(fields, [64, 32], 16)
    image = outside.render(slab, origins, directions, torch.zeros(2), torch.ones(3))
    assert float(image.opacity[1]) == 0
