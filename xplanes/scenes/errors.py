"""Errors in scene data."""

from xplanes.errors import XPlanesError


class SceneError(XPlanesError, ValueError):
    """Scene data cannot be used; the message says which file, why, and what to do."""


class MissingSplitError(SceneError):
    """A scene has no split of a name."""
