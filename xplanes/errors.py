"""Errors whose messages name the problem, the value and the remedy."""

import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class XPlanesError(Exception):
    """Base class of errors with self-explanatory messages; commands print no traceback."""


class ConfigError(XPlanesError, ValueError):
    """A setting is invalid; the message names the key, the value and the remedy."""


class DeviceError(XPlanesError, RuntimeError):
    """A device stopped working; the message names what it was doing and the remedy."""


class LRMError(XPlanesError, ValueError):
    """A model, its weights or its input cannot be used; the message says why and what to do."""


class SceneError(XPlanesError, ValueError):
    """Scene data cannot be used; the message says which file, why, and what to do."""


class MissingSplitError(SceneError):
    """A scene has no split of a name."""


class BrokenFrameError(SceneError):
    """One frame cannot be used; a capture can do without it."""


def require_between(name: str, value: float | None, low: float, high: float) -> None:
    """Refuse a number out of range; None passes.

    Raises:
        ConfigError: With the name, the value and the range.
    """
    if value is not None and not low <= value <= high:
        raise ConfigError(f"{name} {value}: must lie between {low} and {high}")


SHOWN = 5
"""Problems of a capture that are shown in full."""


def refuse_all(problems: Sequence[str]) -> None:
    """Refuse a capture with all of its problems at once, if there are any.

    Raises:
        SceneError: With the first of many problems, and their number.
    """
    if problems:
        raise SceneError(first_of(problems))


def all_of(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """The results of a function for all items.

    Raises:
        SceneError: If it refuses some; with the problems of all, see `refuse_all`.
    """
    results: list[Result] = []
    problems: list[str] = []
    for item in items:
        try:
            results.append(function(item))
        except SceneError as problem:
            problems.append(str(problem))
    refuse_all(problems)
    return results


def first_of(problems: Sequence[str]) -> str:
    """The first of many problems, a line each, and how many more there are."""
    more = len(problems) - SHOWN
    rest = [f"... and {more} more problems like these."] * (more > 0)
    return "\n".join([*problems[:SHOWN], *rest])


def warn(text: str) -> None:
    """Warn about a capture."""
    warnings.warn(text, stacklevel=3)
