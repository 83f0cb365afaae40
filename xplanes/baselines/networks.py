"""Small networks, encodings of their inputs, and an activation function for density."""

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from xplanes.fields.decoder import half_rows


def octaves(values: Tensor, count: int) -> Tensor:
    """The values, then their sines and cosines at ``count`` frequencies 1, 2, 4, ...

    Args:
        values: Values to encode. [N, D]
        count: Number of frequencies; 0 returns the values unchanged.

    Returns:
        Values, then sines and cosines, frequency by frequency. [N, D (1 + 2 count)]

    Source: NeRF, Eq. 4, without the factor pi.
    """
    parts = [values]
    for power in range(count):
        parts += [(values * 2**power).sin(), (values * 2**power).cos()]
    return torch.cat(parts, dim=-1)


def spherical_harmonics(directions: Tensor) -> Tensor:
    """The 16 real spherical harmonics up to degree 3, with the Condon-Shortley phase.

    Args:
        directions: Unit vectors. [N, 3]

    Returns:
        Harmonics by degree l, then by order from -l to l. [N, 16]
    """
    x, y, z = directions.unbind(dim=-1)
    xx, yy, zz = x * x, y * y, z * z
    pi = math.pi
    one, two, three = math.sqrt(3 / pi) / 2, math.sqrt(15 / pi) / 2, math.sqrt(5 / pi) / 4
    outer, inner = math.sqrt(35 / (2 * pi)) / 4, math.sqrt(21 / (2 * pi)) / 4
    middle, axis = math.sqrt(105 / pi) / 2, math.sqrt(7 / pi) / 4
    return torch.stack(
        [
            torch.full_like(x, 0.5 / math.sqrt(pi)),
            -one * y,
            one * z,
            -one * x,
            two * x * y,
            -two * y * z,
            three * (3 * zz - 1),
            -two * x * z,
            two / 2 * (xx - yy),
            outer * y * (yy - 3 * xx),
            middle * x * y * z,
            inner * y * (1 - 5 * zz),
            axis * z * (5 * zz - 3),
            inner * x * (1 - 5 * zz),
            middle / 2 * z * (xx - yy),
            outer * x * (3 * yy - xx),
        ],
        dim=-1,
    )


BLOCK = 16
"""Widths are padded to multiples of this number, as in fully fused GPU networks."""

STEEPEST = 15.0
"""Bound on the absolute value of logits in the gradient of `truncated_exponential`."""


class PaddedMLP(nn.Module):
    """Linear layers without biases; the input is padded with ones to a multiple of 16 columns.

    Weights of the padding are trained: P columns of ones act as a bias with P times the learning
    rate. Weights have Glorot's uniform initialisation, for widths rounded up to multiples of 16.

    Args:
        widths: Columns of the input, neurons of each hidden layer, columns of the output.
        activation: Whether there is a ReLU between layers.
        precision: "bf16" for matrix products in bfloat16.

    Source: tiny-cuda-nn's fully fused network, as K-Planes uses it.
    """

    def __init__(
        self, widths: Sequence[int], *, activation: bool = True, precision: str = "32"
    ) -> None:
        super().__init__()
        self.inputs, self.activation, self.precision = widths[0], activation, precision
        padded = [_round_up(widths[0]), *widths[1:]]
        self.weights = nn.ParameterList()
        for columns, rows in zip(padded, padded[1:], strict=False):
            bound = (6 / (_round_up(columns) + _round_up(rows))) ** 0.5
            self.weights.append(nn.Parameter(torch.empty(rows, columns).uniform_(-bound, bound)))

    def forward(self, values: Tensor) -> Tensor:
        """[N, inputs] -> [N, outputs]"""
        bf16 = self.precision == "bf16"
        with torch.autocast(values.device.type, torch.bfloat16, enabled=bf16):
            first = self.weights[0]
            weight, padding = first[:, : self.inputs], first[:, self.inputs :]
            hidden = half_rows(values) if bf16 else values
            hidden = F.linear(hidden, weight, padding.sum(dim=1) if padding.shape[1] else None)
            for weight in self.weights[1:]:
                hidden = F.linear(hidden.relu() if self.activation else hidden, weight)
        return hidden[: len(values)].float() if bf16 else hidden


def _round_up(width: int) -> int:
    return -(-width // BLOCK) * BLOCK


class _TruncatedExponential(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logits: Tensor) -> Tensor:
        ctx.save_for_backward(logits)
        return logits.exp()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (logits,) = ctx.saved_tensors
        return gradients[0] * logits.clamp(-STEEPEST, STEEPEST).exp()


def truncated_exponential(logits: Tensor) -> Tensor:
    """The exponential, with a bounded gradient. [...] -> [...]

    Source: Instant-NGP; K-Planes.
    """
    return _TruncatedExponential.apply(logits)  # type: ignore[return-value]


def layers(widths: Sequence[int]) -> nn.Sequential:
    """Linear layers with biases and ReLUs between them."""
    found: list[nn.Module] = []
    for columns, rows in zip(widths, widths[1:], strict=False):
        found += [nn.Linear(columns, rows), nn.ReLU()]
    return nn.Sequential(*found[:-1])
