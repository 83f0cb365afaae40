"""K-Planes in training."""

import torch

from xplanes.fields.kplanes import KPlanes
from xplanes.schemas.kplanes import KPlanesConfig, KPlanesLossConfig
from xplanes.training.methods.base import Method, warm_cosine
from xplanes.training.plane_terms import PlaneTerms
from xplanes.training.sampling.base import Group, Moment


class KPlanesMethod(Method):
    """Colour error, smooth planes, and time planes near 1 where nothing moves.

    Args:
        field: The field.
        config: Learning rate.
        loss: Weights.

    Source: K-Planes, released code.
    """

    def __init__(self, field: KPlanes, config: KPlanesConfig, loss: KPlanesLossConfig) -> None:
        self._field, self.config = field, config
        self.terms = PlaneTerms(
            loss.total_variation,
            loss.variation,  # type: ignore[arg-type]
            loss.time_smoothness,
            loss.time_identity,
        )
        self.advice = f"Lower model.learning_rate={config.learning_rate}"

    @property
    def field(self) -> KPlanes:
        return self._field

    def groups(self) -> list[Group]:
        rate = self.config.learning_rate
        return [
            {"params": list(part.parameters()), "lr": rate, "name": name}
            for name, part in self._field.named_children()
        ]

    def rate(self, step: int, progress: float) -> float:
        return warm_cosine(step, progress, warmup=self.config.warmup_steps, final=0.0)

    def regularise(self, moment: Moment) -> None:
        self.terms.add_gradients(self._field.products)

    @torch.no_grad()
    def scalars(self) -> dict[str, float]:
        values = self.terms.values(self._field.products)
        return {f"reg/{name}": float(value) for name, value in values.items()}
