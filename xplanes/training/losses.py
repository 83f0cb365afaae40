"""The loss terms that need rays."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from xplanes.errors import ConfigError
from xplanes.models.base import LossTerm
from xplanes.rendering.base import Rendering
from xplanes.scenes.batches import Batch
from xplanes.streams import TrainingState
from xplanes.training.building import Parts
from xplanes.training.diagnosis import TrainingError


def loss_terms(
    parts: Parts,
    added: Mapping[str, LossTerm],
    rendering: Rendering,
    rays: Batch,
    state: TrainingState,
) -> dict[str, Tensor]:
    """Weighted loss terms by name: the model's, the sampler's and additional ones. [] each

    Args:
        parts: The field with its model and sampler.
        added: Terms of the group ``losses``.
        rendering: The rendering of the batch.
        rays: The batch.
        state: Seed and progress of training.

    Raises:
        ConfigError: If two terms have the same name.
        TrainingError: If a term is not a single number.
    """
    device = rendering.colour.device
    found = parts.model.losses(rendering, rays, state) | parts.sampler.losses(rendering)
    terms = {name: _number(term, f"loss term {name}", device) for name, term in found.items()}
    for name, term in added.items():
        if name in found:
            raise ConfigError(
                f"losses.{name}: the loss has a term of this name; choose another name"
            )
        value = term.value(parts.field, rendering, rays, state)
        terms[name] = term.weight * _number(value, f"losses.{name}", device)
    return terms


def _number(term: Any, name: str, device: torch.device) -> Tensor:
    """A loss term as a tensor without dimensions. []

    Raises:
        TrainingError: If it is not a single number.
    """
    if isinstance(term, int | float):
        return torch.tensor(float(term), device=device)
    if isinstance(term, Tensor) and term.numel() == 1:
        return term.reshape(()) if term.ndim else term
    shape = f"a tensor of shape {list(term.shape)}" if isinstance(term, Tensor) else None
    raise TrainingError(
        f"{name}: returned {shape or type(term).__name__}; return one number, such as its mean"
    )
