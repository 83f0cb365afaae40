"""What training asks of a method: a field, its loss, its learning rates."""

import math
from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor

from xplanes.fields.base import RadianceField
from xplanes.rendering.base import Rendering
from xplanes.scenes.batches import Batch
from xplanes.training.sampling.base import Group, Moment


class Method(ABC):
    """A field with what its training consists of.

    Attributes:
        advice: What to change when the loss is not finite.
    """

    advice: str

    @property
    @abstractmethod
    def field(self) -> RadianceField:
        """What is trained."""

    @abstractmethod
    def groups(self) -> list[Group]:
        """The field's trainable parameters."""

    def optimizer(self, groups: list[Group]) -> torch.optim.Optimizer:
        """The optimiser of the field's and the sampler's parameters."""
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    @abstractmethod
    def rate(self, step: int, progress: float) -> float:
        """Factor on all learning rates.

        Args:
            step: Optimiser steps done.
            progress: Share of the budget that is spent.
        """

    def loss(self, rendering: Any, rays: Batch, moment: Moment) -> tuple[Tensor, Tensor]:
        """What is minimised, and the mean squared error of the colours."""
        error = colour_error(rendering, rays)
        return error, error

    def regularise(self, moment: Moment) -> None:
        """Add gradients that need no rays to ``.grad``."""
        return

    def before_step(self, moment: Moment, optimizer: torch.optim.Optimizer) -> None:
        """Change the field as its schedule asks, before a batch is rendered."""
        return

    def scalars(self) -> dict[str, float]:
        """Values for TensorBoard."""
        return {}


def colour_error(rendering: Rendering, rays: Batch) -> Tensor:
    """Mean squared error of the rays' colours. []"""
    return (rendering.colour - rays["target"]).square().mean()


def warm_cosine(step: int, progress: float, *, warmup: int, final: float) -> float:
    """A linear rise over ``warmup`` steps on half a cosine from 1 to ``final``."""
    warm = min(1.0, (step + 1) / max(1, warmup))
    return warm * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * progress)))
