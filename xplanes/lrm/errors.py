"""The error class of Large Reconstruction Models."""


class LRMError(ValueError):
    """A model, its weights or its input cannot be used; the message says why and what to do."""
