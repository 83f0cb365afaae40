"""What was photographed: cameras, views, the frame of a scene, and ray batches."""
