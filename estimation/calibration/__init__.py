"""Calibration of the cameras (lenses, places, clocks) and of the arm before them (base, tool, latency)."""

__all__ = ["arm_fit", "arm_model", "camera_rig", "lens_fit", "lens_model", "rig_fit", "validation"]
