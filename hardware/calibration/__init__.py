"""Calibrating cameras and arm: recordings in, rig files, reports and verdicts out."""

__all__ = [
    "arm_record", "arm_report", "arm_run", "arm_solve", "corners", "dispenser_lines", "dispenser_record",
    "inputs", "live", "report", "rig_formats", "run",
]  # fmt: skip
