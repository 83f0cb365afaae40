"""3D Gaussians to pixels: projection, sorting, blending, and colours that depend on direction."""
