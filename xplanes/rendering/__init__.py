"""Field and rays to pixels: ray-box, occupancy, sampling, compositing."""
