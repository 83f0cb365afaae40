"""What training asks of a sampler."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from xplanes.rendering.base import RayRenderer, Rendering
from xplanes.scenes.batches import Batch, step_generator

JITTER_STREAM = 1_000_039
"""Random stream of the samples' places, for samplers that need more than one number per ray."""

Group = dict[str, Any]
"""Parameters of one learning rate: ``params``, ``lr`` and ``name``."""


@dataclass(frozen=True)
class Moment:
    """Where training stands.

    Attributes:
        seed: The run's seed.
        step: Optimiser steps done.
        batch: Batches drawn before this one.
        rank: Number of this process among those that split the rays.
    """

    seed: int
    step: int
    batch: int
    rank: int

    def generator(self, device: torch.device, stream: int = JITTER_STREAM) -> torch.Generator:
        """Random numbers of this batch, rank and stream, and of nothing else."""
        key = step_generator(self.seed, self.batch, stream + self.rank).initial_seed()
        return torch.Generator(device).manual_seed(key)


class Sampling(ABC):
    """How a step places samples, what that adds to the loss, and the upkeep between steps."""

    @property
    @abstractmethod
    def renderer(self) -> RayRenderer:
        """Renders images."""

    @property
    def parts(self) -> dict[str, nn.Module]:
        """Modules that belong into checkpoints, by name."""
        return {}

    @property
    def outline(self) -> str:
        """What the sampler does, in a few words."""
        return ""

    def groups(self) -> list[Group]:
        """Parameters that train along."""
        return []

    def first_rays(self, most: int) -> int:
        """Rays of the first batch, of ``most`` at most."""
        return most

    def renderer_at(self, step: int) -> RayRenderer:
        """Renders images when so many steps are done."""
        return self.renderer

    @abstractmethod
    def render(self, field: Any, rays: Batch, moment: Moment) -> Rendering:
        """Render the rays of a batch, with jitter."""

    def pass_on(self, rendering: Any, moment: Moment) -> int:
        """Take gradients to the field where rendering cut them off.

        Returns:
            Number of samples that the field got gradients of.
        """
        return len(rendering.samples)

    def loss(self, rendering: Any) -> Tensor | None:
        """The sampler's own term of the loss, weighted; None for none."""
        return None

    def regularise(self) -> None:
        """Add gradients of the sampler's own parameters."""
        return

    def observe(self, rendering: Rendering) -> None:
        """Learn from what a batch showed."""
        return

    def keep_up(self, field: Any, moment: Moment) -> None:
        """Do what is due after an optimiser step."""
        return

    def scalars(self) -> dict[str, float]:
        """Values for TensorBoard."""
        return {}
