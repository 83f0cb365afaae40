"""The error class of Large Reconstruction Models."""

from xplanes.errors import XPlanesError


class LRMError(XPlanesError, ValueError):
    """A model, its weights or its input cannot be used; the message says why and what to do."""
