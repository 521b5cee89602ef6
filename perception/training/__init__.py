"""Training of the wound networks; needs the extra `[train]` (torch), which nothing else in the project imports."""

__all__ = ["dataset", "export", "loop", "metrics"]
