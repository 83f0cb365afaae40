"""Exposure matching: a learnt gain per training camera and colour channel.

Cameras choose exposure and white balance for each photo, and the cameras of a rig differ. A field
trained on all of them turns these differences into fog or blurs texture. Images are rendered with
the mean exposure of the training cameras.
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from xplanes.rendering.base import Rendering
from xplanes.rendering.sampler import Group, Sampler, WrappingSampler
from xplanes.scenes.batches import Batch
from xplanes.scenes.frame import CameraGroups
from xplanes.streams import TrainingState

START = 300
"""Step from which exposures are matched: until then the field is too dark or too pale."""

RATE, PULL = 0.01, 0.003
"""Learning rate of the gains' logarithms, and weight of their mean square in the loss."""


class ExposureSampler(WrappingSampler):
    """Wraps a sampler of rays and multiplies its colours by the gains of each ray's camera.

    Args:
        inner: The sampler.
        groups: The training cameras.
        start: Step from which exposures are matched.
    """

    def __init__(self, inner: Sampler, groups: CameraGroups, start: int = START) -> None:
        super().__init__(inner)
        self.exposures, self.start = Exposures(groups), start

    @property
    def modules(self) -> dict[str, nn.Module]:
        return self.inner.modules | {"exposures": self.exposures}

    @property
    def outline(self) -> str:
        return f"{self.inner.outline}, exposures matched".removeprefix(", ")

    def groups(self) -> list[Group]:
        gains: Group = {"params": [self.exposures.logarithms], "lr": RATE, "name": "exposures"}
        return [*self.inner.groups(), gains]

    def render(self, field: Any, rays: Batch, state: TrainingState) -> Rendering:
        rendering = self.inner.render(field, rays, state)
        if state.step < self.start:
            return rendering
        gains = self.exposures(rays["view"])
        if (shown := rendering.shown) is not None:
            # A ray without slots shows only the background.
            gains = torch.where(shown[:, None], gains, gains.detach())
        return replace(rendering, colour=rendering.colour * gains)

    def losses(self, rendering: Any) -> dict[str, Tensor]:
        pull = PULL * self.exposures.relative.square().mean()
        return self.inner.losses(rendering) | {"exposures": pull}

    def scalars(self) -> dict[str, float]:
        spread = float(self.exposures.relative.detach().square().mean().sqrt())
        return self.inner.scalars() | {"sampler/exposures_spread": spread}


class Exposures(nn.Module):
    """A gain per colour channel of each camera; their geometric mean is 1.

    Args:
        groups: The training cameras.

    Attributes:
        logarithms: Logarithms of the gains, up to an offset common to all cameras. [C, 3]
    """

    index: Tensor

    def __init__(self, groups: CameraGroups) -> None:
        super().__init__()
        # Not stored in checkpoints: known whenever the field is built.
        self.register_buffer("index", groups.index, persistent=False)
        self.logarithms = nn.Parameter(torch.zeros(len(groups.places), 3))

    @property
    def relative(self) -> Tensor:
        """Logarithms of the gains. [C, 3]"""
        return self.logarithms - self.logarithms.mean(dim=0)

    def forward(self, view: Tensor) -> Tensor:
        """Gains of rays by their training views. int64 [R] -> [R, 3]"""
        # Faster than indexing, see `depth_before`.
        return self.relative.index_select(0, self.index[view]).exp()
