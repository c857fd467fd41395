"""Images to descriptors, latents and relative poses; OpenCV and torch live here only."""
