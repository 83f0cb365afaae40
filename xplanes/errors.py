"""Errors whose messages name the problem, the value and the remedy."""


class XPlanesError(Exception):
    """Base class of errors with self-explanatory messages; commands print no traceback."""


class ConfigError(XPlanesError, ValueError):
    """A setting is invalid; the message names the key, the value and the remedy."""


class DeviceError(XPlanesError, RuntimeError):
    """A device that does not work any more; the message names what it was doing and the way out."""
