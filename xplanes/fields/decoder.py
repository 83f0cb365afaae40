"""The MLP that turns plane features into colour and density."""

from collections.abc import Callable
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Activation = Literal["relu", "silu"]
DensityActivation = Literal["softplus", "exp"]
Precision = Literal["32", "bf16"]

DECODER_OPTIONS = ("width", "hidden", "activation", "density", "density_scale", "colour_margin")
"""Options of a decoder that its weights require, as in the group ``model.decoder``."""

MOST_EXPONENT = 60.0
"""Larger logits are clamped to this: the gradients of an infinite density would be NaN."""

_ACTIVATIONS: dict[Activation, Callable[[Tensor], Tensor]] = {"relu": torch.relu_, "silu": F.silu}

_DENSITIES: dict[DensityActivation, Callable[[Tensor], Tensor]] = {
    "softplus": F.softplus,
    "exp": lambda logits: logits.clamp_max(MOST_EXPONENT).exp(),
}
"""To add an activation of the density, add it here, to `DensityActivation`, to its test and to the
reader of exported planes in docs/recipes.md; then run docs/generate.py."""

ROWS = 256
"""On the CPU, matrices are padded to a multiple of this many rows, or of more if they are long.

oneDNN compiles and caches one kernel per number of rows, and every batch has a different number of
samples.
"""


def half_rows(values: Tensor) -> Tensor:
    """The values in bfloat16, on the CPU padded with rows of zeros. [N, C] -> [at least N, C]

    The padding is less than `ROWS` rows or a sixteenth of the values, whichever is more.
    """
    values = values.to(torch.bfloat16)
    if values.device.type != "cpu":
        return values
    step = max(ROWS, 2 ** (len(values).bit_length() - 1) // 16)
    return F.pad(values, (0, 0, 0, -len(values) % step))


class Decoder(nn.Module):
    """Features of three planes to colour and density, with the architecture of public LRMs.

    Channel 0 of the last layer is the density's logit, channels 1 to 3 are the colour's. Density is
    ``scale * softplus(logit - 1)`` (OpenLRM) or ``scale * exp(logit - 1)`` (TripoSR), per unit
    length of the field's frame; it does not depend on the viewing direction.

    Args:
        channels: Channels of one plane; the input has three times as many.
        width: Neurons of each hidden layer.
        hidden: Number of hidden layers.
        activation: Between layers.
        density: Activation of the density.
        density_scale: Factor on the density.
        precision: "bf16" multiplies in bfloat16 and computes everything else in float32.
        colour_margin: Extends the colour's range beyond [0, 1] by this on either side.

    Source: X-Planes, Eq. 14; OpenLRM 1.1; TripoSR.
    """

    def __init__(
        self,
        channels: int,
        *,
        width: int = 64,
        hidden: int = 3,
        activation: Activation = "relu",
        density: DensityActivation = "softplus",
        density_scale: float = 1.0,
        precision: Precision = "32",
        colour_margin: float = 0.001,
    ) -> None:
        super().__init__()
        sizes = [3 * channels, *[width] * hidden, 4]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False))
        self.width, self.hidden = width, hidden
        self.activation: Activation = activation
        self.density: DensityActivation = density
        self.density_scale, self.colour_margin = density_scale, colour_margin
        self.precision: Precision = precision

    @property
    def options(self) -> dict[str, Any]:
        """Constructor arguments that its weights require, by the names of `DECODER_OPTIONS`."""
        return {name: getattr(self, name) for name in DECODER_OPTIONS}

    def logits(self, features: Tensor) -> Tensor:
        """The last layer's output before the activations. [N, 3 C] -> [N, 4]"""
        bf16 = self.precision == "bf16"
        with torch.autocast(features.device.type, torch.bfloat16, enabled=bf16):
            hidden = half_rows(features) if bf16 else features
            for layer in self.layers[:-1]:
                hidden = _ACTIVATIONS[self.activation](layer(hidden))
            return self.layers[-1](hidden)[: len(features)]

    def activate(self, logits: Tensor) -> tuple[Tensor, Tensor]:
        """Colour and density from logits, at least in float32. [N, 4] -> [N, 3], [N]"""
        if logits.dtype in (torch.float16, torch.bfloat16):
            logits = logits.float()
        density = _DENSITIES[self.density](logits[:, 0] - 1)
        colour = logits[:, 1:].sigmoid()
        if self.colour_margin:
            colour = colour * (1 + 2 * self.colour_margin) - self.colour_margin
        return colour, density * self.density_scale

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Colour and density of each feature vector. [N, 3 C] -> [N, 3], [N]"""
        return self.activate(self.logits(features))
