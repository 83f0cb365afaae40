"""Base class of the baselines' models."""

from typing import ClassVar, Generic, TypeVar

from xplanes.fields.base import Representation
from xplanes.models.base import Model, ModelSettings

S = TypeVar("S", bound=ModelSettings)
F = TypeVar("F", bound=Representation)


class BaselineModel(Model, Generic[S, F]):
    """A field with the settings of its training.

    Args:
        settings: Learning rates, schedule and weights.
        field: The field.
    """

    doubted: ClassVar[tuple[str, ...]]
    """Learning rates to lower when the loss is not finite."""

    def __init__(self, settings: S, field: F) -> None:
        self._field, self.settings = field, settings
        rates = [f"model.{name}={getattr(settings, name)}" for name in self.doubted]
        self.advice = f"Lower {' or '.join(rates)}"

    @property
    def field(self) -> F:
        return self._field
