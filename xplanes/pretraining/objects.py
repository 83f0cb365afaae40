"""Endless objects, one for each seed."""

import math

import numpy as np

from xplanes.pretraining.builder import Builder, place
from xplanes.pretraining.families import FAMILIES, SHARES, heap, lump, plant
from xplanes.pretraining.solids import BOX, CYLINDER, TORUS, Array, Solids

TRAINING_SEEDS = range(2**30)
"""Seeds of objects to learn from."""

HELD_OUT_SEEDS = range(2**30, 2**31)
"""Seeds of objects to be judged by."""

STREAM = 70_203
"""Keeps these objects apart from all else that is drawn from small seeds."""


def procedural_object(seed: int) -> Solids:
    """The object of a seed: near the origin, within about 1.2 of it along each axis, z up.

    Args:
        seed: One of `TRAINING_SEEDS` or `HELD_OUT_SEEDS`.

    Raises:
        ValueError: If it is neither.
    """
    if seed not in TRAINING_SEEDS and seed not in HELD_OUT_SEEDS:
        raise ValueError(f"seed={seed}: objects have seeds from 0 to {HELD_OUT_SEEDS.stop - 1}")
    b = Builder(np.random.default_rng([STREAM, seed]))
    ground = _ground(b) if b.chance(0.75) else 0.0
    main = FAMILIES[int(b.random.choice(len(FAMILIES), p=SHARES))]
    spot = (b.uniform(-0.2, 0.2), b.uniform(-0.2, 0.2), 0.0)
    main(b, place(spot, (0, 0, b.uniform(0, 360)), b.uniform(0.7, 1.1)))
    for _ in range(b.count(0, 4) if ground else b.count(0, 1)):
        _prop(b, max(ground, 0.6))
    return _framed(b, b.solids(_light(b)))


def _ground(b: Builder) -> float:
    """A plate under everything; returns how far it reaches."""
    reach, thick = b.uniform(0.5, 1.0), b.uniform(0.015, 0.08)
    at = place((0, 0, -thick), (0, 0, b.uniform(0, 90)))
    if b.chance(0.5):
        b.add(at, BOX, (reach, reach * b.uniform(0.6, 1), thick), b.pattern(0.4, 0.5))
    else:
        b.add(at, CYLINDER, (reach, thick), b.pattern(0.4, 0.5))
        if b.chance(0.3):
            b.add(at, TORUS, (reach, b.uniform(0.02, 0.05)), b.plain())
    if b.chance(0.3):
        patch = place((0, 0, 0), (0, 0, b.uniform(0, 90)))
        b.add(patch, BOX, (0.6 * reach, b.uniform(0.2, 0.6) * reach, 0.01), b.pattern(0.3, 0.4))
    return reach


def _prop(b: Builder, reach: float) -> None:
    """Something small beside the main thing."""
    angle, far = b.uniform(0, 2 * math.pi), reach * b.uniform(0.5, 0.9)
    spot = (far * math.cos(angle), far * math.sin(angle), 0.0)
    kind = b.count(0, 4)
    if kind < 2:
        size = b.uniform(0.05, 0.25)
        lump(b, place((spot[0], spot[1], 0.7 * size)), size, kind == 0)
    elif kind == 2:
        plant(b, place(spot, (0, 0, b.uniform(0, 360)), b.uniform(0.3, 0.7)))
    elif kind == 3:
        heap(b, place(spot, scale=b.uniform(0.1, 0.35)))
    else:
        size = (b.uniform(0.03, 0.3), b.uniform(0.03, 0.3), b.uniform(0.03, 0.3))
        b.add(
            place((spot[0], spot[1], size[2]), (0, 0, b.uniform(0, 90))), BOX, size, b.pattern(0.2)
        )


def _light(b: Builder) -> Array:
    """A sun from above and light of about the strength of the demo scenes'."""
    turn, rise = b.uniform(0, 2 * math.pi), math.radians(b.uniform(35, 75))
    towards = (math.cos(turn) * math.cos(rise), math.sin(turn) * math.cos(rise), math.sin(rise))
    sun, sky, ambient = b.uniform(0.4, 0.6), b.uniform(0.15, 0.28), b.uniform(0.32, 0.45)
    return np.array([*towards, sun, sky, ambient, b.uniform(0.4, 0.7)])


def _framed(b: Builder, solids: Solids) -> Solids:
    """Brought to the middle, and to a size that such cameras see whole."""
    low, high = solids.bounds()
    half = 0.5 * (high - low)
    scale = min(b.uniform(1.1, 1.7) / float(np.linalg.norm(half)), 1.1 / float(half.max()))
    jitter = b.random.uniform(-0.08, 0.08, 3)
    return solids.moved(scale, jitter - scale * 0.5 * (low + high))
