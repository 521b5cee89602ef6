"""Measured figures of every part, each beside its target and its reference: `stillbed bench SUBJECT`."""

__all__ = [
    "calibration", "campaigns", "detection", "estimator", "fault_run", "figures", "fill", "live", "mapping",
    "outage_run", "pictures", "planner", "prediction", "recordings", "smoothing", "subjects", "whole", "wounds",
]  # fmt: skip
