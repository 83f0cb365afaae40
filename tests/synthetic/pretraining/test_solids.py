"""The compiled loops against the demo's classes in double precision."""

import numpy as np
import pytest
import torch

from tests.synthetic.rays import rays
from xplanes.scenes.cameras import cast_rays
from xplanes.synthetic.demo.render import camera_at, render_image
from xplanes.synthetic.demo.scenes import DEMO_SCENES, build_demo_scene
from xplanes.synthetic.pretraining.objects import (
    HELD_OUT_SEEDS,
    STREAM,
    TRAINING_SEEDS,
    procedural_object,
)
from xplanes.synthetic.pretraining.pool import FOCAL, cast, inside, render_solids
from xplanes.synthetic.pretraining.solids import (
    BOX,
    CAPSULE,
    CYLINDER,
    ELLIPSOID,
    PLAIN,
    TORUS,
    Solids,
)

LIGHT = [0.35, -0.5, 0.8, 0.5, 0.22, 0.38, 0.6]

SIZES = {
    BOX: (0.5, 0.3, 0.7),
    ELLIPSOID: (0.7, 0.4, 0.2),
    CYLINDER: (0.4, 0.6, 1.0),
    CAPSULE: (0.2, 0.5, 1.0),
    TORUS: (0.6, 0.2, 1.0),
}


def one(kind, light=LIGHT):
    paints = [[[0.9, 0.3, 0.1], [0.2, 0.5, 0.8], [0.6, 0.9, 0.4]]]
    numbers = np.array([[0.1, 0.3, 0.0, 0.0]])
    place = (np.eye(3)[None], np.zeros((1, 3)))
    kinds, sizes, patterns = np.array([kind]), np.array([SIZES[kind]]), np.array([PLAIN])
    return Solids(kinds, sizes, *place, patterns, np.array(paints), numbers, np.array(light))


def compare(solids, count, case, seed=0):
    origins, directions = rays(count, seed, distance=3.0, spread=0.9)
    distance, part, normal, colour = cast(solids, origins.numpy(), directions.numpy())
    truth = solids.posed().cast(origins, directions)
    agree = part == truth.part.numpy()
    assert agree.mean() > 0.995, case  # silhouettes are decided by rounding
    hit = agree & (part >= 0)
    assert hit.any(), case
    assert np.abs(distance[hit] - truth.distance.numpy()[hit]).max() < 2e-4, case
    # Borders between cells, and between light and shadow, are decided by rounding too.
    assert np.quantile(np.abs(normal - truth.normal.numpy())[hit], 0.995) < 1e-2, case
    assert np.quantile(np.abs(colour - truth.colour.numpy())[hit], 0.98) < 1e-2, case


def test_rays_meet_solids_and_whole_objects_with_shadows_where_the_reference_says():
    for kind in SIZES:
        compare(one(kind), 2000, f"solid {kind}")
    for seed in (0, 3, 11, HELD_OUT_SEEDS[2]):
        compare(procedural_object(seed), 1500, f"seed {seed}", seed)


def test_occupancy_agrees():
    for seed in (1, 7, HELD_OUT_SEEDS[0]):
        solids = procedural_object(seed)
        points = np.random.default_rng(seed).uniform(-1.3, 1.3, (20000, 3))
        truth = solids.posed().inside(torch.from_numpy(points)).numpy()
        assert truth.any(), seed
        assert (inside(solids, points) == truth).all(), seed


def test_images_agree_with_the_demo_renderer():
    solids = procedural_object(5)
    pose = camera_at(30, 25).numpy()
    colour, alpha, depth = render_solids(solids, pose, 48)
    truth = render_image(solids.posed(), torch.from_numpy(pose), 48).astype(np.float64) / 255
    on_white = truth[..., :3] * truth[..., 3:] + 1 - truth[..., 3:]
    assert np.abs(alpha - truth[..., 3]).mean() < 1e-3
    assert np.abs(colour - on_white).mean() < 4e-3
    line = torch.arange(48, dtype=torch.float64) - 0.25
    pixels = torch.cartesian_prod(line, line).T
    camera_rays = {"focal": 48 * FOCAL, "centre": (24.0, 24.0)}
    origins, directions = cast_rays(torch.from_numpy(pose), *pixels, **camera_rays)
    distance = cast(solids, origins.numpy().copy(), directions.numpy())[0]
    seen = np.isfinite(distance)
    assert (np.isfinite(depth.ravel()) == seen).mean() > 0.999
    both = seen & np.isfinite(depth.ravel())
    assert np.quantile(np.abs(depth.ravel()[both] - distance[both]), 0.99) < 1e-6


def test_objects_depend_on_their_seed_and_stay_where_cameras_see_them():
    first, again, other = (procedural_object(seed) for seed in (4, 4, 5))
    assert all((a == b).all() for a, b in zip(first.arrays, again.arrays, strict=True))
    assert len(first.kinds) != len(other.kinds) or (first.sizes != other.sizes).any()
    for seed in range(40):
        low, high = procedural_object(seed).bounds()
        assert (0.5 * (high - low)).max() < 1.11
        assert max(np.abs(low).max(), np.abs(high).max()) < 1.2


def test_training_held_out_and_demo_objects_are_distinct():
    assert not set(TRAINING_SEEDS[:10]) & set(HELD_OUT_SEEDS[:10])
    assert TRAINING_SEEDS.stop <= HELD_OUT_SEEDS.start
    for seed in (-1, HELD_OUT_SEEDS.stop):
        with pytest.raises(ValueError, match=f"seed={seed}"):
            procedural_object(seed)
    # No part of a demo scene, in any colours, has the size of any part of these.
    demo = {
        tuple(round(value, 6) for value in part.shape.extent)
        for name in DEMO_SCENES
        for part in build_demo_scene(name, STREAM).parts
    }
    for seed in (*range(60), *HELD_OUT_SEEDS[:60]):
        extents = procedural_object(seed).extents
        assert not demo & {tuple(round(float(v), 6) for v in e) for e in extents}
