"""Thinned gradients against the whole ones."""

from dataclasses import replace

import torch

from tests.rendering.test_renderer import WHITE, rays_of, renderer_of
from xplanes.fields import Decoder, XPlanes
from xplanes.fields.xplanes import random_planes


def field_of(seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    planes = random_planes(
        "six",
        channels=4,
        resolution=8,
        time_resolution=3,
        space_scale=1.0,
        time_scale=1.0,
        generator=generator,
    )
    torch.manual_seed(seed)
    field = XPlanes(planes=planes, decoder=Decoder(4, width=16, hidden=2, density_scale=8.0))
    with torch.no_grad():
        # Thin air and solid things, as in a trained field.
        field.decoder.layers[-1].weight[0] *= 40
    return field.to(dtype)


def backward(field, thinning, draw=0, rays=None, colour=None):
    """Gradients of all parameters, number of samples, and of those passed on."""
    renderer = replace(renderer_of(48, occlusion=0.0), thinning=thinning)
    origins, directions, times = rays_of(40) if rays is None else rays
    field.zero_grad()
    seen = renderer.render(field, origins, directions, times, WHITE.to(origins.dtype))
    wanted = torch.tensor([0.3, 0.6, 0.1]) if colour is None else colour
    (seen.colour - wanted).square().sum().backward()
    passed = len(seen.samples)
    if seen.cut is not None:
        assert all(p.grad is None for p in field.parameters())
        passed = seen.cut.pass_on(torch.Generator().manual_seed(draw))
    return [p.grad.clone() for p in field.parameters()], len(seen.samples), passed


def test_without_a_level_all_gradients_arrive_in_full():
    field = field_of()
    whole, samples, _ = backward(field, 0.0)
    same, _, passed = backward(field, 1e-300)
    assert passed == samples
    for own, other in zip(same, whole, strict=True):
        torch.testing.assert_close(own, other, atol=1e-12, rtol=1e-12)


def test_gradients_are_right_on_average_and_come_from_few_samples():
    for thinning in [0.5, 2.0, 8.0]:
        field, draws = field_of(), 150
        whole, samples, _ = backward(field, 0.0)
        total, squares, passed = [0.0] * len(whole), [0.0] * len(whole), 0
        for draw in range(draws):
            gradients, _, count = backward(field, thinning, draw)
            passed += count
            total = [t + g for t, g in zip(total, gradients, strict=True)]
            squares = [s + g**2 for s, g in zip(squares, gradients, strict=True)]
        assert passed / draws < min(0.8, 1.02 / thinning) * samples, thinning
        for t, s, own in zip(total, squares, whole, strict=True):
            mean = t / draws
            error = ((s / draws - mean**2).clamp_min(0) / draws).sqrt()
            distance = (mean - own).abs()
            # A wrong factor or a wrong probability is off by tens of standard errors.
            assert bool((distance <= 5.5 * error + 1e-3 * own.abs().max()).all()), thinning
            assert float((mean - own).norm() / own.norm()) < 0.2, thinning


def test_it_takes_the_same_samples_for_the_same_numbers():
    field = field_of()
    first, *_, count = backward(field, 2.0, draw=1)
    again, *_, same = backward(field, 2.0, draw=1)
    other, *_ = backward(field, 2.0, draw=2)
    assert count == same
    assert all(map(torch.equal, first, again))
    assert not all(map(torch.equal, first, other))


def test_images_do_not_depend_on_it():
    field, rays = field_of(), rays_of(40)
    plain = renderer_of(48)
    seen, thin = (r.render(field, *rays, WHITE) for r in (plain, replace(plain, thinning=2.0)))
    for name in ("colour", "opacity", "depth", "density"):
        assert torch.equal(getattr(seen, name), getattr(thin, name))
    with torch.no_grad():
        assert replace(plain, thinning=2.0).render(field, *rays, WHITE).cut is None


def test_what_is_not_finite_reaches_the_parameters():
    for value in [float("nan"), float("inf")]:
        field = field_of()
        gradients, *_ = backward(field, 2.0, colour=torch.tensor([value, 0.5, 0.5]))
        assert any(not bool(g.isfinite().all()) for g in gradients), value


def test_rays_that_meet_nothing_give_zero_gradients():
    field = field_of()
    origins, directions, times = rays_of(5)
    gradients, samples, passed = backward(field, 2.0, rays=(origins, -directions, times))
    assert samples == passed == 0
    assert not any(bool(g.any()) for g in gradients)


def test_no_gradient_passes_nothing_on():
    field = field_of()
    renderer = replace(renderer_of(48), thinning=2.0)
    seen = renderer.render(field, *rays_of(4), WHITE)
    assert seen.cut is not None
    assert seen.cut.pass_on(torch.Generator()) == 0
    assert all(p.grad is None for p in field.parameters())


def test_a_field_that_gives_its_own_parameters_is_not_counted_twice():
    own = torch.rand(3, dtype=torch.float64).requires_grad_()
    level = torch.tensor(1.0, dtype=torch.float64)

    def field(points, times):
        return own.expand(len(points), 3), level.expand(len(points))

    def gradient(thinning):
        own.grad = None
        renderer = replace(renderer_of(16), thinning=thinning)
        seen = renderer.render(field, *rays_of(6), WHITE)
        seen.colour.sum().backward()
        if seen.cut is not None:
            seen.cut.pass_on(torch.Generator().manual_seed(0))
        return own.grad

    torch.testing.assert_close(gradient(1e-300), gradient(0.0))


def test_a_view_dependent_field_gets_its_directions():
    class Glossy(torch.nn.Module):
        view_dependent = True

        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.eye(3, dtype=torch.float64))

        def forward(self, points, times, directions):
            density = (points * self.weight.diagonal()).sum(dim=1).exp()
            return (directions @ self.weight).sigmoid(), density

    field = Glossy()
    whole, *_ = backward(field, 0.0)
    thin, *_ = backward(field, 1e-300)
    torch.testing.assert_close(thin, whole)
