"""Input data: cameras, scene files, procedural scenes and the ray batches drawn from them."""
