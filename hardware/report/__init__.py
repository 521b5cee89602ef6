"""Pages, charts and figures that all reports share, and the evaluation of a trajectory."""

__all__ = ["evaluation", "page", "report"]
