"""K-Planes (Fridovich-Keil et al. 2023)."""
