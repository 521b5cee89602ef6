"""Measured figures of every part, each beside its target and its reference: `stillbed bench SUBJECT`."""

__all__ = [
    "calibration", "detection", "estimator", "fault_run", "figures", "fill", "link", "live", "mapping",
    "pictures", "planner", "prediction", "recordings", "smoothing", "subjects", "whole", "wounds",
]  # fmt: skip
