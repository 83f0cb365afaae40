"""Dynamic 3D Gaussians: three ways to move them, their rasteriser and their density control."""
