"""Random numbers without memory: each use has a stream of its own, numbered here."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum, unique

import torch


@unique
class Stream(IntEnum):
    """What random numbers are for. Ray batches take the rank of their process, from 0 on."""

    GRID = 1_000_003
    """Points at which the occupancy grid is updated, the same on all ranks."""
    INITIAL_FIELD = 1_000_033
    """Initial values of X-Planes."""
    FRAMES = 1_000_037
    """Timesteps at which L_r is taken."""
    JITTER = 1_000_039
    """Positions of samples, for samplers that need more than one number per ray."""
    TURNTABLE = 1_000_061
    """Points at which the grid of a triplane's turntable is filled."""
    FILL = 1_000_081
    """Points at which the grid of an initialised field is filled."""
    BASELINE_FIELD = 1_000_099
    """Initial values of the baselines' fields."""
    SAMPLER = 1_000_117
    """Initial values of samplers that learn."""
    NEARBY = 1_000_151
    """Directions in which Tensor4D's features must not change."""
    PRETRAINING = 1_000_211
    """Positions of samples in the pretraining of LRMs."""
    THINNING = 1_000_241
    """Samples whose gradients are passed on."""
    NOISE = 1_000_271
    """Noise of time planes that are initialised from an LRM."""
    BACKGROUND = 1_000_289
    """Initial values of what lies behind the field's cube."""
    VIEWS = 1_000_303
    """Order of the training views, where a batch is a whole view."""
    SPLITTING = 1_000_333
    """Where the halves of split Gaussians go."""


def step_generator(seed: int, step: int, stream: int = 0) -> torch.Generator:
    """A generator that depends on nothing but its arguments.

    Args:
        seed: The run's seed.
        step: The training step.
        stream: Tells independent uses apart: a `Stream`, or the rank of a process.
    """
    # Odd constants spread neighbouring triples over 64 bits (splitmix64).
    key = (
        seed * 0x9E3779B97F4A7C15 + step * 0xBF58476D1CE4E5B9 + stream * 0x94D049BB133111EB
    ) % 2**64
    key = ((key ^ (key >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    key = ((key ^ (key >> 27)) * 0x94D049BB133111EB) % 2**64
    return torch.Generator().manual_seed(key ^ (key >> 31))


@contextmanager
def initial_values(seed: int, stream: Stream) -> Iterator[None]:
    """Draw random numbers of torch from a stream of the seed, and leave other streams alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(step_generator(seed, 0, stream).initial_seed())
        yield


@dataclass(frozen=True)
class TrainingState:
    """How far training is.

    Attributes:
        seed: The run's seed.
        step: Optimiser steps done.
        batch: Batches drawn before this one.
        rank: Number of this process among those that split the rays.
        progress: Share of the budget that is spent.
    """

    seed: int
    step: int
    batch: int
    rank: int
    progress: float = 0.0

    def generator(self, device: torch.device, stream: Stream = Stream.JITTER) -> torch.Generator:
        """Random numbers of this batch, rank and stream, and of nothing else."""
        key = step_generator(self.seed, self.batch, stream + self.rank).initial_seed()
        return torch.Generator(device).manual_seed(key)
