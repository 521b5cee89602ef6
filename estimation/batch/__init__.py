"""Smoothing of a whole recorded session: all poses, landmarks and camera parameters from all frame sets at once."""

__all__ = ["initialisation", "normal_equations", "smooth", "smoothed", "solve"]
