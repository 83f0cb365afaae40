"""Errors whose message says all: the thing, the value and the way out."""


class ConfigError(ValueError):
    """A setting that cannot work; the message names the key, the value and the way out."""


class DeviceError(RuntimeError):
    """A device that does not work any more; the message names what it was doing and the way out."""


class GaussianError(ValueError):
    """Gaussians that cannot be drawn; the message names the tensor and the Gaussian."""
