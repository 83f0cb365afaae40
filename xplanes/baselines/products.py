"""Products of feature planes at several scales, as in K-Planes, and their regularisers."""

import functools
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from xplanes.backend import compiled, cpu_loops, gpu_kernels, proven, waves
from xplanes.fields.regularisers import (
    add_time_smoothness_gradient,
    add_total_variation_gradient,
    time_smoothness,
    total_variation,
)

AXES = "xyzt"

BLOCK = 2048
"""Points per block, so that intermediate gradients fit in the cache."""

DYNAMIC = ("xy", "xz", "xt", "yz", "yt", "zt")
STATIC = ("xy", "xz", "yz")
"""Planes in the order of the product."""


class PlaneProducts(nn.Module):
    """Multiplies all planes of each scale, channel by channel.

    Plane "ab" has axis a along its columns, b along its rows. Coordinates from -1 to 1 run from the
    first texel's centre to the last one's (``align_corners=True``) and are clamped to this range.

    Args:
        channels: Channels of each plane.
        resolution: Texels along each space axis at scale 1.
        scales: Factors on the resolution.
        time_resolution: Rows along time, at every scale; None for a static scene.
        low: Lower bound of the uniform initialisation of space planes. Time planes are
            initialised to 1.
        high: Upper bound of that initialisation.

    Source: K-Planes, Section 3.
    """

    def __init__(
        self,
        channels: int,
        resolution: int,
        scales: Sequence[int],
        time_resolution: int | None,
        *,
        low: float,
        high: float,
    ) -> None:
        super().__init__()
        self.names = STATIC if time_resolution is None else DYNAMIC
        self.channels = channels
        self.scales = nn.ModuleList()
        for scale in scales:
            planes = nn.ParameterDict()
            for name in self.names:
                size = resolution * scale
                rows = time_resolution if "t" in name else size
                plane = torch.ones(1, channels, rows or 0, size)
                plane = plane if "t" in name else plane.uniform_(low, high)
                # Channels of a texel are contiguous, for coalesced reads.
                planes[name] = nn.Parameter(plane.contiguous(memory_format=torch.channels_last))
            self.scales.append(planes)

    @property
    def features(self) -> int:
        """Columns of the output."""
        return self.channels * len(self.scales)

    def planes(self) -> list[tuple[str, Tensor]]:
        """Name and parameter of every plane, scale by scale. [1, C, rows, columns] each"""
        return [(name, scale[name]) for scale in self.scales for name in self.names]  # type: ignore[index]

    @property
    def finest(self) -> dict[str, Tensor]:
        """The planes of the finest scale. [C, rows, columns] each"""
        return {name: plane[0] for name, plane in self.planes()[-len(self.names) :]}

    def forward(self, points: Tensor, times: Tensor) -> Tensor:
        """Features of points at times.

        Args:
            points: Positions; the planes cover [-1, 1]^3. [N, 3]
            times: Times from 0 to 1. [N]

        Returns:
            Features of all scales, concatenated. [N, channels * scales]
        """
        places = torch.cat([points, 2 * times[:, None] - 1], dim=1)
        found = [
            plane_product([scale[name] for name in self.names], places, self.names)  # type: ignore[index]
            for scale in self.scales
        ]
        return torch.cat(found, dim=1)


def plane_product(planes: Sequence[Tensor], places: Tensor, names: Sequence[str]) -> Tensor:
    """Interpolate planes and multiply the results channel by channel.

    Gradients reach the planes only. The CPU uses compiled loops, and CUDA Triton kernels if they
    agree with `plane_product_reference`, which is used otherwise.

    Args:
        planes: Plane "ab" has axis a along its columns. [1, C, rows, columns] each
        places: Coordinates x, y, z, t, from -1 to 1 between the outermost texels. [N, 4]
        names: Axes of the planes.

    Returns:
        [N, C]

    Source: K-Planes, Section 3.
    """
    if cpu_loops(planes[0]):
        axes = torch.tensor([[AXES.index(axis) for axis in name] for name in names])
        places = places.detach().to(planes[0].dtype).contiguous()
        return _Product.apply(places, axes, *planes)  # type: ignore[return-value]
    first = planes[0]
    if gpu_kernels(first) and _kernels_hold(
        first.device, first.dtype, first.shape[1], tuple(names)
    ):
        return plane_product_gpu(planes, places, names)
    return plane_product_reference(planes, places, names)


def plane_product_reference(
    planes: Sequence[Tensor], places: Tensor, names: Sequence[str]
) -> Tensor:
    """Readable version of `plane_product`: one ``grid_sample`` per plane."""
    product = torch.ones((), device=places.device)
    for plane, (column, row) in zip(planes, names, strict=True):
        # Indexing with a list would copy it to the device and synchronise.
        grid = torch.stack([places[:, AXES.index(axis)] for axis in (column, row)], dim=1)
        grid = grid[None, None].to(plane.dtype)
        product = product * F.grid_sample(plane, grid, padding_mode="border", align_corners=True)
    return product[0, :, 0].T


def plane_product_gpu(planes: Sequence[Tensor], places: Tensor, names: Sequence[str]) -> Tensor:
    """Triton version of `plane_product`: one kernel for the values, one for the gradients."""
    axes = tuple((AXES.index(column), AXES.index(row)) for column, row in names)
    return _Kernels.apply(places, axes, *planes)  # type: ignore[return-value]


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, places: Tensor, axes: Tensor, *planes: Tensor) -> Tensor:
        product = places.new_empty(len(places), planes[0].shape[1])
        arrays = tuple(_array(plane) for plane in planes)
        cpu = compiled("xplanes.baselines.products_numba")
        cpu.multiply(arrays, places.numpy(), axes.numpy(), product.numpy())
        ctx.save_for_backward(places, axes, *planes)
        return product

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        places, axes, *planes = ctx.saved_tensors
        found = [torch.zeros_like(plane, memory_format=torch.channels_last) for plane in planes]
        spread = places.new_empty(BLOCK, len(planes), planes[0].shape[1])
        compiled("xplanes.baselines.products_numba").multiply_backward(
            tuple(_array(plane) for plane in planes),
            places.numpy(),
            axes.numpy(),
            gradients[0].to(places.dtype).contiguous().numpy(),
            spread.numpy(),
            tuple(_array(plane) for plane in found),
        )
        return None, None, *found


class _Kernels(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, places: Tensor, axes: tuple[tuple[int, int], ...], *planes: Tensor
    ) -> Tensor:
        first = planes[0]
        places = places.to(torch.promote_types(first.dtype, torch.float32)).contiguous()
        product = first.new_empty(len(places), first.shape[1])
        if len(places):
            gpu = importlib.import_module("xplanes.baselines.products_triton")
            gpu.multiply(tuple(_rows(plane) for plane in planes), places, axes, product)
        ctx.save_for_backward(places, *planes)
        ctx.axes = axes
        return product

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        places, *planes = ctx.saved_tensors
        form = {"dtype": places.dtype, "memory_format": torch.channels_last}
        found = [torch.zeros_like(plane, **form) for plane in planes]
        if len(places):
            importlib.import_module("xplanes.baselines.products_triton").multiply_backward(
                tuple(_rows(plane) for plane in planes),
                places,
                ctx.axes,
                gradients[0].to(places.dtype).contiguous(),
                tuple(_rows(plane) for plane in found),
            )
        return None, None, *(g.to(plane.dtype) for g, plane in zip(found, planes, strict=True))


@functools.cache
def _kernels_hold(
    device: torch.device, dtype: torch.dtype, channels: int, names: tuple[str, ...]
) -> bool:
    """Whether the kernels agree with the reference for such planes, gradients included."""

    def attempt(function: Callable[..., Tensor], precision: torch.dtype) -> list[Tensor]:
        planes = [
            # Multiples of 16, as in practice: Triton specialises kernels for them.
            waves(device, 1, channels, 4 if "t" in name else 16, 16).to(dtype).to(precision)
            for name in names
        ]
        planes = [plane.requires_grad_() for plane in planes]
        value = function(planes, 1.2 * waves(device, 50, 4), names)
        upstream = waves(device, 50, channels).to(precision)
        return [value, *torch.autograd.grad((value * upstream).sum(), planes)]

    what = f"products of planes ({channels} channels, {dtype})"
    return proven(what, device, attempt, plane_product_gpu, plane_product_reference, dtype)


def _rows(plane: Tensor) -> Tensor:
    """A plane with its channels last. [1, C, rows, columns] -> [rows, columns, C]"""
    return plane.detach()[0].permute(1, 2, 0).contiguous()


def _array(plane: Tensor) -> Any:
    """A plane with its channels last, in numpy. [1, C, rows, columns] -> [rows, columns, C]"""
    return _rows(plane).numpy()


Variation = Literal["coded", "corrected"]

ROWS, COLUMNS = 2, 3
"""Axes of a plane [1, C, rows, columns]; time is along the rows."""


@dataclass(frozen=True)
class PlaneTerms:
    """Weights of the regularisers of planes.

    Attributes:
        total_variation: Weight of squared differences between neighbouring texels.
        variation: ``coded`` sums twice the mean squares along rows and columns over all planes,
            including time, and counts space planes twice. ``corrected`` is the mean over planes;
            it halves the sum for space planes, and omits differences along time for time planes.
        time_smoothness: Weight of squared second differences along time, summed over planes.
        time_identity: Weight of the time planes' mean distance from 1, summed over planes.

    Source: K-Planes, released code.
    """

    total_variation: float
    variation: Variation
    time_smoothness: float
    time_identity: float

    @classmethod
    def of(cls, settings: Any) -> "PlaneTerms":
        """The weights among the settings of a loss."""
        return cls(*(getattr(settings, each.name) for each in fields(cls)))

    @torch.no_grad()
    def weighted(self, products: PlaneProducts) -> dict[str, float]:
        """The weighted terms by name, for the logger."""
        values = self.values(products)
        return {name: getattr(self, name) * float(value) for name, value in values.items()}

    def values(self, products: PlaneProducts) -> dict[str, Tensor]:
        """The three terms by name, without their weights. [] each"""
        planes = products.planes()
        variation = smoothness = identity = planes[0][1].new_zeros(())
        for name, plane in planes:
            dims, factor = self._variation(name, len(planes))
            variation = variation + factor * total_variation(plane, dims)
            if "t" in name:
                smoothness = smoothness + time_smoothness(plane[0])
                identity = identity + (1 - plane).abs().mean()
        return {
            "total_variation": variation,
            "time_smoothness": smoothness,
            "time_identity": identity,
        }

    @torch.no_grad()
    def add_gradients(self, products: PlaneProducts) -> None:
        """Add the weighted terms' gradients to those of the planes."""
        if not (self.total_variation or self.time_smoothness or self.time_identity):
            return
        planes = products.planes()
        for name, plane in planes:
            if plane.grad is None:
                plane.grad = torch.zeros_like(plane)
            if weight := self.total_variation:
                dims, factor = self._variation(name, len(planes))
                add_total_variation_gradient(plane.grad, plane, dims, weight * factor)
            if "t" not in name:
                continue
            if weight := self.time_smoothness:
                add_time_smoothness_gradient(plane.grad[0], plane[0], weight)
            if weight := self.time_identity:
                plane.grad.add_((plane - 1).sign(), alpha=weight / plane.numel())

    def _variation(self, name: str, count: int) -> tuple[tuple[int, ...], float]:
        """Axes of the differences in a plane's total variation, and its factor."""
        if self.variation == "coded":
            return (ROWS, COLUMNS), 2.0 if "t" in name else 4.0
        if "t" in name:
            return (COLUMNS,), 1 / count
        return (ROWS, COLUMNS), 0.5 / count
