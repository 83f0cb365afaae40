"""After training: scores, images and videos from run directories."""
