"""Stateless random numbers: each use has its own stream, numbered here."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum, unique

import torch
from torch import Tensor

GOLDEN, MIX = 0x9E3779B97F4A7C15, (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
"""Constants of splitmix64."""


@unique
class Stream(IntEnum):
    """Uses of random numbers. Ray batches use the rank of their process, counted from 0."""

    GRID = 1_000_003
    """Points at which the occupancy grid is updated, the same on all ranks."""
    INITIAL_FIELD = 1_000_033
    """Initial values of X-Planes."""
    FRAMES = 1_000_037
    """Timesteps at which L_r is evaluated."""
    JITTER = 1_000_039
    """Positions of samples, for samplers that need more than one number per ray."""
    TURNTABLE = 1_000_061
    """Points at which a triplane's occupancy grid is filled for its turntable video."""
    FILL = 1_000_081
    """Points at which the occupancy grid of an initialised field is filled."""
    FIELD = 1_000_099
    """Initial values of other fields."""
    SAMPLER = 1_000_117
    """Initial values of samplers that learn."""
    NEARBY = 1_000_151
    """Directions of the offsets over which Tensor4D's loss compares features."""
    PRETRAINING = 1_000_211
    """Positions of samples in the pretraining of LRMs."""
    NOISE = 1_000_271
    """Noise of time planes that are initialised from an LRM."""
    BACKGROUND = 1_000_289
    """Initial values of the field behind the cube."""
    VIEWS = 1_000_303
    """Order of the training views, for batches of one whole view."""
    SPLITTING = 1_000_333
    """Positions of the halves of split Gaussians."""
    TIME_NOISE = 1_000_357
    """Noise on the input times of the Gaussians' deformation network."""
    SIGHT = 1_000_381
    """Rays on which surface points of a field are found."""
    SPARSITY = 1_000_403
    """Points at which the sparsity prior is evaluated; processes add their rank."""
    THINNING = 1_000_427
    """Choice of the samples that receive gradients."""
    UNSEEN = 1_000_507
    """Random rays of the prior on the background's unseen directions."""
    PRETRAINING_BATCHES = 1_000_541
    """Views, points, rays and augmentation of the batches that pretrain LRMs."""
    PRETRAINING_ORDER = 1_000_583
    """Order of the objects in an epoch of pretraining."""


def step_generator(
    seed: int, step: int, stream: int = 0, device: torch.device | str = "cpu"
) -> torch.Generator:
    """A generator that depends only on its arguments.

    Args:
        seed: The run's seed.
        step: The training step.
        stream: Separates independent uses: a `Stream`, or the rank of a process.
        device: Where numbers are drawn; numbers differ between kinds of devices.
    """
    return torch.Generator(device).manual_seed(_key(seed, step, stream))


def _key(seed: int, step: int, stream: int) -> int:
    """A 64-bit hash of a triple; odd constants spread neighbouring triples (splitmix64)."""
    key = (seed * GOLDEN + step * MIX[0] + stream * MIX[1]) % 2**64
    key = ((key ^ (key >> 30)) * MIX[0]) % 2**64
    key = ((key ^ (key >> 27)) * MIX[1]) % 2**64
    return key ^ (key >> 31)


def counted_uniform(
    seed: int, step: int, stream: int, shape: tuple[int, ...], device: torch.device
) -> Tensor:
    """Uniform random numbers, each a function of its index: bit-identical on every device.

    Args:
        seed: The run's seed.
        step: The training step.
        stream: Separates independent uses: a `Stream`, or the rank of a process.
        shape: Shape of the result.
        device: Device of the result; it is not synchronised with the host.

    Returns:
        Multiples of 2^-53 in [0, 1). float64 [...]

    Source: Steele, Lea and Flood, Fast Splittable Pseudorandom Number Generators (splitmix64).
    """
    place = torch.arange(math.prod(shape), device=device)
    bits = place * _signed(GOLDEN) + _signed(_key(seed, step, stream))
    bits = (bits ^ _shifted(bits, 30)) * _signed(MIX[0])
    bits = (bits ^ _shifted(bits, 27)) * _signed(MIX[1])
    bits = bits ^ _shifted(bits, 31)
    return (_shifted(bits, 11).double() * 2.0**-53).view(shape)


def _signed(number: int) -> int:
    """64 bits read as int64, whose products wrap around."""
    return number - 2**64 if number >= 2**63 else number


def _shifted(bits: Tensor, by: int) -> Tensor:
    """A logical shift to the right; int64's own shift would repeat the sign bit."""
    return (bits >> by) & (2 ** (64 - by) - 1)


@contextmanager
def initial_values(seed: int, stream: Stream) -> Iterator[None]:
    """Seed torch's global generator from a stream within the block, then restore its state."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(step_generator(seed, 0, stream).initial_seed())
        yield


@dataclass(frozen=True)
class TrainingState:
    """Progress of training.

    Attributes:
        seed: The run's seed.
        step: Optimiser steps done.
        batch: Batches drawn before this one.
        rank: Rank of this process among those that split the rays.
        progress: Share of the training budget that has been used.
    """

    seed: int
    step: int
    batch: int
    rank: int
    progress: float = 0.0

    def generator(self, device: torch.device, stream: Stream = Stream.JITTER) -> torch.Generator:
        """A generator that depends only on the seed, this batch, the rank and the stream."""
        key = step_generator(self.seed, self.batch, stream + self.rank).initial_seed()
        return torch.Generator(device).manual_seed(key)
