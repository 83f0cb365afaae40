"""After training: scores, images, videos and tables from run directories."""
