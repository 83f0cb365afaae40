"""TiNeuVox (Fang et al. 2022)."""
