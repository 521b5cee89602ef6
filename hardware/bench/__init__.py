"""Measured figures of every part, each beside its target and its reference: `stillbed bench SUBJECT`."""

__all__ = [
    "calibration", "fault_run", "figures", "link", "live", "pictures", "prediction", "recordings", "subjects", "whole",
]  # fmt: skip
