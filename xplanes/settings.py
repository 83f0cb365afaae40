"""Typed settings: dataclasses that check types, ranges and choices when they are built.

Each component of a run has such a class, which YAML files name as ``_target_``. Imports fast,
without torch and Hydra.
"""

import difflib
import math
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from xplanes.errors import ConfigError


@dataclass(frozen=True)
class Range:
    """Bounds of a number.

    Attributes:
        low: Lower bound.
        high: Upper bound.
        open: Whether the bounds themselves are excluded.
    """

    low: float = -math.inf
    high: float = math.inf
    open: bool = False

    def __contains__(self, value: float) -> bool:
        if self.open:
            return self.low < value < self.high
        return self.low <= value <= self.high

    def __str__(self) -> str:
        if self.low == 0 and self.high == math.inf:
            return "must be above 0" if self.open else "must not be negative"
        if self.high == math.inf:
            return f"must be {'above' if self.open else 'at least'} {self.low:g}"
        if self.low == -math.inf:
            return f"must be {'below' if self.open else 'at most'} {self.high:g}"
        return f"must lie between {self.low:g} and {self.high:g}"


ABOVE_0, FROM_0, SHARE = Range(0, open=True), Range(0), Range(0, 1)

HOME = "~ is the user's folder"

Location = Annotated[str, HOME]
"""A file or folder; a leading ``~`` becomes the user's home directory."""
Count = Annotated[int, ABOVE_0]
"""A whole number above 0."""
Positive = Annotated[float, ABOVE_0]
"""A number above 0."""
Weight = Annotated[float, FROM_0]
"""A number of at least 0."""
Steps = Annotated[int, FROM_0]
"""A whole number of at least 0."""
Share = Annotated[float, SHARE]
"""A number from 0 to 1."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Base of all settings. Subclasses are frozen dataclasses with keyword arguments.

    All values are checked on construction; `xplanes.components.build` makes an object, with its
    nested settings, from builtins.
    """

    def __post_init__(self) -> None:
        for entry, hint in hints_of(type(self)):
            value = _converted(getattr(self, entry), hint)
            object.__setattr__(self, entry, value)
            _check(entry, value, hint)
        self.check()

    def check(self) -> None:
        """Refuse settings that contradict one another.

        Raises:
            ConfigError: With the setting, its value and the remedy.
        """

    @classmethod
    def require_names(cls, names: Iterable[str]) -> None:
        """Refuse names that are not settings of this class, and missing ones.

        Raises:
            ConfigError: For a name that does not exist, or one that is missing.
        """
        known = {entry.name: entry for entry in fields(cls)}
        given = list(names)
        for name in given:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=3)
                hint = f". Did you mean {' or '.join(near)}?" if near else ""
                raise ConfigError(f"{name}: there is no such setting{hint}")
        needed = (n for n, e in known.items() if e.default is e.default_factory is MISSING)
        if missing := [name for name in needed if name not in given]:
            verb = "it is" if len(missing) == 1 else "they are"
            raise ConfigError(f"{', '.join(missing)}: {verb} not set")

    def plain(self) -> dict[str, Any]:
        """The settings as builtins, with the class as ``_target_``."""
        content: dict[str, Any] = {"_target_": f"{type(self).__module__}.{type(self).__qualname__}"}
        for entry in fields(self):
            value = getattr(self, entry.name)
            content[entry.name] = value.plain() if isinstance(value, Settings) else value
        return content


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        flat.update(flatten(value, f"{name}.") if isinstance(value, Mapping) else {name: value})
    return flat


def check_arguments(function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
    """Refuse values outside the types and ranges of a function's annotations.

    Raises:
        ConfigError: With the argument, its value and what is allowed.
    """
    hints = get_type_hints(function, include_extras=True)
    for name, value in arguments.items():
        if name in hints:
            _check(name, value, hints[name])


@cache
def hints_of(cls: type) -> tuple[tuple[str, Any], ...]:
    """Names of a class's settings, each with its type."""
    hints = get_type_hints(cls, include_extras=True)
    return tuple((entry.name, hints[entry.name]) for entry in fields(cls))


def _converted(value: Any, hint: Any) -> Any:
    """A value converted to a type: numbers to float or text, sequences to lists."""
    kinds, _ = kinds_of(hint)
    if isinstance(value, str) and _is_location(hint):
        return at_home(value)
    if float in kinds and int not in kinds and type(value) is int:
        return float(value)
    if type(value) in (int, float) and not {int, float} & set(kinds):
        # Hydra reads 32 as a number even where a string is expected.
        choices = [choice for kind in kinds for choice in get_args(kind)]
        if str in kinds or str(value) in choices:
            return str(value)
    if isinstance(value, list | tuple):
        items = [get_args(kind)[0] for kind in kinds if get_origin(kind) in (list, Sequence)]
        return [_converted(item, items[0]) for item in value] if items else list(value)
    return value


def at_home(path: str) -> str:
    """A path with a leading ``~`` expanded; unchanged if that home directory does not exist."""
    if not path.startswith("~"):
        return path
    try:
        return str(Path(path).expanduser())
    except RuntimeError:
        return path


def _is_location(hint: Any) -> bool:
    return any(HOME in getattr(part, "__metadata__", ()) for part in (hint, *get_args(hint)))


def kinds_of(hint: Any) -> tuple[list[Any], list[Range]]:
    """Alternatives of a type hint, and the ranges that it carries."""
    if get_origin(hint) is Annotated:
        inner, *extras = get_args(hint)
        kinds, ranges = kinds_of(inner)
        return kinds, [extra for extra in extras if isinstance(extra, Range)] + ranges
    if get_origin(hint) in (Union, types.UnionType):
        parts = [kinds_of(part) for part in get_args(hint)]
        kinds = [kind for found, _ in parts for kind in found]
        return kinds, [allowed for _, found in parts for allowed in found]
    return [hint], []


def _check(name: str, value: Any, hint: Any) -> None:
    kinds, ranges = kinds_of(hint)
    if value is None and type(None) in kinds:
        return
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{name}={value}: must be a finite number")
    choices = [choice for kind in kinds if get_origin(kind) is Literal for choice in get_args(kind)]
    if choices and value in choices:
        return
    if not any(_fits(value, kind) for kind in kinds if get_origin(kind) is not Literal):
        if choices:
            named = ", ".join(map(str, choices))
            other = " or a number" if float in kinds else " or a whole number" * (int in kinds)
            raise ConfigError(f"{name}={value}: must be one of {named}{other}")
        raise ConfigError(f"{name}={value}: must be {_words(kinds)}")
    for allowed in ranges:
        if isinstance(value, int | float) and value not in allowed:
            raise ConfigError(f"{name}={value}: {allowed}")
    for kind in kinds:
        if get_origin(kind) in (list, Sequence) and isinstance(value, list):
            (inner,) = get_args(kind)
            for item in value:
                _check(name, item, inner)


def _fits(value: Any, kind: Any) -> bool:
    if kind is float:
        return isinstance(value, float) or type(value) is int
    if kind is int:
        return type(value) is int
    if kind is Any:
        return True
    origin = get_origin(kind)
    if origin is Sequence and isinstance(value, str):
        return False
    return isinstance(value, origin or kind)


_NAMES = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    type(None): "null",
    list: "a list",
    Sequence: "a list",
    dict: "a mapping",
}


def _words(kinds: list[Any]) -> str:
    origins = [get_origin(kind) or kind for kind in kinds]
    names = ["a mapping" if is_dataclass(o) else _NAMES.get(o, str(o)) for o in origins]
    return " or ".join(dict.fromkeys(names))
