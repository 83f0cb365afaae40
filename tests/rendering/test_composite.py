"""Compositing: values and gradients against Beer and Lambert, at every density."""

import functools
import math

import numpy as np
import pytest
import torch

from tests.oracles import composite as oracle
from tests.oracles import composite_gradient
from xplanes.rendering.compositing import (
    composite,
    composite_gpu,
    composite_reference,
    depth_before,
    distortion,
    sample_weights,
)

try:
    import triton
except ImportError:
    triton = None


def kernels(depth, colour, distances, ray, starts, number=None):
    """The Triton kernels: on a GPU if there is one, else in triton's interpreter."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    given = (depth, colour, distances, starts, number)
    given = (None if tensor is None else tensor.to(device) for tensor in given)
    return tuple(found.cpu() for found in composite_gpu(*given))


PLAIN = (composite, composite_reference)
of_each = pytest.mark.parametrize("merge", [*PLAIN, *([kernels] if triton else [])])
FLOATS = (torch.float32, torch.float64)
COUNTS = (0, 3, 1, 0, 0, 7, 12, 0)
"""Samples of each ray: none at the ends and in the middle."""


def rays_of(counts=COUNTS, dtype=torch.float64, seed=0, scale=1.0):
    generator = torch.Generator().manual_seed(seed)
    number = torch.tensor(counts, dtype=torch.long)
    ray = torch.repeat_interleave(torch.arange(len(counts)), number)
    starts = number.cumsum(0) - number
    depth = torch.rand(len(ray), generator=generator, dtype=torch.float64) * scale
    colour = torch.rand(len(ray), 3, generator=generator, dtype=torch.float64)
    distances = 2 + torch.rand(len(ray), generator=generator, dtype=torch.float64).cumsum(0)
    return depth.to(dtype), colour.to(dtype), distances.to(dtype), ray, starts


def expected_of(depth, colour, distances, ray, starts):
    arrays = (t.double().numpy() for t in (depth, colour, distances))
    return oracle(*arrays, ray.tolist(), len(starts))


def spread(depth, colour, distances, ray, starts, end, step):
    total, _ = composite(depth, colour, distances, ray, starts)
    ends = torch.full((len(starts),), end, dtype=depth.dtype)
    weights = sample_weights(depth, ray, starts)
    return distortion(weights, distances, ray, starts, total, ends, step)


def test_distortion_is_the_mean_distance_of_two_photons():
    depth, *rest = given = rays_of(scale=2.0)
    _, distances, ray, starts = rest
    weights = composite_reference(*given)[1]
    wanted = 0.0
    for number in range(len(starts)):
        mine = ray == number
        places = torch.cat([distances[mine], torch.tensor([20.0])])
        shares = torch.cat([weights[mine], 1 - weights[mine].sum()[None]])
        pairs = shares[:, None] * shares * (places[:, None] - places).abs()
        wanted += float(pairs.sum() + weights[mine].square().sum() * 0.3 / 3) / len(starts)
    assert float(spread(*given, 20.0, 0.3)) == pytest.approx(wanted, rel=1e-12)
    single = [value.float() if value.is_floating_point() else value for value in given]
    assert float(spread(*single, 20.0, 0.3)) == pytest.approx(wanted, rel=1e-6)
    assert torch.autograd.gradcheck(
        lambda depth: spread(depth, *rest, 20.0, 0.3), depth.requires_grad_()
    )


def test_rays_that_end_at_one_surface_or_at_none_have_no_distortion():
    ray, starts = torch.tensor([0, 0, 0, 1]), torch.tensor([0, 3, 4])
    depth, distances = torch.tensor([0.0, 1e3, 5.0, 0.0]), torch.tensor([1.0, 2.0, 3.0, 1.0])
    assert spread(depth, torch.rand(4, 3), distances, ray, starts, 4.0, 1e-9) < 1e-6
    nothing, none = torch.empty(0), ray[:0]
    assert spread(nothing, torch.empty(0, 3), nothing, none, none, 4.0, 0.1) == 0


@of_each
@pytest.mark.parametrize("scale", [0.0, 1e-8, 1e-3, 1.0, 30.0])
@pytest.mark.parametrize("dtype", FLOATS)
def test_values_equal_the_loops_of_the_oracle(merge, dtype, scale):
    inputs = rays_of(dtype=dtype, scale=scale)
    total, weights = merge(*inputs)
    expected, expected_weights = expected_of(*inputs)
    rounding = 1e-6 if dtype == torch.float32 else 1e-7
    np.testing.assert_allclose(total, expected, atol=1e-30, rtol=rounding)
    if scale != 1e-8:  # 1 - exp(-x) loses digits in the oracle, not in the code
        np.testing.assert_allclose(weights, expected_weights, atol=1e-7, rtol=rounding)
    assert total.dtype == weights.dtype == dtype


@of_each
@pytest.mark.parametrize("scale", [1e-3, 1.0, 20.0])
def test_gradients_follow_the_product_rule(merge, scale):
    inputs = rays_of(scale=scale)
    ours = values_and_gradients(merge, *inputs)[2:]
    arrays = (tensor.numpy() for tensor in inputs[:3])
    ray, starts = inputs[3:]
    theirs = composite_gradient(
        *arrays, ray.tolist(), len(starts), upstream_of(len(starts)).numpy()
    )
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-10)


@of_each
def test_thick_media_keep_their_digits_in_the_gradient(merge):
    depth = torch.tensor([20.0], requires_grad=True)
    nothing = torch.zeros(1, dtype=torch.long)
    total, _ = merge(depth, torch.ones(1, 3), torch.ones(1), nothing, nothing)
    total[0, 3].backward()
    assert float(depth.grad) == pytest.approx(math.exp(-20), rel=1e-5)


def upstream_of(rays, dtype=torch.float64):
    return torch.linspace(-1, 1.3, 5 * rays, dtype=dtype).view(rays, 5)


def values_and_gradients(merge, depth, colour, *rest):
    """Sums, weights, and gradients of depths and colours."""
    leaves = [tensor.clone().requires_grad_() for tensor in (depth, colour)]
    total, weights = merge(*leaves, *rest)
    gradients = torch.autograd.grad((total * upstream_of(len(total), total.dtype)).sum(), leaves)
    return [found.detach() for found in (total, weights, *gradients)]


agree = functools.partial(torch.testing.assert_close, check_dtype=False, equal_nan=True)


def doubled(inputs):
    return [t.double() if t.is_floating_point() else t for t in inputs]


DENSITIES = [0.0, 1e-30, 1e-8, 1e-3, 1.0, 30.0, 79.9, 80.1, 1e3, 1e8, 3e38, math.inf]
DENSITIES += [-1e-9, -1.0, -math.inf]


def at_every_density(dtype):
    """Rays of four samples, the second of which has one of the densities."""
    depth, *rest = rays_of((4,) * len(DENSITIES), dtype)
    depth.view(-1, 4)[:, 1] = torch.tensor(DENSITIES, dtype=dtype)
    return depth, *rest


EVERY_DENSITY = [(composite, dtype, 1e-5) for dtype in FLOATS]
EVERY_DENSITY += [(kernels, torch.float32, 1e-6)] if triton else []


@pytest.mark.parametrize(("merge", "dtype", "most"), EVERY_DENSITY)
def test_loops_and_kernels_agree_with_the_twin_at_every_density(merge, dtype, most):
    given = at_every_density(dtype)
    found = values_and_gradients(merge, *given)
    expected = values_and_gradients(composite_reference, *doubled(given))
    assert all(part.isfinite().all() for part in found)
    agree(found, expected, atol=most, rtol=most)


@of_each
def test_a_nan_stays_on_its_ray(merge):
    depth, *rest = rays_of()
    ray, starts = rest[2:]
    clean, _ = merge(depth, *rest)
    broken = int(ray[5])
    wrong = depth.index_fill(0, torch.tensor(5), math.nan)
    total, _ = merge(wrong, *rest)
    assert total[broken].isnan().all()
    others = torch.arange(len(starts)) != broken
    agree(total[others], clean[others], atol=1e-14, rtol=0)
    weights, sound = (sample_weights(part, ray, starts) for part in (wrong, depth))
    agree(weights[ray != broken], sound[ray != broken], atol=1e-14, rtol=0)


@of_each
def test_no_rays_and_rays_without_samples_see_nothing(merge):
    total, weights, gradient, _ = values_and_gradients(merge, *rays_of((0, 0, 0)))
    assert torch.equal(total, torch.zeros(3, 5).double())
    assert weights.shape == gradient.shape == (0,)
    total, weights = merge(*rays_of(()))
    assert (total.shape, weights.shape) == ((0, 5), (0,))


@of_each
def test_weights_carry_no_gradient(merge):
    depth, *rest = rays_of()
    _, weights = merge(depth.requires_grad_(), *rest)
    assert not weights.requires_grad


def test_only_what_asks_gets_a_gradient():
    depth, colour, *rest = rays_of()
    composite(depth, colour.requires_grad_(), *rest)[0].sum().backward()
    assert colour.grad.abs().max() > 0
    assert depth.grad is None


def test_running_depths_keep_their_digits_behind_opaque_rays():
    counts = (3,) * 5000
    _, _, _, ray, starts = rays_of(counts)
    depth = torch.tensor([80.0, 80.0, 1e-3]).double().repeat(5000)
    depth[-3:] = torch.tensor([0.1, 0.2, 0.3])
    before = depth_before(depth, ray, starts)
    assert before[-3:].tolist() == pytest.approx([0, 0.1, 0.3], abs=1e-8)


# Kernels alone


needs_triton = pytest.mark.skipif(triton is None, reason="triton is not installed")

LENGTHS = (1000, 0, 1, 31, 32, 33, 64, 65, 0)
"""Samples of rays of one, and of many blocks, whole ones and not."""


@needs_triton
@pytest.mark.parametrize("scale", [0.01, 0.3])
def test_sums_in_float32_keep_their_digits_on_long_rays(scale):
    inputs = rays_of(LENGTHS, torch.float32, scale=scale)
    exact = values_and_gradients(composite_reference, *doubled(inputs))
    ours, twins = (values_and_gradients(f, *inputs) for f in (kernels, composite_reference))
    for found, twin, truth in zip(ours, twins, exact, strict=True):
        errors = [float((t - truth).abs().max() / truth.abs().max()) for t in (found, twin)]
        assert errors[0] < max(1e-6, 2 * errors[1])


@needs_triton
def test_faint_gradients_keep_their_digits_too():
    """An optimiser scales them up: what is left of much light less much light would be noise."""
    depth, *rest = rays_of((70,), torch.float32)
    depth[::10] = 7.0
    found = values_and_gradients(kernels, depth, *rest)[2]
    exact = values_and_gradients(composite_reference, *doubled((depth, *rest)))[2]
    assert exact.abs().min() < 1e-15
    agree(found, exact, atol=1e-28, rtol=1e-3)


@needs_triton
@pytest.mark.parametrize("last", [0, 2])
def test_places_without_a_sample_change_nothing_and_get_nothing(last):
    depth, colour, distances, ray, starts = filled = rays_of((*COUNTS[:-1], last))
    given = len(ray)
    more = 50 - given
    padded = (
        torch.cat([depth, torch.zeros(more)]),
        torch.cat([colour, torch.rand(more, 3)]),
        torch.cat([distances, torch.zeros(more)]),
        torch.cat([ray, torch.full((more,), len(starts) - 1)]),
        starts,
    )
    expected = values_and_gradients(composite_reference, *filled)
    some = functools.partial(kernels, number=torch.tensor(given))
    for merge in (some, composite_reference):
        found = values_and_gradients(merge, *padded)
        kept = [found[0], *(part[:given] for part in found[1:])]
        agree(kept, expected, atol=1e-12, rtol=0)
        assert not any(part[given:].any() for part in (found[1], found[3]))
    assert not values_and_gradients(some, *padded)[2][given:].any()
