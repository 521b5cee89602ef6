"""Live cameras: which one is meant, what it was told, when it exposed, and the sets of frames that belong together."""
