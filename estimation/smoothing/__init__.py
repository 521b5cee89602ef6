"""Offline smoothing: all poses of a recording, its landmarks and its cameras' errors, from all its tracks at once."""
