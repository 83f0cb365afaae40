"""Errors whose messages name the problem, the value and the remedy."""

from collections.abc import Sequence


class XPlanesError(Exception):
    """Base class of errors with self-explanatory messages; commands print no traceback."""


class ConfigError(XPlanesError, ValueError):
    """A setting is invalid; the message names the key, the value and the remedy."""


class DeviceError(XPlanesError, RuntimeError):
    """A device that does not work any more; the message names what it was doing and the way out."""


class LRMError(XPlanesError, ValueError):
    """A model, its weights or its input cannot be used; the message says why and what to do."""


class SceneError(XPlanesError, ValueError):
    """Scene data cannot be used; the message says which file, why, and what to do."""


class MissingSplitError(SceneError):
    """A scene has no split of a name."""


class BrokenFrameError(SceneError):
    """One frame cannot be used; a capture can do without it."""


SHOWN = 5
"""Problems of a capture that are shown in full."""


def refuse_all(problems: Sequence[str]) -> None:
    """Refuse a capture with all that is wrong with it at once; nothing if nothing is.

    Raises:
        SceneError: With the first of many problems, and their number.
    """
    if problems:
        raise SceneError(first_of(problems))


def first_of(problems: Sequence[str]) -> str:
    """The first of many problems, a line each, and how many more there are."""
    more = len(problems) - SHOWN
    rest = [f"... and {more} more problems like these."] * (more > 0)
    return "\n".join([*problems[:SHOWN], *rest])
