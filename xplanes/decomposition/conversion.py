"""Conversion of low-rank and sparse triplanes to the planes of a field (g2 in X-Planes).

The resulting planes are channels-last. Space planes are [3, R, R, C] in the order xy, xz, yz: plane
"ab" has its FIRST axis a along the width (last spatial dimension) and b along the rows. Time planes
are [P, Rt, R, C]: plane "at" has a along the width and time along the rows. Like LRM planes, space
axes are sampled with ``align_corners=False`` and are zero outside. Time t in [0, 1] lies at row
``t * (Rt - 1)``; with Rt = T, each frame has its own row.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from xplanes.decomposition.rpca import check_triplanes
from xplanes.fields.lookup import Rows
from xplanes.fields.xplanes import PLANE_SETS, TIME_PLANES


def space_weights(size_out: int, size_in: int, like: Tensor) -> Tensor:
    """Interpolation weights from a spatial axis to the cell centres of another resolution.

    The convention is that of LRM planes: ``align_corners=False``, zero outside.

    Args:
        size_out: Cells to sample at.
        size_in: Cells of the plane.
        like: A tensor with the type and device of the result.

    Returns:
        One row per sampled cell. [size_out, size_in]
    """
    centres = (torch.arange(size_out, dtype=torch.float64, device=like.device) + 0.5) / size_out
    return _hat(centres * size_in - 0.5, size_in).to(like.dtype)


def time_weights(times: Tensor, size: int, like: Tensor) -> Tensor:
    """Interpolation weights along the time axis: time t lies at row ``t * (size - 1)``.

    Args:
        times: Times, clamped to [0, 1]. [B]
        size: Rows of the plane along time.
        like: A tensor with the type and device of the result.

    Returns:
        One row per time. [B, size]
    """
    position = times.to(like.device, torch.float64).clamp(0, 1) * (size - 1)
    return _hat(position, size).to(like.dtype)


def _hat(positions: Tensor, size: int) -> Tensor:
    nodes = torch.arange(size, dtype=torch.float64, device=positions.device)
    return (1 - (positions[:, None] - nodes).abs()).clamp_min(0)


_SLICES = 256  # Slices that are factorised together.
_POWER_ITERATIONS = 30  # For each slice.
_SWEEPS = 15  # Passes of alternating least squares over all factors.


def rank1_factors(planes: Tensor) -> tuple[Tensor, Tensor]:
    """Best rank-1 product of every slice: the minimiser of the product loss for nine planes.

    Power iteration, initialised with the row of largest norm; slices of zeros stay zero. The signs
    of each pair follow the previous frame, so that interpolation in time does not cross zero.

    Args:
        planes: One orientation of the sparse part. [T, C, H, W]

    Returns:
        Factors along the width and along the rows, of equal norm; their outer product
        ``rows x width`` is the slice. [T, W, C], [T, H, C]
    """
    frames, channels, height, width = planes.shape
    slices = planes.reshape(-1, height, width)
    kind = planes.dtype if planes.dtype == torch.float64 else torch.float32
    first = torch.zeros(len(slices), width, dtype=kind, device=planes.device)
    second = torch.zeros(len(slices), height, dtype=kind, device=planes.device)
    active = slices.abs().amax(dim=(1, 2)).nonzero()[:, 0]
    for chosen in active.split(_SLICES):
        # Normalised by the largest entry, so that squares neither overflow nor underflow.
        part = slices[chosen].to(kind)
        unit = part.abs().amax(dim=(1, 2), keepdim=True)
        part = part / unit
        longest = part.square().sum(-1).argmax(-1)
        right = part[torch.arange(len(part), device=part.device), longest][..., None]
        for _ in range(_POWER_ITERATIONS):
            right = part.mT @ (part @ right)
            right = right / torch.linalg.vector_norm(right, dim=1, keepdim=True)
        left = part @ right
        root = torch.linalg.vector_norm(left, dim=1, keepdim=True).sqrt()
        first[chosen] = (right * root * unit.sqrt())[..., 0]
        second[chosen] = (left / root * unit.sqrt())[..., 0]
    wide = first.view(frames, channels, width).mT
    tall = second.view(frames, channels, height).mT
    signs = _running_signs(wide, tall)
    return wide * signs, tall * signs


def shared_factors(sparse: Tensor, rows: Rows) -> list[Tensor]:
    """Time planes that are shared by several orientations, each orientation a product of two.

    Alternating least squares per frame and channel: each factor has a closed form with all others
    fixed, so the product loss never rises. Each factor is initialised with the mean of its
    candidates from the rank-1 pairs of all orientations, after their signs are aligned.

    Args:
        sparse: The sparse part, square planes. [T, 3, C, N, N]
        rows: For xy, xz and yz the two factors of their product, by position.

    Returns:
        Factors by position. [T, N, C] each
    """
    few = max(1, _SLICES // sparse.shape[2])
    parts = [_shared_in_cache(frames, rows) for frames in sparse.split(few)]
    factors = [torch.cat(pieces) for pieces in zip(*parts, strict=True)]
    # Products keep their values only if all factors that they connect are flipped together.
    for group in _joined(rows):
        signs = _running_signs(*(factors[place] for place in group))
        for place in group:
            factors[place] = factors[place] * signs
    return factors


def _shared_in_cache(sparse: Tensor, rows: Rows) -> list[Tensor]:
    found: dict[int, list[Tensor]] = {}
    for index, places in enumerate(rows):
        pair = [factor.mT[..., None] for factor in rank1_factors(sparse[:, index])]
        for place in places:
            if place in found:  # A pair may be flipped as a whole.
                sign = _sign(found[place][0], pair[places.index(place)])
                pair = [factor * sign for factor in pair]
                break
        for place, factor in zip(places, pair, strict=True):
            first = found.setdefault(place, [])
            first.append(factor * _sign(first[0], factor) if first else factor)
    factors = [
        sum(found[place][1:], found[place][0]) / len(found[place]) for place in sorted(found)
    ]
    planes = sparse.to(factors[0].dtype).unbind(1)
    for _ in range(_SWEEPS):
        for place in range(len(factors)):
            # The width belongs to the first factor of a product, the rows to the second.
            uses = [(plane.mT, b) for plane, (a, b) in zip(planes, rows, strict=True) if a == place]
            uses += [(plane, a) for plane, (a, b) in zip(planes, rows, strict=True) if b == place]
            factors[place] = _solve([(plane, factors[other]) for plane, other in uses])
    return [factor[..., 0].mT for factor in factors]


def _joined(rows: Rows) -> list[set[int]]:
    """Groups of factors that are connected by products, directly or through others."""
    groups: list[set[int]] = []
    for pair in rows:
        touched = [group for group in groups if group & set(pair)]
        groups = [group for group in groups if group not in touched]
        groups.append(set(pair).union(*touched))
    return groups


def _solve(products: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """Least-squares factor, given the other factor and the target plane of each product."""
    right_side = sum(plane @ other for plane, other in products)
    weight = sum(other.square().sum(-2, keepdim=True) for _, other in products)
    assert isinstance(right_side, Tensor)
    assert isinstance(weight, Tensor)
    return torch.where(weight > 0, right_side / weight.clamp_min(1e-30), 0)


def _sign(first: Tensor, second: Tensor) -> Tensor:
    agreement = (first * second).sum(-2, keepdim=True)
    return torch.where(agreement < 0, -1.0, 1.0).to(first)


def _running_signs(*factors: Tensor) -> Tensor:
    """Signs that align the factors of each frame with those of the previous frame.

    Args:
        *factors: Factors of the same frames and channels. [T, N, C] each

    Returns:
        One sign per frame and channel. [T, 1, C]
    """
    agreement = torch.stack([(f[1:] * f[:-1]).sum(1) for f in factors]).sum(0)
    flips = torch.where(agreement < 0, -1.0, 1.0).to(factors[0])
    return torch.cat([torch.ones_like(factors[0][:1, 0]), flips]).cumprod(0)[:, None]


STATIC = ("middle", "median", "mean")
DYNAMIC = ("random", "ones", "rank1")


def space_planes(
    low_rank: Tensor, *, static: str = "median", resolution: int | None = None
) -> Tensor:
    """Convert the low-rank part to space planes (X-Planes, Eq. 16).

    Args:
        low_rank: The static part. [T, 3, C, H, W]
        static: "middle" (frame T/2, the paper's choice), or the elementwise "median" or "mean" over
            time.
        resolution: R, texels per side; None keeps that of the triplanes, which must then be square.

    Returns:
        Planes xy, xz, yz. [3, R, R, C]

    Raises:
        ValueError: If the shape or an option is invalid.
    """
    check_triplanes(low_rank, "low_rank")
    if static not in STATIC:
        raise ValueError(f"static is {static!r}: allowed are {', '.join(STATIC)}")
    if static == "middle":
        plane = low_rank[len(low_rank) // 2]
    elif static == "mean":
        plane = low_rank.mean(dim=0)
    else:
        plane = torch.stack([_median(low_rank[:, index]) for index in range(3)])
    size = _resolution(low_rank, resolution)
    if plane.shape[-2:] != (size, size):
        rows = space_weights(size, plane.shape[-2], plane)
        columns = space_weights(size, plane.shape[-1], plane)
        plane = rows @ plane @ columns.mT
    return plane.permute(0, 2, 3, 1).contiguous()


def time_planes(
    sparse: Tensor,
    *,
    plane_set: str,
    dynamic: str = "rank1",
    resolution: int | None = None,
    time_resolution: int | None = None,
    noise: float = 0.01,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Convert the sparse part to space-time planes (X-Planes, Eq. 15 and 17).

    "rank1" minimises the error of the planes' products for each frame on the triplanes' grid: in
    closed form if no two products share a plane, as in "nine", else by alternating least squares.
    "ones" is K-Planes' initialisation, on which the paper relies: all products are 1. "random" is
    noise around zero, so the products barely change the space planes. The same noise is added to
    "rank1", because a product of two zeros has a zero gradient.

    Args:
        sparse: The dynamic part. [T, 3, C, H, W]
        plane_set: A plane set with time planes, such as "six" or "nine".
        dynamic: "rank1", "random" or "ones".
        resolution: R, texels per side; None keeps that of the triplanes, which must then be square.
        time_resolution: Rt, rows along time; None for T, one row per frame.
        noise: Standard deviation of the noise, 0 or more.
        generator: Random generator of the noise; torch's default when None.

    Returns:
        Time planes in the order of the plane set. [P, Rt, R, C]

    Raises:
        ValueError: If the shape or an option is invalid.
    """
    check_triplanes(sparse, "sparse")
    for name, value, allowed in (
        ("plane_set", plane_set, [name for name, rows in PLANE_SETS.items() if rows]),
        ("dynamic", dynamic, DYNAMIC),
    ):
        if value not in allowed:
            raise ValueError(f"{name} is {value!r}: allowed are {', '.join(allowed)}")
    if noise < 0:
        raise ValueError(f"noise is {noise}: it must not be negative")
    frames, _, channels, height, width = sparse.shape
    size = _resolution(sparse, resolution)
    count = frames if time_resolution is None else time_resolution
    if count < 1:
        raise ValueError(f"time_resolution is {time_resolution}: it must be at least 1")
    rows = PLANE_SETS[plane_set]
    places, names = [place for pair in rows for place in pair], TIME_PLANES.get(plane_set, ())
    if set(places) != set(range(len(names))):
        raise ValueError(
            f"plane_set={plane_set!r}: PLANE_SETS multiplies the planes {sorted(set(places))}, but "
            f"TIME_PLANES names {len(names)}; each of those must be in a product, and no other"
        )
    shape = (len(names), count, size, channels)
    kind = sparse.dtype if sparse.dtype == torch.float64 else torch.float32
    if dynamic == "ones":
        return torch.ones(shape, dtype=kind, device=sparse.device)
    planes = noise * torch.randn(
        shape,
        dtype=kind,
        device=generator.device if generator else sparse.device,
        generator=generator,
    ).to(sparse.device)
    if dynamic == "random":
        return planes

    if len(set(places)) == len(places):
        own = [factor for index in range(3) for factor in rank1_factors(sparse[:, index])]
        factors = [own[places.index(place)] for place in sorted(places)]
    elif height == width:
        factors = shared_factors(sparse, rows)
    else:
        raise ValueError(
            f"plane_set={plane_set!r} shares planes between axes and needs square triplanes, not "
            f"{height} x {width}"
        )
    ticks = torch.linspace(0, 1, count, dtype=torch.float64, device=sparse.device)
    for plane, factor in zip(planes, factors, strict=True):
        if len(factor) != count:
            # A single row represents all times: take the middle frame.
            weights = time_weights(ticks if count > 1 else ticks + 0.5, frames, factor)
            factor = torch.einsum("st,tac->sac", weights, factor)
        if factor.shape[1] != size:
            factor = space_weights(size, factor.shape[1], factor) @ factor
        plane += factor
    return planes


def frame_profiles(planes: Tensor, frames: Tensor, count: int, size: int) -> Tensor:
    """Sample time planes separably at frames and at the cell centres of a grid.

    Args:
        planes: Time planes. [P, Rt, R, C]
        frames: Indices of the frames. [B]
        count: Number of frames T that fill [0, 1].
        size: Cells of the grid along the spatial axis.

    Returns:
        Values along the spatial axis. [P, B, size, C]
    """
    last = planes.shape[1] - 1
    position = frames.to(planes.device).double() / max(count - 1, 1) * last
    before = position.floor().long().clamp(0, last)
    share = (position - before).to(planes.dtype)[:, None, None]
    # One gather for both neighbours, so that its gradient is accumulated in one pass.
    rows = planes[:, torch.cat([before, (before + 1).clamp_max(last)])]
    values = rows[:, : len(before)].lerp(rows[:, len(before) :], share)
    if planes.shape[2] == size:
        return values
    return space_weights(size, planes.shape[2], planes) @ values


def _median(values: Tensor) -> Tensor:
    """Median over the first axis; for an even number, the mean of the two middle values."""
    lower = values.median(dim=0).values
    if len(values) % 2:
        return lower
    return 0.5 * (lower - (-values).median(dim=0).values)


def _resolution(triplanes: Tensor, resolution: int | None) -> int:
    height, width = triplanes.shape[-2:]
    if resolution is None:
        if height != width:
            raise ValueError(f"triplanes are {height} x {width}: set a resolution")
        return height
    if resolution < 1:
        raise ValueError(f"resolution is {resolution}: it must be at least 1")
    return resolution
