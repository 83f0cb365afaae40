"""Rays against the cube, degenerate ones included."""

import itertools
import math

import numpy as np
import pytest
import torch

from tests.oracles import ray_box as oracle
from xplanes.rendering.box import ray_box

NAN, INF = math.nan, math.inf

TURNS = list(
    itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3))
)
"""Orders and signs of axes."""


def one(origin, direction, **options):
    near, far = ray_box(
        torch.tensor([origin], dtype=torch.float64),
        torch.tensor([direction], dtype=torch.float64),
        **options,
    )
    return float(near), float(far)


def test_known_rays_whichever_way_they_are_turned():
    for origin, direction, expected in [
        ((0, 0, 4), (0, 0, -1), (3, 5)),
        ((0, 0, 4), (0, 0, 1), (0, 0)),  # points away
        ((0, 0, 0), (0, 0, 1), (0, 1)),  # from inside
        ((0.5, 0, 0), (-1, 0, 0), (0, 1.5)),
        ((1, 0, 0), (-1, 0, 0), (0, 2)),  # on a face, going in
        ((1, 0, 0), (1, 0, 0), (0, 0)),  # on a face, going out
        ((1, 0, -3), (0, 0, 1), (2, 4)),  # along a face
        ((1, -1, -3), (0, 0, 1), (2, 4)),  # along an edge
        ((1.0001, 0, -3), (0, 0, 1), (0, 0)),  # just beside a face
        ((1, 1, 1), (-1, -1, -1), (0, 2)),  # from a corner through the middle
        ((1, 1, 1), (1, 1, 1), (0, 0)),
        ((2, 0, 0), (-1, 1, 0), (0, 0)),  # touches an edge in one point
        ((0, 0, 0), (0, 0, 0), (0, 0)),  # no direction, inside
        ((1, 1, 1), (0, 0, 0), (0, 0)),  # on a corner
        ((3, 0, 0), (0, 0, 0), (0, 0)),  # outside
        ((0, 0, 4), (0, 0, -2), (1.5, 2.5)),  # distances in units of the direction
        ((0, 0, 4), (-0.0, -0.0, -1), (3, 5)),
        ((1, 0, -3), (-0.0, 0, 1), (2, 4)),
    ]:
        for order, signs in TURNS:
            turned = [
                [s * v[i] for i, s in zip(order, signs, strict=True)] for v in (origin, direction)
            ]
            assert one(*turned) == pytest.approx(expected), f"from {turned[0]} to {turned[1]}"


@pytest.mark.parametrize("bad", [NAN, INF, -INF, 3e38, -3e38])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rays_with_impossible_numbers_miss(bad, dtype):
    origin = torch.tensor([[0.1, 0.2, 4.0]], dtype=dtype)
    direction = torch.tensor([[0.0, 0.0, -1.0]], dtype=dtype)
    for axis in range(3):
        wrong = torch.tensor([axis]), bad
        from_afar = ray_box(origin.index_fill(1, *wrong), direction)
        askew = ray_box(origin, direction.index_fill(1, *wrong))
        assert all(end.isfinite().all() for end in (*from_afar, *askew))
        assert from_afar == (0, 0) or abs(bad) == 3e38
        assert askew == (0, 0) or not math.isnan(bad)


def test_nearly_parallel_rays_are_like_parallel_ones():
    for tiny in [1e-45, 1e-38, 1e-20, 1e-8]:
        for x, hits in ((0.5, True), (1.5, False)):
            origin = torch.tensor([[x, 0.0, 4.0]])
            near, far = ray_box(origin, torch.tensor([[tiny, -tiny, -1.0]]))
            assert (float(near), float(far)) == ((3, 5) if hits else (0, 0)), (tiny, x)


def test_random_rays_equal_the_loops_of_the_oracle():
    generator = np.random.default_rng(0)
    origins = generator.uniform(-2, 2, (500, 3))
    directions = generator.normal(size=(500, 3))
    # Axis-parallel rays and origins on faces among them.
    directions[::5, 0] = 0
    directions[::10, 1] = 0
    origins[::7, 2] = generator.choice([-1, 1], len(origins[::7]))
    near, far = ray_box(torch.from_numpy(origins), torch.from_numpy(directions))
    expected = np.array([oracle(o, d) for o, d in zip(origins, directions, strict=True)])
    np.testing.assert_allclose(np.stack([near, far], axis=-1), expected, atol=1e-9)
    assert 0.2 < (expected[:, 1] > 0).mean() < 0.95
