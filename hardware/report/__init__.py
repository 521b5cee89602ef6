"""Pages, charts and figures that all reports share, and the evaluation of a trajectory."""
