"""What a robot's own consecutive pictures say of its camera: focal length, mounting, overlays, frozen pictures."""
