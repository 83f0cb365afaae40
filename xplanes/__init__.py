"""Dynamic radiance fields that start from a Large Reconstruction Model."""

__version__ = "0.1.0"
