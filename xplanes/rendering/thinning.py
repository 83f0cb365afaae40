"""Subsampling of gradients: most samples contribute little to them."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

Shade = Callable[[Tensor | slice], tuple[Tensor, Tensor]]
"""Maps indices of samples to their colour [M, 3] and density [M]."""


def thinned(
    shade: Shade, parameters: Sequence[Tensor], thinning: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Colour and density of all samples, with unbiased gradients from a random subset.

    Most samples lie in empty space or behind surfaces: in a trained field a fifth of them carry
    nine tenths of the gradient. A sample whose gradient size is below a level, ``thinning`` times
    the mean, is kept with probability size / level, and its gradient is multiplied by level / size.
    The result is unbiased, and the backward pass evaluates the field for the kept samples only. The
    gradient size is the sum of the norms of the gradients with respect to colour and log density,
    which approximate those at the field's last layer.

    Args:
        shade: The field at the samples.
        parameters: Parameters that receive gradients.
        thinning: Level relative to the mean; 0 keeps all samples.
        generator: Source of randomness.

    Returns:
        [N, 3], [N]
    """
    return _Thinned.apply(shade, thinning, generator, *parameters)  # type: ignore[return-value]


class _Thinned(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, shade: Shade, thinning: float, generator: torch.Generator, *parameters: Tensor
    ) -> tuple[Tensor, Tensor]:
        ctx.shade, ctx.thinning, ctx.generator = shade, thinning, generator
        ctx.parameters = parameters
        colour, density = shade(slice(None))
        ctx.save_for_backward(density)
        return colour, density

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        to_colour, to_density = gradients
        (density,) = ctx.saved_tensors
        size = to_colour.norm(dim=1) + (to_density * density).abs()
        # If the level is not finite, all samples are kept, so that training detects the cause.
        level = (ctx.thinning * size.mean()).nan_to_num(0.0, 0.0, 0.0)
        draw = torch.rand(size.shape, generator=ctx.generator, dtype=size.dtype)
        # The negated comparison also keeps samples whose size is NaN.
        chosen = (~(draw * level >= size)).nonzero()[:, 0]
        factor = (level / size[chosen]).clamp_min(1)
        with torch.enable_grad():
            found = ctx.shade(chosen)
        upstream = to_colour[chosen] * factor[:, None], to_density[chosen] * factor
        # Colour or density may be constant.
        learnt = [pair for pair in zip(found, upstream, strict=True) if pair[0].requires_grad]
        given = torch.autograd.grad(
            [value for value, _ in learnt],
            ctx.parameters,
            [gradient for _, gradient in learnt],
            allow_unused=True,
        )
        return None, None, None, *given
