"""Reading settings from a published configuration."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from xplanes.errors import LRMError


@dataclass(frozen=True)
class Reader:
    """Reads settings from a nested configuration; errors name missing or invalid keys.

    Attributes:
        values: The section read from.
        place: Key path of the section, for messages.
        root: The whole configuration, for resolving references; ``values`` if empty.
    """

    values: Mapping[str, Any]
    place: str = ""
    root: Mapping[str, Any] = field(default_factory=dict)

    def inner(self, key: str) -> "Reader":
        """A subsection."""
        value = self.values.get(key)
        if not isinstance(value, Mapping):
            raise LRMError(f"the model's configuration has no section {self.place}{key}")
        return Reader(value, f"{self.place}{key}.", self.root or self.values)

    def integer(self, key: str, default: int | None = None) -> int:
        """A positive integer."""
        value = self._value(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise self._error(key, value, "must be a whole number above zero")
        return value

    def number(self, key: str, default: float) -> float:
        """A number."""
        value = self._value(key, default)
        try:
            return float(value)  # YAML 1.1 reads 1e-12 as text
        except (TypeError, ValueError):
            raise self._error(key, value, "must be a number") from None

    def positive(self, key: str, default: float) -> float:
        """A finite positive number."""
        value = self.number(key, default)
        if not 0 < value < math.inf:
            raise self._error(key, value, "must be above zero")
        return value

    def require(self, key: str, value: Any) -> None:
        """Refuse any value other than the supported one."""
        if (found := self._value(key, value)) != value:
            raise self._error(key, found, f"only {value!r} is supported")

    def triple(self, key: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Three numbers."""
        values = self.values.get(key, default)
        if not isinstance(values, list | tuple) or len(values) != 3:
            raise self._error(key, values, "must be three numbers")
        return tuple(float(value) for value in values)

    def _error(self, key: str, value: Any, wanted: str) -> LRMError:
        return LRMError(f"the model's configuration has {self.place}{key}={value!r}: {wanted}")

    def _value(self, key: str, default: Any) -> Any:
        """A value, with references ``${a.b}``, as in TripoSR's YAML, resolved."""
        value = self.values.get(key, default)
        for _ in range(8):
            match = re.fullmatch(r"\$\{([\w.]+)\}", value) if isinstance(value, str) else None
            if match is None:
                return value
            found: Any = self.root or self.values
            for name in match[1].split("."):
                if not isinstance(found, Mapping) or name not in found:
                    raise LRMError(
                        f"the model's configuration refers to {value}, which does not exist"
                    )
                found = found[name]
            value = found
        raise LRMError(f"the model's configuration refers to {value} in a circle")
