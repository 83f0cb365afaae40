"""TiNeuVox in training: a grid that grows, and terms of single samples."""

import torch
from torch import Tensor

from xplanes.fields.tineuvox import TiNeuVox
from xplanes.rendering.base import Rendering
from xplanes.rendering.fixed_step import FixedStepRendering
from xplanes.scenes.batches import Batch
from xplanes.schemas.tineuvox import TiNeuVoxConfig, TiNeuVoxLossConfig
from xplanes.training.losses import light_entropy, sample_colour_error
from xplanes.training.masked_adam import MaskedAdam
from xplanes.training.methods.base import Method, colour_error
from xplanes.training.sampling.base import Group, Moment


class TiNeuVoxMethod(Method):
    """Colour error, decided rays, and samples that each show their ray's colour.

    The optimiser starts afresh whenever the grid grows, learning rates included.

    Args:
        field: The field.
        config: Learning rates and growth.
        loss: Weights.

    Source: TiNeuVox, released code.
    """

    def __init__(self, field: TiNeuVox, config: TiNeuVoxConfig, loss: TiNeuVoxLossConfig) -> None:
        self._field, self.config, self.weights = field, config, loss
        self.advice = (
            f"Lower model.grid_learning_rate={config.grid_learning_rate} or "
            f"model.network_learning_rate={config.network_learning_rate}"
        )

    @property
    def field(self) -> TiNeuVox:
        return self._field

    def groups(self) -> list[Group]:
        config, field = self.config, self._field
        groups: list[Group] = [
            {
                "params": [field.grid],
                "lr": config.grid_learning_rate,
                "name": "grid",
                "masked": True,
            }
        ]
        for name, part in field.named_children():
            deforms = name == "deformation"
            rate = config.deformation_learning_rate if deforms else config.network_learning_rate
            groups.append({"params": list(part.parameters()), "lr": rate, "name": name})
        return groups

    def optimizer(self, groups: list[Group]) -> torch.optim.Optimizer:
        return MaskedAdam(groups)

    def rate(self, step: int, progress: float) -> float:
        begun = max([at for at in self.config.grow_at if at <= step], default=0)
        return 0.1 ** ((step - begun) / self.config.decay_steps)

    def voxels(self, step: int) -> int:
        """Number of cells in a step."""
        to_come = sum(at > step for at in self.config.grow_at)
        return self._field.resolution**3 // 2**to_come

    def before_step(self, moment: Moment, optimizer: torch.optim.Optimizer) -> None:
        voxels = self.voxels(moment.step)
        if int(self._field.voxels) != voxels:
            self._field.resize(voxels)
            optimizer.state.clear()

    def loss(self, rendering: Rendering, rays: Batch, moment: Moment) -> tuple[Tensor, Tensor]:
        error = colour_error(rendering, rays)
        total = error + self.weights.entropy * light_entropy(rendering.opacity)
        if isinstance(rendering, FixedStepRendering):
            spread = sample_colour_error(
                rendering.colours, rays["target"], rendering.weights, rendering.ray
            )
            total = total + self.weights.sample_colour * spread
        return total, error

    def scalars(self) -> dict[str, float]:
        return {"grid/cells": float(self._field.voxels)}
