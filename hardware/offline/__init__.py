"""Work on recorded sessions: track, replay, smooth, compare, segment, convert and view them."""

__all__ = [
    "compare", "convert", "looks", "reach", "replay", "segment", "smooth", "smooth_report", "smooth_tracks",
    "track", "train", "trajectory_files", "viewer",
]  # fmt: skip
