"""The error that every problem with scene data is reported as."""


class SceneError(ValueError):
    """Scene data cannot be used; the message says which file, why, and what to do."""
