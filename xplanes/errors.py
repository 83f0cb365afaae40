"""Errors whose message says all: the thing, the value and the way out."""


class XPlanesError(Exception):
    """The base of all errors whose message says enough; commands print it without a traceback."""


class ConfigError(XPlanesError, ValueError):
    """A setting that cannot work; the message names the key, the value and the way out."""


class DeviceError(XPlanesError, RuntimeError):
    """A device that does not work any more; the message names what it was doing and the way out."""


class GaussianError(XPlanesError, ValueError):
    """Gaussians that cannot be drawn; the message names the tensor and the Gaussian."""
