"""A pretraining of seconds: a small model, a small pool, few points."""

import copy
import functools

import torch

from xplanes.lrm.config import parse_config
from xplanes.synthetic.pretraining.pool import FOCAL, Pool, draw_sample
from xplanes.synthetic.pretraining.run import compose_pretraining
from xplanes.synthetic.pretraining.settings import parse_pretraining, published_sizes

OVERRIDES = (
    "model.image_size=24",
    "model.patch=8",
    "model.encoder_depth=1",
    "model.width=48",
    "model.heads=2",
    "model.layers=2",
    "model.low_resolution=4",
    "model.channels=8",
    "model.camera_width=8",
    "batch.objects=3",
    "batch.near=64",
    "batch.volume=32",
    "batch.free=32",
    "batch.colour=32",
    "batch.rays=8",
    "batch.samples=8",
    "pool.objects=256",
    "pool.views=2",
    "schedule.max_seconds=null",
    "schedule.warmup_steps=2",
    "schedule.render_from=0.5",
    "schedule.score_objects=2",
)
SIDE = 24


@functools.cache
def composed(*overrides):
    """What Hydra makes of these overrides; composing takes a fifth of a second."""
    return compose_pretraining([*OVERRIDES, *overrides])


def small_plain(*overrides):
    return copy.deepcopy(composed(*overrides))


def small_config(*overrides):
    return parse_pretraining(small_plain(*overrides))


def small_sizes(*overrides):
    return parse_config(published_sizes(small_config(*overrides).model, FOCAL))


def small_pool(count=6):
    import numpy as np

    return Pool((np.concatenate([draw_sample(seed, 2, SIDE) for seed in range(count)]),))


def same(first, second):
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)
