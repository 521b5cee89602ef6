"""Measured figures of every part, each beside its target and its reference: `stillbed bench SUBJECT`."""

__all__ = [
    "calibration", "figures", "link", "live", "loop_run", "pictures", "prediction", "recordings", "subjects", "whole",
]  # fmt: skip
