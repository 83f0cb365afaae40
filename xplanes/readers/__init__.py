"""Readers of data formats: files of other programs to scenes. The core does not import them."""
