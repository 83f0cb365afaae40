"""Gradients that matter: most samples need none."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

Shade = Callable[[Tensor | slice], tuple[Tensor, Tensor]]
"""Colour [M, 3] and density [M] of some of the samples, given their indices."""


def thinned(
    shade: Shade, parameters: Sequence[Tensor], thinning: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Colour and density of all samples, whose gradients some samples carry for the others.

    Most samples lie in thin air or behind what is seen; in a trained field a fifth of them holds
    nine tenths of the gradient. A sample whose gradient has a size below a level, ``thinning``
    times the mean, is taken along with probability size / level, its gradient multiplied by level /
    size: what the field gets is right on average, and the field is asked again for these samples
    alone. The size adds up the gradients of the colour and of the density's logarithm, which the
    field's last layer feels.

    Args:
        shade: The field at the samples.
        parameters: What gradients are wanted of.
        thinning: 0 leaves no sample out.
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
        # A level that is not finite must hide no sample: training looks for what is not finite.
        level = (ctx.thinning * size.mean()).nan_to_num(0.0, 0.0, 0.0)
        draw = torch.rand(size.shape, generator=ctx.generator, dtype=size.dtype)
        # Also true of a size that is NaN.
        chosen = (~(draw * level >= size)).nonzero()[:, 0]
        factor = (level / size[chosen]).clamp_min(1)
        with torch.enable_grad():
            found = ctx.shade(chosen)
        upstream = to_colour[chosen] * factor[:, None], to_density[chosen] * factor
        # One of the two may be a constant.
        learnt = [pair for pair in zip(found, upstream, strict=True) if pair[0].requires_grad]
        given = torch.autograd.grad(
            [value for value, _ in learnt],
            ctx.parameters,
            [gradient for _, gradient in learnt],
            allow_unused=True,
        )
        return None, None, None, *given
