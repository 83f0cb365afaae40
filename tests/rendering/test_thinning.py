"""Samples that carry gradients for others: exact with none left out, right on average with some."""

import functools

import pytest
import torch

from xplanes.rendering.thinning import thinned

COUNT = 400


@functools.cache
def problem():
    """Colour and density of samples, their parameters, and gradients of very different sizes."""
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(COUNT, 3, generator=generator, dtype=torch.float64)
    weights = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64, requires_grad=True)
    bias = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    unused = torch.zeros(2, dtype=torch.float64, requires_grad=True)

    def shade(chosen):
        logits = features[chosen] * weights + bias
        return logits.sigmoid(), logits.sum(dim=1).exp()

    size = torch.rand(COUNT, 1, generator=generator, dtype=torch.float64) ** 6
    upstream = torch.randn(COUNT, 4, generator=generator, dtype=torch.float64) * size
    return shade, (weights, bias, unused), upstream


def gradients(thinning, seed, upstream=None):
    shade, parameters, _ = problem()
    found = thinned(shade, parameters, thinning, torch.Generator().manual_seed(seed))
    return gradients_of(*found, upstream)


def gradients_of(colour, density, upstream=None):
    _, parameters, given = problem()
    upstream = given if upstream is None else upstream
    loss = (colour * upstream[:, :3]).sum() + (density * upstream[:, 3]).sum()
    found = torch.autograd.grad(loss, parameters[:2])
    return torch.cat([found[0], found[1][None]])


def exact():
    shade, *_ = problem()
    return gradients_of(*shade(slice(None)))


def test_values_are_the_fields_and_gradients_are_exact_if_none_is_left_out():
    shade, parameters, _ = problem()
    found = thinned(shade, parameters, 1.0, torch.Generator())
    for ours, theirs in zip(found, shade(slice(None)), strict=True):
        assert torch.equal(ours, theirs)
    torch.testing.assert_close(gradients(0.0, 0), exact(), rtol=1e-12, atol=0)


@pytest.mark.parametrize("thinning", [0.3, 1.0])
def test_gradients_are_right_on_average_and_repeat(thinning):
    found = torch.stack([gradients(thinning, seed) for seed in range(400)])
    assert (found[0] != exact()).all()
    assert torch.equal(found[7], gradients(thinning, 7))
    error = (found.mean(dim=0) - exact()).abs()
    assert (error < 4 * found.std(dim=0) / 20).all()


def test_few_samples_are_asked_again():
    shade, parameters, upstream = problem()
    asked = []

    def counted(chosen):
        asked.append(COUNT if isinstance(chosen, slice) else len(chosen))
        return shade(chosen)

    colour, density = thinned(counted, parameters, 1.0, torch.Generator().manual_seed(0))
    ((colour * upstream[:, :3]).sum() + (density * upstream[:, 3]).sum()).backward()
    assert asked[0] == COUNT
    assert 0.1 * COUNT < asked[1] < 0.6 * COUNT
    assert parameters[2].grad is None


def test_a_constant_colour_needs_no_gradient():
    level = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)

    def fog(chosen):
        places = torch.zeros(COUNT, 3, dtype=torch.float64)[chosen]
        return places, level.expand(len(places))

    _, density = thinned(fog, [level], 0.0, torch.Generator())
    density.sum().backward()
    assert float(level.grad) == COUNT


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_not_hidden(value):
    upstream = problem()[2].clone()
    upstream[5, 3] = value
    assert not gradients(1.0, 0, upstream).isfinite().all()
