"""Small Large Reconstruction Models of our own: procedural objects, training, scores."""
