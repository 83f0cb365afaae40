"""Tensor4D (Shao et al. 2023)."""
