"""The compiled loops against the demo's classes in double precision."""

import numpy as np
import pytest
import torch

from xplanes.scenes.cameras import cast_rays
from xplanes.synthetic.demo.render import render_image
from xplanes.synthetic.demo.scenes import DEMO_SCENES, build_demo_scene
from xplanes.synthetic.pretraining.objects import (
    HELD_OUT_SEEDS,
    STREAM,
    TRAINING_SEEDS,
    procedural_object,
)
from xplanes.synthetic.pretraining.pool import FOCAL, camera, cast, inside, render_solids
from xplanes.synthetic.pretraining.solids import (
    BOX,
    BRICKS,
    CAPSULE,
    CHECKER,
    CYLINDER,
    ELLIPSOID,
    PLAIN,
    SECTORS,
    STRIPES,
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
NUMBERS = {
    PLAIN: (0.1, 0.3, 0.0, 0.0),
    STRIPES: (1.0, 0.13, 3.0, 0.0),
    CHECKER: (0.2, 0.15, 0.3, 2.0),
    BRICKS: (0.3, 0.12, 0.02, 0.0),
    SECTORS: (8.0, 2.0, 0.0, 0.0),
}


def one(kind, pattern=PLAIN, light=LIGHT):
    paints = [[[0.9, 0.3, 0.1], [0.2, 0.5, 0.8], [0.6, 0.9, 0.4]]]
    return Solids(
        np.array([kind]),
        np.array([SIZES[kind]]),
        np.eye(3)[None],
        np.zeros((1, 3)),
        np.array([pattern]),
        np.array(paints),
        np.array([NUMBERS[pattern]]),
        np.array(light),
    )


def rays(count, seed=0):
    random = np.random.default_rng(seed)
    origins = random.normal(size=(count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=-1, keepdims=True)
    directions = random.uniform(-0.9, 0.9, (count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def compare(solids, count, case, seed=0):
    origins, directions = rays(count, seed)
    distance, part, normal, colour = cast(solids, origins, directions)
    truth = solids.posed().cast(torch.from_numpy(origins), torch.from_numpy(directions))
    agree = part == truth.part.numpy()
    assert agree.mean() > 0.995, case  # silhouettes are decided by rounding
    hit = agree & (part >= 0)
    assert hit.any(), case
    assert np.abs(distance[hit] - truth.distance.numpy()[hit]).max() < 2e-4, case
    # Borders between cells, and between light and shadow, are decided by rounding too.
    assert np.quantile(np.abs(normal - truth.normal.numpy())[hit], 0.995) < 1e-2, case
    assert np.quantile(np.abs(colour - truth.colour.numpy())[hit], 0.98) < 1e-2, case


def test_rays_meet_each_solid_where_the_reference_says():
    for kind in SIZES:
        compare(one(kind), 2000, f"solid {kind}")


def test_whole_objects_with_shadows_agree():
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
    pose = camera(30, 25)
    colour, alpha, depth = render_solids(solids, pose, 48)
    truth = render_image(solids.posed(), torch.from_numpy(pose), 48).astype(np.float64) / 255
    on_white = truth[..., :3] * truth[..., 3:] + 1 - truth[..., 3:]
    assert np.abs(alpha - truth[..., 3]).mean() < 1e-3
    assert np.abs(colour - on_white).mean() < 4e-3
    line = torch.arange(48, dtype=torch.float64) - 0.25
    rows, columns = torch.meshgrid(line, line, indexing="ij")
    origins, directions = cast_rays(
        torch.from_numpy(pose),
        rows.flatten(),
        columns.flatten(),
        focal=48 * FOCAL,
        centre=(24.0, 24.0),
    )
    distance = cast(solids, origins.numpy().copy(), directions.numpy())[0]
    seen = np.isfinite(distance)
    assert (np.isfinite(depth.ravel()) == seen).mean() > 0.999
    both = seen & np.isfinite(depth.ravel())
    assert np.quantile(np.abs(depth.ravel()[both] - distance[both]), 0.99) < 1e-6


def test_objects_are_deterministic_and_differ_by_seed():
    first, again, other = (procedural_object(seed) for seed in (4, 4, 5))
    assert all((a == b).all() for a, b in zip(first.arrays, again.arrays, strict=True))
    assert len(first.kinds) != len(other.kinds) or (first.sizes != other.sizes).any()


def test_objects_stay_where_cameras_see_them():
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
