"""Front-to-back rendering of images, with early ray termination."""

import math
from typing import Any

import torch
from torch import Tensor

from xplanes.backend import compiled
from xplanes.rendering.box import shade
from xplanes.rendering.compositing import OPAQUE
from xplanes.rendering.marching import Samples

AT_ONCE = 2**15
"""Samples per evaluation of the field.

Their features fit in the cache, and their memory is reused: above 32 MB the C library returns
memory to the system each time, and clearing new pages takes longer than the arithmetic.
"""


def front_to_back(
    field: Any,
    samples: Samples,
    times: Tensor,
    directions: Tensor,
    *,
    step: float,
    occlusion: float,
) -> Tensor:
    """Sums over the samples of each ray as in `composite`, on the CPU and without gradients.

    All rays advance by a few samples at a time, and a ray ends once it is opaque. The result does
    not depend on the number of samples at a time. The reference implementation is `shade` and
    `composite` on all samples; it differs by less than ``occlusion``.

    Args:
        field: Maps points [N, 3] and times [N] to colour [N, 3] and density [N].
        samples: Samples of the rays.
        times: Time of each ray. [R]
        directions: Unit direction of each ray. [R, 3]
        step: Length of a sample.
        occlusion: Transmittance below which a ray ends; 0: never.

    Returns:
        Sums of weight times (colour, 1, distance). [R, 5]
    """
    cpu = compiled("xplanes.rendering.rays_numba")
    limit = -math.log(occlusion) if occlusion > 0 else math.inf
    total = torch.zeros(len(times), 5, dtype=torch.float64)
    depth = torch.zeros(len(times), dtype=torch.float64)
    ends = torch.cat([samples.starts[1:], samples.starts.new_tensor([len(samples)])])
    first = samples.starts.clone()
    rays = (first < ends).nonzero()[:, 0]
    while len(rays):
        counts = (ends[rays] - first[rays]).clamp_max(max(1, AT_ONCE // len(rays)))
        starts = counts.cumsum(0) - counts
        count = int(counts.sum())
        ray, distances = samples.ray.new_empty(count), samples.distances.new_empty(count)
        points = samples.points.new_empty(count, 3)
        places = _arrays(rays, first, starts, samples.points, samples.distances)
        cpu.take_samples(*places, _arrays(ray, points, distances))
        colour, density = shade(field, points, times, directions, ray)
        numbers = (density * step).to(distances.dtype), colour.to(distances.dtype), distances
        cpu.composite_on(*_arrays(*numbers, rays, starts), OPAQUE, limit, *_arrays(depth, total))
        first[rays] += counts
        rays = rays[(first[rays] < ends[rays]) & (depth[rays] < limit)]
    return total.to(directions.dtype)


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)
