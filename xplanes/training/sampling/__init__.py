"""Samplers in training: rendering with jitter, terms of their own, and upkeep."""
