"""Calibration of the cameras (lenses, places, clocks) and of the arm before them (base, tool, latency)."""
