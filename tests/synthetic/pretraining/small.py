"""A pretraining of seconds: a small model, a small pool, few points."""

import copy
import functools

import numpy as np
import torch

from tests.baselines.runs import under
from xplanes.components import read_settings
from xplanes.config import compose_plain
from xplanes.lrm.canonical import OPENLRM_VIEW, CanonicalView
from xplanes.lrm.config import parse_config
from xplanes.synthetic.pretraining.pool import FOCAL, Pool, draw_sample
from xplanes.synthetic.pretraining.settings import PretrainingSettings, published_sizes

OVERRIDES = (
    *under("model", image_size=24, patch=8, encoder_depth=1, width=48, heads=2, layers=2),
    *under("model", low_resolution=4, channels=8, camera_width=8),
    *under("batch", objects=3, near=64, volume=32, free=32, colour=32, rays=8, samples=8),
    *under("pool", objects=256, views=2),
    *under("schedule", max_seconds="null", warmup_steps=2, render_from=0.5, score_objects=2),
)
SIDE = 24
VIEW = CanonicalView(OPENLRM_VIEW.rotation, 2.9, FOCAL, 1.0, 1.0)


@functools.cache
def composed(*overrides):
    """What Hydra makes of these overrides; composing takes a fifth of a second."""
    return compose_plain("pretrain_lrm", [*OVERRIDES, *overrides])


def small_plain(*overrides):
    return copy.deepcopy(composed(*overrides))


def small_config(*overrides):
    return read_settings(PretrainingSettings, small_plain(*overrides))


def small_sizes(*overrides):
    return parse_config(published_sizes(small_config(*overrides).model, FOCAL))


def small_pool(count=6):
    return Pool((np.concatenate([draw_sample(seed, 2, SIDE) for seed in range(count)]),))


def same(first, second):
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)
