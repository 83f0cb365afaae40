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
    """An LRM, its weights or its input cannot be used; the message says why and what to do."""


class SceneError(XPlanesError, ValueError):
    """Scene data cannot be used; the message says which file, why, and what to do."""


class MissingSplitError(SceneError):
    """A scene lacks a split."""


class BrokenFrameError(SceneError):
    """A frame is unusable, but the rest of the capture can be used."""


def require_between(name: str, value: float | None, low: float, high: float) -> None:
    """Refuse a number out of range; None passes.

    Raises:
        ConfigError: With the name, the value and the range.
    """
    if value is not None and not low <= value <= high:
        raise ConfigError(f"{name} {value}: must lie between {low} and {high}")


SHOWN = 5
"""Number of problems of a capture that are shown in full."""


def refuse_all(problems: Sequence[str]) -> None:
    """Report the problems of a capture, if there are any, in one error.

    Raises:
        SceneError: With the first problems, and their number.
    """
    if problems:
        raise SceneError(first_of(problems))


def all_of(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """The results of a function for all items.

    Raises:
        SceneError: If it fails for some items; reports their problems as `refuse_all` does.
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
    """The first problems, one per line, and how many more there are."""
    more = len(problems) - SHOWN
    rest = [f"... and {more} more problems like these."] * (more > 0)
    return "\n".join([*problems[:SHOWN], *rest])


def some(names: Sequence[str]) -> str:
    """The first of many names, for messages."""
    return f"{', '.join(names[:5])}{', ...' if len(names) > 5 else ''}"


def warn(text: str) -> None:
    """Warn about a capture."""
    warnings.warn(text, stacklevel=3)
