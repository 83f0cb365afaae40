"""The error that every problem with a Large Reconstruction Model is reported as."""


class LRMError(ValueError):
    """A model, its weights or its input cannot be used; the message says why and what to do."""
