"""Ray hits, normals and insides of the solids against implicit functions written again."""

from itertools import product

import numpy as np
import torch

from tests.synthetic.rays import rays
from xplanes.synthetic.demo.geometry import Box, Capsule, Cylinder, Ellipsoid, Torus

SHAPES = [
    Box((0.5, 0.3, 0.7)),
    Box((0.6, 0.5, 0.01)),
    Ellipsoid((0.7, 0.4, 0.2)),
    Ellipsoid((0.05, 0.05, 0.05)),
    Cylinder(0.4, 0.6),
    Cylinder(0.9, 0.02),
    Capsule(0.2, 0.5),
    Capsule(0.3, 0.0),
    Torus(0.6, 0.2),
    Torus(0.9, 0.03),
    Torus(0.3, 0.29),
]


def implicit(shape, points):
    """Negative inside, in float64; close to the distance near the surface. [...]"""
    x, y, z = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
    match shape:
        case Box(half):
            return np.max(np.abs(np.stack([x, y, z], -1)) - np.array(half), axis=-1)
        case Ellipsoid((a, b, c)):
            return (np.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2) - 1) * min(a, b, c)
        case Cylinder(radius, half):
            return np.maximum(np.hypot(x, y) - radius, np.abs(z) - half)
        case Capsule(radius, half):
            return np.sqrt(x**2 + y**2 + np.maximum(np.abs(z) - half, 0) ** 2) - radius
        case Torus(ring, tube):
            return np.hypot(np.hypot(x, y) - ring, z) - tube
    raise AssertionError(shape)


def along(origins, directions, distance):
    return origins + distance[..., None] * directions


def test_hit_is_the_first_crossing():
    for shape, distance in product(SHAPES, (4.0, 0.1)):
        case = f"{shape} from {distance}"
        origins, directions = rays(400, distance=distance, spread=max(shape.extent))
        hit = shape.hit(origins, directions)
        found = hit.isfinite()
        assert (hit > 0).all(), case
        assert found.any(), case
        points = along(origins[found], directions[found], hit[found])
        assert np.abs(implicit(shape, points)).max() < 1e-9, case
        # No sample before the hit, or on a ray that misses, lies on the other side.
        steps = torch.linspace(0, 1, 1501, dtype=torch.float64)[None]
        travelled = steps * torch.where(found, hit, 6.0)[:, None]
        values = implicit(shape, along(origins[:, None], directions[:, None], travelled))
        starts_inside = implicit(shape, origins)[:, None] < 0
        # On the surface itself, and where a ray grazes it, rounding decides.
        assert (np.where(starts_inside, values, -values) < 1e-9).all(), case


def test_float32_hits_agree_with_float64():
    for shape in SHAPES:
        origins, directions = rays(2000, spread=max(shape.extent))
        exact = shape.hit(origins, directions)
        rough = shape.hit(origins.float(), directions.float())
        differ = exact.isfinite() != rough.isfinite()
        assert differ.float().mean() < 2e-3, shape
        both = exact.isfinite() & rough.isfinite()
        points = along(origins, directions, rough.double())[both]
        assert np.abs(implicit(shape, points)).max() < 2e-5, shape


def test_normal_is_the_gradient():
    for shape in SHAPES:
        origins, directions = rays(500, seed=1, spread=max(shape.extent))
        distance = shape.hit(origins, directions)
        found = distance.isfinite()
        points = along(origins, directions, distance)[found]
        normal, points = shape.normal(points).numpy(), points.numpy()
        steps = 1e-6 * np.eye(3)
        ends = [implicit(shape, points[:, None] + side * steps) for side in (1, -1)]
        slope = ends[0] - ends[1]
        slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
        assert np.allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-9), shape
        assert np.quantile(np.abs(slope - normal).max(axis=-1), 0.99) < 1e-4, shape
        assert ((normal * directions[found].numpy()).sum(-1) < 1e-6).all(), shape


def test_inside_extent_and_radius():
    for shape in SHAPES:
        torch.manual_seed(2)
        box = 1.2 * torch.tensor(shape.extent, dtype=torch.float64)
        points = (2 * torch.rand(20000, 3, dtype=torch.float64) - 1) * box
        value = implicit(shape, points)
        clear = np.abs(value) > 1e-9
        inside = shape.inside(points).numpy()
        assert (inside == (value < 0))[clear].all(), shape
        assert (points[inside].abs() <= torch.tensor(shape.extent)).all(), shape
        assert (points[inside].norm(dim=-1) <= shape.radius_around).all(), shape
        # The extent is tight: hit by rays along the axes.
        if not isinstance(shape, Torus):
            ends = shape.hit(torch.eye(3) * 3, -torch.eye(3))
            assert torch.allclose(3 - ends, torch.tensor(shape.extent), atol=1e-5), shape


def test_signed_distance_is_a_distance():
    for shape in SHAPES:
        if isinstance(shape, Ellipsoid):
            continue
        origins, directions = rays(3000, seed=3, spread=1.0)
        surface = along(origins, directions, shape.hit(origins, directions))
        surface = surface[surface.isfinite().all(dim=-1)]
        torch.manual_seed(4)
        points = torch.rand(200, 3, dtype=torch.float64) * 2 - 1
        distance = shape.signed_distance(points)
        nearest = torch.cdist(points, surface).amin(dim=-1)
        assert (distance.abs() <= nearest + 1e-9).all(), shape
