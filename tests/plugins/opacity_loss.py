"""A loss of one's own: rays are stopped where the image shows something, and pass elsewhere."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from xplanes.fields.base import RadianceField
from xplanes.models.base import LossTerm, ray_mean
from xplanes.scenes.batches import Batch
from xplanes.streams import TrainingState


@dataclass(frozen=True, kw_only=True)
class OpacityLoss(LossTerm):
    """Mean squared difference between rendered opacity and alpha."""

    def value(
        self, field: RadianceField, rendering: Any, rays: Batch, state: TrainingState
    ) -> Tensor:
        return ray_mean((rendering.opacity - rays["alpha"]).square(), rays)
