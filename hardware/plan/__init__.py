"""`stillbed plan`: a scan or a contour made a path, and what is told of it."""

__all__ = ["order", "page", "question", "run"]
