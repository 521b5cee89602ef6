"""The map of landmarks: triangulation, bundle adjustment beside the frame's path, a local surface through it."""

__all__ = ["bundle_adjustment", "refiner", "triangulation"]
